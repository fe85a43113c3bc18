"""The same tree gives the same result: changes of a scan that leave the plant as it is."""

import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from benchmarks import scan_cases
from benchmarks.scan_cases import one_sided_case, round_case
from benchmarks.scan_files import AS_IT_IS, DATA, SCANS, real_scan
from benchmarks.table import Asked, Row, Setting
from benchmarks.trial_log import go_on, read_trials, source_digest
from benchmarks.worlds.sources import BARE_VIEWS, SOURCES, WORLDS
from limber.core.errors import LimberError
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.reconstruction import Reconstruction, ReconstructSettings, reconstruct_cloud
from limber.geometry.skeleton.skeleton import Skeleton

_OFF, _OFF_HALF = 0.02, 0.08  # of length and volume
_FAR = 5e5  # [m] that a scan is shifted
_THREADS = "4"
_SAME_FORK = 3.0  # radii within which two forks are the same
_LIKELY = 0.8  # probability from which a fork must be in both trees
Back = Callable[[np.ndarray], np.ndarray]


def _half(cloud: Cloud, settings: dict, rng: np.random.Generator) -> tuple[Cloud, dict, Back]:
    chosen = np.sort(rng.permutation(len(cloud))[:len(cloud) // 2])
    return Cloud(cloud.points[chosen]), settings, _unmoved


def _turned(cloud: Cloud, settings: dict, rng: np.random.Generator) -> tuple[Cloud, dict, Back]:
    """About the vertical."""
    up = np.array(settings.get("up", (0.0, 0.0, 1.0)))
    up = up / np.linalg.norm(up)
    angle = rng.uniform(0, 2 * np.pi)
    cross = np.array([[0, -up[2], up[1]], [up[2], 0, -up[0]], [-up[1], up[0], 0]])
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return _placed(Cloud(cloud.points @ turn.T), settings, lambda places: places @ turn.T,
                   lambda places: places @ turn)


def _shifted(cloud: Cloud, settings: dict, rng: np.random.Generator) -> tuple[Cloud, dict, Back]:
    """By 500 km."""
    metre = 0.001 if settings.get("unit") == "mm" else 1.0
    shift = rng.normal(size=3)
    shift *= _FAR / metre / np.linalg.norm(shift)
    return _placed(Cloud(cloud.points + shift), settings, lambda places: places + shift,
                   lambda places: places - shift)


def _in_unit(cloud: Cloud, settings: dict, rng: np.random.Generator) -> tuple[Cloud, dict, Back]:
    other, factor = ("m", 0.001) if settings.get("unit") == "mm" else ("mm", 1000.0)
    return _placed(Cloud(cloud.points * factor), settings | {"unit": other},
                   lambda places: places * factor, lambda places: places / factor)


def _shuffled(cloud: Cloud, settings: dict, rng: np.random.Generator) -> tuple[Cloud, dict, Back]:
    return Cloud(cloud.points[rng.permutation(len(cloud))]), settings, _unmoved


def _doubled(cloud: Cloud, settings: dict, rng: np.random.Generator) -> tuple[Cloud, dict, Back]:
    """A fifth of the points twice."""
    again = rng.choice(len(cloud), len(cloud) // 5, replace=False)
    return Cloud(np.concatenate([cloud.points, cloud.points[again]])), settings, _unmoved


def _with_outliers(cloud: Cloud, settings: dict, rng: np.random.Generator,
                   ) -> tuple[Cloud, dict, Back]:
    """1 % of points anywhere in the bounding box."""
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    stray = rng.uniform(low, high, (len(cloud) // 100, 3))
    return Cloud(np.concatenate([cloud.points, stray])), settings, _unmoved


def _on_ground(cloud: Cloud, settings: dict, rng: np.random.Generator) -> tuple[Cloud, dict, Back]:
    """On a rough disc of ground under its lowest point, as wide as the plant is."""
    up = np.array(settings.get("up", (0.0, 0.0, 1.0)))
    up = up / np.linalg.norm(up)
    side = np.linalg.svd(up[None])[2][1:]
    height, size = cloud.points @ up, float(np.linalg.norm(np.ptp(cloud.points, axis=0)))
    foot = cloud.points[height < height.min() + 0.02 * size].mean(axis=0)
    count = len(cloud) // 2
    reach = 0.5 * size * np.sqrt(rng.uniform(0, 1, count))
    angle = rng.uniform(0, 2 * np.pi, count)
    rise = height.min() - foot @ up + 0.001 * size * rng.normal(size=count)
    ground = (foot + rise[:, None] * up + (reach * np.cos(angle))[:, None] * side[0]
              + (reach * np.sin(angle))[:, None] * side[1])
    return Cloud(np.concatenate([cloud.points, ground])), settings, _unmoved


def _as_it_is(cloud: Cloud, settings: dict, rng: np.random.Generator) -> tuple[Cloud, dict, Back]:
    return cloud, settings, _unmoved


def _unmoved(places: np.ndarray) -> np.ndarray:
    return places


def _placed(cloud: Cloud, settings: dict, there: Back, back: Back) -> tuple[Cloud, dict, Back]:
    """The cloud with the places that the settings state moved along with it."""
    if settings.get("root") is not None:
        root = there(np.array([settings["root"]], float))[0]
        settings = settings | {"root": tuple(root.tolist())}
    return cloud, settings, back


_CHANGED = {AS_IT_IS: _as_it_is, "half": _half, "turn": _turned, "shuffle": _shuffled,
            "shift": _shifted, "unit": _in_unit, "duplicates": _doubled,
            "outliers": _with_outliers, "ground": _on_ground, "threads": _as_it_is}
"""Changes to a scan, the most informative first."""


@dataclass
class SameTreeRun:
    """Result of one scan, original or changed; ``failure`` if it was not reconstructed.

    ``seed`` drew the change and the generated scans; ``source`` (digest of the sources) identifies
    the code. Forks are in the original's coordinates: ``x``, ``y``, ``z``, radius, probability.
    """

    scan: str
    change: str
    seed: int
    source: str
    length_m: float = np.nan
    volume_m3: float = np.nan
    length_interval_m: list[float] = field(default_factory=list)
    volume_interval_m3: list[float] = field(default_factory=list)
    forks: list[list[float]] = field(default_factory=list)
    failure: str = ""
    seconds: float = 0.0

    def off(self, other: "SameTreeRun") -> float:
        """Difference of length or volume from another run's, whichever is larger."""
        return max(abs(self.length_m / other.length_m - 1),
                   abs(self.volume_m3 / other.volume_m3 - 1))

    def agrees(self, other: "SameTreeRun") -> bool:
        """Whether the stated intervals of both runs overlap, of length and of volume."""
        return all(max(low, other_low) <= min(high, other_high) for (low, high), (
            other_low, other_high) in (
                (self.length_interval_m, other.length_interval_m),
                (self.volume_interval_m3, other.volume_interval_m3)))

    def other_forks(self, other: "SameTreeRun") -> tuple[int, int]:
        """Forks that only one of two runs has; and of these, those stated to be likely."""
        one, two = (np.array(run.forks, float).reshape(-1, 5) for run in (self, other))
        lone = np.concatenate([_alone(one, two), _alone(two, one)])
        return len(lone), int((lone[:, 4] >= _LIKELY).sum())


def _alone(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Forks of one tree, shape [k, 5], that the other one does not have."""
    if len(other) == 0 or len(one) == 0:
        return one
    away, near = cKDTree(other[:, :3]).query(one[:, :3])
    return one[away > _SAME_FORK * np.maximum(one[:, 3], other[near, 3])]


def subjects() -> list[str]:
    """Names of all scans: generated, of each world, real."""
    worlds = [f"{source}:{BARE_VIEWS[number % 2]}" for number, source in enumerate(SOURCES)]
    real = [Path(name).stem for name in SCANS] if DATA.is_dir() else []
    return ["round", "one-sided", *worlds, *real]


def same_tree_asked(names: str) -> Asked:
    """Measure of the row of one scan, or of all."""
    return Asked(f"{names}: unit, shift of 500 km, turn, shuffle, duplicates, outliers, ground, "
                 "threads; half: length and volume; forks that differ though stated likely",
                 "2 %; 8 %; 0; no crash")


def same_tree_rows(setting: Setting, only: str | None = None) -> list[Row]:
    """Each changed scan against the scan itself; ``only``: for one scan."""
    names = [only] if only else subjects()[:4] if setting.quick else subjects()
    runs = _runs(setting, [(name, change) for change in _CHANGED for name in names])
    first = {run.scan: run for run in runs if run.change == AS_IT_IS and not run.failure}
    crashes = [f"{run.scan} {run.change}: {run.failure}" for run in runs if run.failure]
    worst, half, agree, count, likely, every, notes = 0.0, 0.0, 0, 0, 0, 0, []
    for run in runs:
        if run.change == AS_IT_IS or run.failure or run.scan not in first:
            continue
        agree, count = agree + run.agrees(first[run.scan]), count + 1
        off, limit = run.off(first[run.scan]), _OFF_HALF if run.change == "half" else _OFF
        half, worst = (max(half, off), worst) if run.change == "half" else (half, max(worst, off))
        differ, sure = run.other_forks(first[run.scan])
        if run.change != "half":
            every, likely = every + differ, likely + sure
        if off > limit or (sure and run.change != "half"):
            notes.append(f"{run.scan} {run.change} {off:.1%}, {differ} forks ({sure} likely)")
    if not count and not crashes:
        return []
    return [Row(*same_tree_asked(only or "scans"),
                f"worst {worst:.1%}; {half:.1%}; {likely} of {every} forks that differ; "
                f"{len(crashes)} crashes; stated intervals meet in {agree} of {count}"
                + "".join(f"; {text}" for text in notes + crashes),
                worst < _OFF and half < _OFF_HALF and not crashes and not likely, count)]


def _runs(setting: Setting, tasks: list[tuple[str, str]]) -> list[SameTreeRun]:
    """Original or changed scans, as many as there is time for, including those kept."""
    kept = setting.kept / "same_tree.jsonl"
    source = source_digest(("geometry",), __file__, scan_cases.__file__)
    seed = 1000 * setting.seed
    earlier = [run for run in read_trials(SameTreeRun, kept) if run.seed == seed]
    return go_on(earlier, tasks, lambda run: (run.scan, run.change), partial(
        _run_of, seed=seed, source=source), source, kept, setting.budget, None, setting.progress)


def _run_of(task: tuple[str, str], seed: int, source: str) -> SameTreeRun:
    run = SameTreeRun(*task, seed, source)
    if run.change != "threads":
        return _run(run)
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = _THREADS
    try:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            return pool.submit(_run, run).result()
    finally:
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before


def _subject(name: str, seed: int) -> tuple[Cloud, dict]:
    if name in WORLDS:
        case = WORLDS[name](seed)
        return Cloud(case.points), case.settings
    if name in ("round", "one-sided"):
        return Cloud((round_case(seed) if name == "round" else one_sided_case(seed + 1)).points), {}
    cloud, settings = real_scan(name)
    return cloud, settings.model_dump(exclude_unset=True)


def _run(run: SameTreeRun) -> SameTreeRun:
    began = time.perf_counter()
    cloud, settings = _subject(run.scan, run.seed)
    rng = np.random.default_rng([run.seed, *run.change.encode()])
    cloud, settings, back = _CHANGED[run.change](cloud, {"leave_out": True} | settings, rng)
    try:
        made = reconstruct_cloud(cloud, ReconstructSettings(**{"root": "auto"} | settings))
    except Exception as error:  # a crash is what the row asks for
        seen = error.seen if isinstance(error, LimberError) else f"{type(error).__name__}: {error}"
        return replace(run, failure=seen, seconds=time.perf_counter() - began)
    return replace(run, length_m=made.numbers["length_m"],
                   volume_m3=made.numbers["mesh_volume_m3"],
                   length_interval_m=made.numbers["length_interval_m"],
                   volume_interval_m3=made.numbers["volume_interval_m3"],
                   forks=_forks(made, back), seconds=time.perf_counter() - began)


def _forks(made: Reconstruction, back: Back) -> list[list[float]]:
    """Forks in the original's coordinates, with radius in its unit and stated probability."""
    skeleton: Skeleton = made.meshed.skeleton
    forks = skeleton.forks()
    if len(forks) == 0:
        return []
    places = back(made.alignment.undo(skeleton.nodes))
    metre = float(np.linalg.norm(places[1] - places[0])
                  / max(np.linalg.norm(skeleton.nodes[1] - skeleton.nodes[0]), 1e-300))
    stated = [float(skeleton.probability[(skeleton.parent == fork) & (
        skeleton.branch != skeleton.branch[fork])].min()) for fork in forks]
    return [[*places[fork].tolist(), metre * float(skeleton.radius[fork]), chance]
            for fork, chance in zip(forks, stated, strict=True)]
