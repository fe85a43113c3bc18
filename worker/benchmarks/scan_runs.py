"""Cases of the bench `scans` run as a user runs them, side by side, and their scores by kind.

Each case is kept as it is done: a run that was stopped goes on with the same seed and folder.
"""

import json
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from benchmarks import scan_cases, scan_plants, scan_scores
from benchmarks.kept_trials import keep, read_trials, source_digest
from benchmarks.scan_cases import (
    ScanCase,
    gap_case,
    one_sided_case,
    round_case,
    single_view_case,
)
from benchmarks.scan_plants import crown_case, leafy_case
from benchmarks.scan_scores import cylinder_volume, points_on_axes, score, seen_part
from limber.alignment import Alignment
from limber.errors import LimberError
from limber.geometry.reconstruct import ReconstructSettings
from limber.geometry.skeleton.files import read_fitted
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.jobs.budget import core_budget
from limber.jobs.pool import Pool
from limber.progress import Progress
from limber.stages.reconstruct import reconstruct

KINDS: dict[str, Callable[[int], ScanCase]] = {
    "one-sided": one_sided_case, "2-mm": lambda seed: one_sided_case(seed, 0.002),
    "3-mm": lambda seed: one_sided_case(seed, 0.003), "round": round_case, "gaps": gap_case,
    "single-view": single_view_case, "crowns": crown_case, "leafy": leafy_case}
_FAR = 4.0  # radii from an axis to the nearest node of the mesh, from which that leaves it out


@dataclass
class CaseRun:
    """What one case gave: its scores, or why it was not reconstructed.

    ``source`` (digest of the sources) says what code it was.
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
        """As text, and the shares found and false."""
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


def measure(wanted: dict[str, range], progress: Progress, out: Path | None,
            ) -> dict[str, Outcomes]:
    """Reconstruct and score the seeds of each kind, as many side by side as there are cores.

    Args:
        wanted: Seeds of each kind.
        progress: Called as it goes.
        out: Where pictures of every case and ``cases.jsonl`` go, or None. What that file has from
            the same sources is not done again.
    """
    kept, source = None if out is None else out / "cases.jsonl", case_source()
    known = {(run.kind, run.seed): run for run in read_trials(CaseRun, kept)
             if run.source == source}
    tasks = [(kind, seed) for kind, seeds in wanted.items() for seed in seeds]
    missing = [task for task in tasks if task not in known]
    progress.part(0.0, 0.01)(1.0, f"{len(tasks) - len(missing)} of {len(tasks)} cases were kept")
    for number, run in enumerate(_computed([(*task, out) for task in missing])):
        known[run.kind, run.seed] = run
        keep(run, kept)
        progress((number + 1) / len(missing), "scans", case=f"{run.kind} {run.seed}",
                 seconds=run.seconds)
    done = {kind: Outcomes() for kind in wanted}
    for kind, seed in tasks:
        run = known[kind, seed]
        if run.failure:
            done[kind].failed.append(run.failure)
        else:
            done[kind].scores.append(run.scores)
    return done


def case_source() -> str:
    """Digest of all that a case's scores depend on."""
    return source_digest(("geometry",), __file__, scan_cases.__file__, scan_plants.__file__,
                         scan_scores.__file__)


def _computed(tasks: list[tuple[str, int, Path | None]]) -> Iterator[CaseRun]:
    if core_budget() < 2:
        for task in tasks:
            yield measured(*task)
        return
    with Pool(name="scans") as pool:
        for future in as_completed([pool.submit(measured, *task) for task in tasks]):
            yield future.result()


def measured(kind: str, seed: int, out: Path | None) -> CaseRun:
    """One case; its picture goes to ``out``."""
    case, began, source = KINDS[kind](seed), time.perf_counter(), case_source()
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
    result = reconstruct(path, branch, ReconstructSettings(**case.settings))
    manifest = json.loads((branch / "branch.json").read_text())
    aligned = read_fitted(branch / "skeleton.csv")
    found = aligned.moved(Alignment.model_validate(manifest["alignment"]).undo(aligned.nodes))
    seen = seen_part(case.truth, case.points)
    # Wood that no point shows is in no mesh; it is told beside.
    shown = cylinder_volume(seen) / cylinder_volume(case.truth)
    scored = score(seen, found)
    scored |= {"seed": case.seed, "left_out": result["left_out_twigs"], "shown": shown,
               "unsaid_m": unsaid_length(aligned, branch),
               "length_held": held(result["length_interval_m"], seen.length),
               "volume_held": held(result["volume_interval_m3"], shown * case.volume)
               if case.volume else True,
               "volume": result["mesh_volume_m3"] / (shown * case.volume) - 1 if case.volume else (
                   0.0)}
    if case.leaf is not None:
        scored["leaf_points_on_stems"] = points_on_axes(case.points[case.leaf], case.truth, found)
    return scored, found


def held(interval: list[float], value: float) -> bool:
    """Whether an interval holds a true value."""
    return interval[0] <= value <= interval[1]


def unsaid_length(aligned: Skeleton, branch: Path) -> float:
    """Length of axes [m] that is neither near the mesh nor on a branch named as left out."""
    masses = branch / "point_masses.json"
    named = {mass["branch"] for mass in json.loads(masses.read_text()) if "branch" in mass} if (
        masses.is_file()) else set()
    distance, _ = cKDTree(TetMesh.read(branch / "mesh.vtu").nodes).query(aligned.nodes)
    bare = (distance > _FAR * aligned.radius) & ~np.isin(aligned.branch, list(named))
    step = np.linalg.norm(aligned.nodes - aligned.nodes[aligned.parent], axis=1)
    return float(step[1:][bare[1:]].sum())
