"""Cases of the bench `scans`, run in parallel as a user runs them, and their scores by kind."""

import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from benchmarks import scan_cases, scan_plants, scan_scores
from benchmarks.scan_cases import (
    ScanCase,
    gap_case,
    one_sided_case,
    round_case,
    single_view_case,
)
from benchmarks.scan_plants import crown_case, leafy_case
from benchmarks.scan_scores import (
    bridges_right,
    cylinder_volume,
    points_on_axes,
    score,
    seen_part,
)
from benchmarks.table import Setting
from benchmarks.trial_log import go_on, read_trials, source_digest
from benchmarks.worlds.dropped_points import dropped_points
from benchmarks.worlds.sources import WORLDS
from limber.core.alignment import Alignment
from limber.core.errors import LimberError
from limber.geometry.io.skeletons import read_cylinders
from limber.geometry.reconstruction import ReconstructSettings
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.stages.shape.reconstruct import reconstruct

KINDS: dict[str, Callable[[int], ScanCase]] = {
    "one-sided": one_sided_case, "2-mm": lambda seed: one_sided_case(seed, 0.002),
    "3-mm": lambda seed: one_sided_case(seed, 0.003), "round": round_case, "gaps": gap_case,
    "single-view": single_view_case, "crowns": crown_case, "leafy": leafy_case}
_FAR = 4.0  # radii from an axis to the nearest node of the mesh, from which that leaves it out


@dataclass
class CaseRun:
    """Result of one case: its scores, or why it was not reconstructed.

    ``source`` (digest of the sources) identifies the code.
    """

    kind: str
    seed: int
    source: str
    scores: dict[str, Any] = field(default_factory=dict)
    failure: str = ""
    seconds: float = 0.0

    def __post_init__(self) -> None:
        for name, value in self.scores.items():
            if value is None:  # as JSON has what is not finite
                self.scores[name] = np.inf


@dataclass
class Outcomes:
    """Scores of one kind of case; a case that could not be reconstructed is a failure."""

    scores: list[dict[str, Any]] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)

    @property
    def count(self) -> int:
        return len(self.scores) + len(self.failed)

    def column(self, key: str) -> np.ndarray:
        return np.array([score[key] for score in self.scores])

    def forks(self) -> tuple[str, float, float]:
        """As text, with the fractions found and false."""
        wanted, found, false = (int(self.column(key).sum()) for key in (
            "forks", "forks_found", "forks_false"))
        wanted = max(wanted, 1)
        return (f"{found / wanted:.0%} ({found}/{wanted}) / {false / wanted:.0%}", found / wanted,
                false / wanted)

    def centre_failures(self) -> int:
        off = (self.column("centre_radii") > 0.25) & (self.column("centre_m") > 0.0007)
        return int(off.sum()) + len(self.failed)

    def told(self) -> str:
        return f"; {len(self.failed)} not reconstructed" if self.failed else ""


def outcomes(setting: Setting, counts: dict[str, int]) -> dict[str, Outcomes]:
    """Reconstruct and score cases of each kind in turn, as many as there is time for.

    Args:
        setting: Pictures of every case go to its ``out``; cases kept from other parts or an earlier
            run are not repeated.
        counts: Most cases of each kind.
    """
    kept, source = setting.kept / "cases.jsonl", case_source()
    first = 1000 * setting.seed
    tasks = [(kind, first + number) for number in range(max(counts.values()))
             for kind, count in counts.items() if number < count]
    done = {kind: Outcomes() for kind in counts}
    runs = go_on(read_trials(CaseRun, kept), tasks, lambda each: (each.kind, each.seed), partial(
        _measured, out=setting.out), source, kept, setting.budget, None, setting.progress)
    for run in runs:
        if run.failure:
            done[run.kind].failed.append(run.failure)
        else:
            done[run.kind].scores.append(run.scores)
    return done


def _measured(task: tuple[str, int], out: Path | None) -> CaseRun:
    return measured(*task, out)


def case_source() -> str:
    """Digest of all that a case's scores depend on."""
    return source_digest(("geometry",), __file__, scan_cases.__file__, scan_plants.__file__,
                         scan_scores.__file__,
                         *sorted((Path(__file__).parent / "worlds").glob("*.py")))


def measured(kind: str, seed: int, out: Path | None) -> CaseRun:
    """One case; its picture is written to ``out``."""
    case, began, source = (KINDS | WORLDS)[kind](seed), time.perf_counter(), case_source()
    with tempfile.TemporaryDirectory() as folder:
        try:
            scored, found = run_case(case, Path(folder))
        except Exception as error:  # a crash is a failure too
            known = isinstance(error, LimberError)
            return CaseRun(kind, seed, source, seconds=time.perf_counter() - began, failure=(
                f"{case.name}: {'' if known else f'{type(error).__name__}: '}{error}"))
    seconds = time.perf_counter() - began
    if out is not None:
        from benchmarks.scan_pictures import draw_case

        draw_case(out / f"{case.name}.png", case, found, scored)
    return CaseRun(kind, seed, source, scored, seconds=seconds)


def run_case(case: ScanCase, folder: Path) -> tuple[dict[str, Any], Skeleton]:
    """Write a case's file, reconstruct it, score it in the file's frame.

    Raises:
        LimberError: it could not be reconstructed.
    """
    path, branch = case.write(folder), folder / f"{case.name}.branch"
    result = reconstruct(path, branch, ReconstructSettings(**{"root": "auto"} | case.settings))
    manifest = json.loads((branch / "branch.json").read_text())
    aligned = read_cylinders(branch / "skeleton.csv")
    alignment = Alignment.model_validate(manifest["alignment"])
    found = aligned.moved(alignment.undo(aligned.nodes))
    bridges = [bridge | {end: alignment.undo(np.array(bridge[end])) for end in ("from", "to")}
               for bridge in result["bridges"]]
    seen = seen_part(case.truth, case.points)
    # Wood without points is in no mesh; it is reported separately.
    shown = cylinder_volume(seen) / cylinder_volume(case.truth)
    scored = score(seen, found)
    scored["told_bridges"] = [[bridge["probability"], bool(right)] for bridge, right in zip(
        bridges, bridges_right(bridges, seen), strict=True)]
    scored |= {"seed": case.seed, "left_out": result["left_out_twigs"], "shown": shown,
               "unsaid_m": unsaid_length(aligned, branch),
               "length_held": held(result["length_interval_m"], seen.length),
               "volume_held": held(result["volume_interval_m3"], shown * case.volume)
               if case.volume else True,
               "volume": result["mesh_volume_m3"] / (shown * case.volume) - 1 if case.volume else (
                   0.0)}
    if case.leaf is not None:
        scored["leaf_points_on_stems"] = points_on_axes(case.points[case.leaf], case.truth, found)
    scored |= dropped_points(case, branch)
    return scored, found


def held(interval: list[float], value: float) -> bool:
    """Whether an interval contains a true value."""
    return interval[0] <= value <= interval[1]


def unsaid_length(aligned: Skeleton, branch: Path) -> float:
    """Length of axes [m] that is neither near the mesh nor on a branch reported as left out."""
    masses = branch / "point_masses.json"
    named = {mass["branch"] for mass in json.loads(masses.read_text()) if "branch" in mass} if (
        masses.is_file()) else set()
    distance, _ = cKDTree(TetMesh.read(branch / "mesh.vtu").nodes).query(aligned.nodes)
    bare = (distance > _FAR * aligned.radius) & ~np.isin(aligned.branch, list(named))
    step = np.linalg.norm(aligned.nodes - aligned.nodes[aligned.parent], axis=1)
    return float(step[1:][bare[1:]].sum())
