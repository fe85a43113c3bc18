"""Real scans in the bench `scans`: the same tree gives the same result; tubes without points."""

import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from benchmarks import scan_cases
from benchmarks.scan_cases import one_sided_case, round_case
from benchmarks.scan_scores import Dense
from benchmarks.table import Asked, Row, Setting
from benchmarks.trial_log import go_on, read_trials, source_digest
from limber.core.errors import LimberError
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.io.clouds import read_points
from limber.geometry.reconstruction import Reconstruction, ReconstructSettings, reconstruct_cloud
from limber.geometry.skeleton.skeleton import BRIDGED

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"
SCANS = {"coffeetree_branch/branch.xyz": {}, "aRchi_tree_1/Tree_1.ply": {},
         "apple_rgbd/frame_00025.ply": {"unit": "mm", "up": (0.0, -1.0, 0.0)},
         "apple_rgbd/frame_00125.ply": {"unit": "mm", "up": (0.0, -1.0, 0.0)},
         "tomato_maize/tomato_03-05.xyz": {"unit": "mm"},
         "tomato_maize/maize_03-13.ply": {"unit": "mm"}}
AS_IT_IS = "as it is"
CHANGES = (AS_IT_IS, "half", "turn", "shuffle", "shift", "unit")
"""Changes to a scan, the most informative first."""
_LEAFY = {"unexplained": 1.0, "leave_out": True, "leaves": "cut"}


def changes(cloud: Cloud, settings: dict, seed: int) -> dict[str, tuple[Cloud, dict]]:
    """The same scan in another unit, moved, rotated about its vertical, shuffled, and halved."""
    rng = np.random.default_rng(seed)
    points = cloud.points
    unit = settings.get("unit", "m")
    other, factor = ("mm", 1000.0) if unit == "m" else ("m", 0.001)
    up = np.array(settings.get("up", (0.0, 0.0, 1.0)))
    angle = rng.uniform(0, 2 * np.pi)
    cross = np.array([[0, -up[2], up[1]], [up[2], 0, -up[0]], [-up[1], up[0], 0]])
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    shift = rng.uniform(-5, 5, 3) * float(np.ptp(points, axis=0).max())
    order = rng.permutation(len(points))
    return {"unit": (Cloud(points * factor), settings | {"unit": other}),
            "shift": (Cloud(points + shift), settings),
            "turn": (Cloud(points @ turn.T), settings),
            "shuffle": (Cloud(points[order]), settings),
            "half": (Cloud(points[np.sort(order[:len(points) // 2])]), settings)}


@dataclass
class ScanRun:
    """Result of one scan, original or changed; ``failure`` if it was not reconstructed.

    ``seed`` drew the change and the generated scans; ``source`` (digest of the sources) identifies
    the code. ``off_points`` is the fraction of :func:`off_any_point`. The intervals are those that
    the result states.
    """

    scan: str
    change: str
    seed: int
    source: str
    length_m: float = np.nan
    volume_m3: float = np.nan
    length_interval_m: list[float] = field(default_factory=list)
    volume_interval_m3: list[float] = field(default_factory=list)
    off_points: float = np.nan
    failure: str = ""
    seconds: float = 0.0

    def off(self, other: "ScanRun") -> float:
        """Difference of length or volume from another run's, whichever is larger."""
        return max(abs(self.length_m / other.length_m - 1),
                   abs(self.volume_m3 / other.volume_m3 - 1))

    def agrees(self, other: "ScanRun") -> bool:
        """Whether the stated intervals of both runs overlap, of length and of volume."""
        return all(max(low, other_low) <= min(high, other_high) for (low, high), (
            other_low, other_high) in (
                (self.length_interval_m, other.length_interval_m),
                (self.volume_interval_m3, other.volume_interval_m3)))


REAL_ROW = Asked("real scans: tube length more than a radius off any point, bridges aside",
                 "under 8 %")


def same_tree_asked(names: str) -> Asked:
    """Measure of the row of one scan, or of all."""
    return Asked(f"{names} in another unit, shifted, turned, shuffled; halved: length and volume",
                 "3 %; 10 %; no crash")


def same_tree_rows(setting: Setting, only: str | None = None) -> list[Row]:
    """Length and volume of each changed scan against the scan itself; ``only``: for one scan."""
    names = [Path(name).stem for name in SCANS] if DATA.is_dir() else []
    names = [only] if only else ["round", "one-sided", *(names[:1] if setting.quick else names)]
    runs = _runs(setting, [(name, change) for change in CHANGES for name in names])
    first = {run.scan: run for run in runs if run.change == AS_IT_IS and not run.failure}
    crashes = [f"{run.scan} {run.change}: {run.failure}" for run in runs if run.failure]
    worst, half, agree, count, notes = 0.0, 0.0, 0, 0, []
    for run in runs:
        if run.change == AS_IT_IS or run.failure or run.scan not in first:
            continue
        agree, count = agree + run.agrees(first[run.scan]), count + 1
        off, limit = run.off(first[run.scan]), 0.10 if run.change == "half" else 0.03
        half, worst = (max(half, off), worst) if run.change == "half" else (half, max(worst, off))
        if off > limit:
            notes.append(f"{run.scan} {run.change} {off:.1%}")
    if not count and not crashes:
        return []
    return [Row(*same_tree_asked(only or "scans"),
                f"worst {worst:.1%}; {half:.1%}; {len(crashes)} crashes; stated intervals meet in "
                f"{agree} of {count}" + "".join(f"; {text}" for text in notes + crashes),
                worst < 0.03 and half < 0.10 and not crashes, count)]


def _runs(setting: Setting, tasks: list[tuple[str, str]]) -> list[ScanRun]:
    """Original or changed scans, as many as there is time for, including those kept."""
    kept, source = setting.kept / "files.jsonl", source_digest(("geometry",), __file__,
                                                                 scan_cases.__file__)
    seed = 1000 * setting.seed
    earlier = [run for run in read_trials(ScanRun, kept) if run.seed == seed]
    return go_on(earlier, tasks, lambda run: (run.scan, run.change), partial(
        _run_of, seed=seed, source=source, out=setting.out), source, kept, setting.budget, None,
        setting.progress)


def _run_of(task: tuple[str, str], seed: int, source: str, out: Path | None) -> ScanRun:
    name, change = task
    cloud, settings = _subject(name, seed)
    made = {AS_IT_IS: (cloud, settings)} | changes(cloud, settings, seed)
    return _run(ScanRun(name, change, seed, source), *made[change], out)


def _subject(name: str, seed: int) -> tuple[Cloud, dict]:
    if name == "round":
        return Cloud(round_case(seed).points), {}
    if name == "one-sided":
        return Cloud(one_sided_case(seed + 1).points), {}
    file = next(file for file in SCANS if Path(file).stem == name)
    return read_points(DATA / file), dict(SCANS[file])


def _run(run: ScanRun, cloud: Cloud, settings: dict, out: Path | None) -> ScanRun:
    began = time.perf_counter()
    try:
        made = reconstruct_cloud(replace(cloud), ReconstructSettings(**(_LEAFY | settings)))
    except Exception as error:  # a crash is what the row asks for
        seen = error.seen if isinstance(error, LimberError) else f"{type(error).__name__}: {error}"
        return replace(run, failure=seen, seconds=time.perf_counter() - began)
    seconds = time.perf_counter() - began
    if out is not None:
        from benchmarks.geometry_pictures import draw_reconstruction

        title = f"{run.scan} {run.change}"
        draw_reconstruction(out / f"{title.replace(' ', '_')}.png", made.cloud.points,
                            made.meshed.skeleton, made.meshed.surface, title)
    return replace(run, length_m=made.numbers["length_m"],
                   volume_m3=made.numbers["mesh_volume_m3"],
                   length_interval_m=made.numbers["length_interval_m"],
                   volume_interval_m3=made.numbers["volume_interval_m3"],
                   off_points=off_any_point(made), seconds=seconds)


def real_rows(setting: Setting) -> list[Row]:
    """Fraction of tube length more than a radius off any point, bridges excluded."""
    if not DATA.is_dir():
        return [Row(*REAL_ROW, "not measured: no ../shared/data", None, 0)]
    names = [Path(name).stem for name in SCANS]
    names = [names[0], names[2]] if setting.quick else names
    done = _runs(setting, [(name, AS_IT_IS) for name in names])
    failed = [run for run in done if run.failure]
    shares = {run.scan: run.off_points for run in done if not run.failure}
    text = ", ".join(f"{name} {share:.1%}" for name, share in shares.items())
    return [Row(*REAL_ROW, text + "".join(f"; {run.scan}: {run.failure}" for run in failed),
                bool(shares and max(shares.values()) < 0.08 and not failed), len(done))]


def off_any_point(made: Reconstruction) -> float:
    """Fraction of the axes' length whose surface is more than a radius from all points."""
    skeleton = made.meshed.skeleton
    here = Dense.of(skeleton, step=0.25 * float(np.median(skeleton.radius)))
    distance, _ = cKDTree(made.cloud.points).query(here.points)
    asked = skeleton.radius_state[here.high] != BRIDGED
    return float((distance > 2 * here.radius)[asked].mean())

