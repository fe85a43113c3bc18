"""Real scans beside the project, as they are, changed and degraded; and that a tree stays the same.

A change of a scan that leaves the plant as it is gives the same result; a degraded scan a length
that its interval holds. Lengths are compared with skeletons of others, where there are any.
"""

import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.transform import Rotation

from benchmarks.scan_cases import one_sided_case, round_case
from benchmarks.scan_scores import Dense, explained
from benchmarks.table import Asked, Row, Setting
from benchmarks.trials import Trial, sound
from benchmarks.worlds.sources import BARE_VIEWS, SOURCES, WORLDS
from limber.core.constants import UNIT_METRES
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.io.clouds import read_points
from limber.geometry.reconstruction import Reconstruction, ReconstructSettings, reconstruct_cloud
from limber.geometry.skeleton.skeleton import BRIDGED, Skeleton

DATA = Path(os.environ.get("LIMBER_SCANS") or (
    Path(__file__).resolve().parents[2].parent / "shared" / "data"))
AS_IT_IS = "as it is"
Back = Callable[[np.ndarray], np.ndarray]


# --- the scans --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scan:
    """A real scan.

    Attributes:
        file: Path under the data's folder.
        settings: What its user states.
        bare: Whether it has no leaves.
        reference: Returns another's skeleton as line segments in the scan's coordinates [m], shape
            [k, 2, 3], each from the root outwards; None: there is none.
    """

    file: str
    settings: dict[str, Any]
    bare: bool
    reference: Callable[[], np.ndarray] | None = None


def _graph(name: str) -> np.ndarray:
    lines = [line.split() for line in (DATA / name).read_text().splitlines()]
    nodes = np.array([line[1:4] for line in lines if line[:1] == ["v"]], float) / 1000
    return nodes[np.array([line[1:3] for line in lines if line[:1] == ["e"]], int)]


def _cylinders(name: str) -> np.ndarray:
    rows = np.genfromtxt(DATA / name, delimiter=",", names=True)
    return np.stack([np.stack([rows[end + axis] for axis in "xyz"], axis=1) for end in "se"], 1)


def _tree(name: str) -> np.ndarray:
    with np.load(DATA / name) as tree:
        return np.stack([tree["nodes"][tree["par"][1:]], tree["nodes"][1:]], axis=1) / 1000


_PUU, _CHAOS = "reports/09-puu933-bare-branch/", "reports/47-sparse-real-twig-chaos/"
_MM, _DOWN = {"unit": "mm"}, {"unit": "mm", "up": (0.0, -1.0, 0.0)}
_CUT = {"unexplained": 1.0, "leaves": "cut"}
_KEEP = {"leaves": "keep"}  # the others' skeletons go through leaves
_TOMATO, _MAIZE = (f"tomato_maize/{name}" for name in ("tomato_03-05", "maize_03-13"))
SCANS = {
    "coffee": Scan("coffeetree_branch/branch.xyz", {}, True),
    "tree": Scan("aRchi_tree_1/Tree_1.ply", {}, True,
                 partial(_cylinders, "aRchi_tree_1/Tree_1_cylinders_TreeQSM.csv")),
    "apple-25": Scan("apple_rgbd/frame_00025.ply", _DOWN, True),
    "apple-125": Scan("apple_rgbd/frame_00125.ply", _DOWN, True),
    "tomato": Scan(f"{_TOMATO}.xyz", _MM | _CUT, False, partial(_graph, f"{_TOMATO}.graph.txt")),
    "maize": Scan(f"{_MAIZE}.ply", _MM | _CUT, False, partial(_graph, f"{_MAIZE}.graph.txt")),
    "puu": Scan(_PUU + "puu_933.xyz", _MM | {"root": (-900.0, 793.0, 2060.0)}, True,
                partial(_tree, _PUU + "reference_skeleton.npz")),
    "puu-670": Scan(_CHAOS + "puu_670.xyz", _MM, True, partial(_tree, _CHAOS + "puu_670_ref.npz"))}
WHOLE = {"tomato in leaf": Scan(f"{_TOMATO}.xyz", _MM | _KEEP, False, SCANS["tomato"].reference),
          "maize in leaf": Scan(f"{_MAIZE}.ply", _MM | _KEEP, False, SCANS["maize"].reference)}
_REAL = SCANS | WHOLE
_COMPARED = ("puu", "puu-670", "tomato in leaf", "tree", "coffee", "maize in leaf", "apple-25",
             "apple-125")
"""Scans of the rows on lengths, in their order."""


def present(names: tuple[str, ...] = tuple(SCANS)) -> list[str]:
    """Return the names of scans whose files are there."""
    return [name for name in names if (DATA / _REAL[name].file).is_file()]


@cache
def reference_length(name: str) -> float | None:
    """Length of another's skeleton of a scan [m], if there is one."""
    other = _REAL[name].reference
    return None if other is None else float(np.linalg.norm(np.diff(other(), axis=1), axis=2).sum())


# --- changes ----------------------------------------------------------------------------------


def _of_points(change: Callable) -> Callable:
    """A change of the points alone."""
    return lambda cloud, settings, rng: (Cloud(change(cloud.points, rng)), settings, unmoved)


def _half(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return points[np.sort(rng.permutation(len(points))[:len(points) // 2])]


def _turned(cloud: Cloud, settings: dict, rng: np.random.Generator) -> tuple[Cloud, dict, Back]:
    """About the vertical."""
    up = np.array(settings.get("up", (0.0, 0.0, 1.0)))
    turn = Rotation.from_rotvec(
        rng.uniform(0, 2 * np.pi) * up / np.linalg.norm(up)).as_matrix()
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


def _doubled(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A fifth of the points twice."""
    return np.vstack([points, points[rng.choice(len(points), len(points) // 5, replace=False)]])


def _with_outliers(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """1 % of points anywhere in the bounding box."""
    box = points.min(axis=0), points.max(axis=0)
    return np.vstack([points, rng.uniform(*box, (len(points) // 100, 3))])


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
    return Cloud(np.concatenate([cloud.points, ground])), settings, unmoved


def _as_it_is(cloud: Cloud, settings: dict, rng: np.random.Generator) -> tuple[Cloud, dict, Back]:
    return cloud, settings, unmoved


def unmoved(places: np.ndarray) -> np.ndarray:
    """Return places of a changed scan whose coordinates stayed."""
    return places


def _placed(cloud: Cloud, settings: dict, there: Back, back: Back) -> tuple[Cloud, dict, Back]:
    """The cloud with the places that the settings state moved along with it."""
    if settings.get("root") is not None:
        root = there(np.array([settings["root"]], float))[0]
        settings = settings | {"root": tuple(root.tolist())}
    return cloud, settings, back


def _one_sided(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What one station sees: hidden points by the inverted hull (Katz, Tal, Basri 2007)."""
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    angle = rng.uniform(0, 2 * np.pi)
    seen = points - (points.mean(axis=0) + 2 * size * np.array([np.cos(angle), np.sin(angle), 0.1]))
    far = np.linalg.norm(seen, axis=1)
    flipped = seen * ((2 * 10**3.2 * far.max() - far) / far)[:, None]
    corners = ConvexHull(np.vstack([flipped, np.zeros(3)])).vertices
    return points[np.sort(corners[corners < len(points)])]


def _cut(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """With three holes of 2 % of the size each, as where leaves or a clamp hid the wood."""
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    holes = points[rng.integers(len(points), size=3)]
    return points[cKDTree(holes).query(points)[0] > 0.01 * size]


def _noisy(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """With heavy-tailed errors of a quarter of the point spacing."""
    spacing = float(np.median(cKDTree(points).query(points, k=2)[0][:, 1]))
    return points + 0.25 * spacing * rng.standard_t(3, size=points.shape)


CHANGED = {AS_IT_IS: _as_it_is, "half": _of_points(_half), "turn": _turned,
           "shuffle": _of_points(lambda points, rng: rng.permutation(points)), "shift": _shifted,
           "unit": _in_unit, "duplicates": _of_points(_doubled),
           "outliers": _of_points(_with_outliers), "ground": _on_ground, "threads": _as_it_is}
"""Changes to a scan, the most informative first."""
DEGRADED: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    "one-sided": _one_sided, "cut": _cut, "noisy": _noisy}
"""Ways in which scans of others are worse than ours; half of the points are another."""
_OFF, _OFF_HALF = 0.02, 0.08  # of length and volume
_FAR = 5e5  # [m] that a scan is shifted
_THREADS = "4"
_SAME_FORK = 3.0  # radii within which two forks are the same
_LIKELY = 0.8  # probability from which a fork must be in both trees


# --- trials -----------------------------------------------------------------------------------


def runs(setting: Setting, tasks: list[tuple[str, str]]) -> list[Trial]:
    """Trials of scans and changes, as many as there is time for; a crash is a failure too."""
    seed = 1000 * setting.seed
    return setting.trials("real scans", [(*task, seed) for task in tasks], measured, "geometry",
                          workers=None, catch=Exception)


def measured(task: tuple[str, str, int]) -> dict[str, Any]:
    """Reconstruct a scan, as it is or changed: the numbers of all rows.

    ``forks``: in the original's coordinates x, y, z, radius, probability.
    """
    if task[1] != "threads":
        return _measured(task)
    with patch.dict(os.environ, OMP_NUM_THREADS=_THREADS), ProcessPoolExecutor(
            1, mp_context=get_context("spawn")) as pool:
        return pool.submit(_measured, task).result()


def _measured(task: tuple[str, str, int]) -> dict[str, Any]:
    name, change, seed = task
    cloud, settings = _subject(name, seed)
    rng, back = np.random.default_rng([seed, *change.encode()]), unmoved
    if change in DEGRADED:
        cloud = Cloud(DEGRADED[change](cloud.points, rng))
    else:
        cloud, settings, back = CHANGED[change](cloud, settings, rng)
    made = reconstruct_cloud(cloud, ReconstructSettings(
        **{"leave_out": True, "root": "auto"} | settings))
    numbers, skeleton = made.numbers, made.meshed.skeleton
    found = {"length_m": numbers["length_m"], "length_interval_m": numbers["length_interval_m"],
             "volume_m3": numbers["mesh_volume_m3"],
             "volume_interval_m3": numbers["volume_interval_m3"], "forks": _forks(made, back),
             "watertight": numbers["watertight"], "tets": numbers["tet_count"]}
    if name not in _REAL or change not in (AS_IT_IS, "half", *DEGRADED):
        return found
    dropped, leaf = numbers["dropped_points"], made.cloud.attributes.get("leaf", np.zeros(1))
    axes = skeleton.moved(made.alignment.undo(skeleton.nodes)
                          * UNIT_METRES[settings.get("unit", "m")])
    other = _REAL[name].reference
    return found | {
        "off_points": off_any_point(made), "explained": explained(made.cloud.points, skeleton),
        "called_leaf": float(np.mean(leaf)), "flying": dropped.get("flying", 0) / dropped["read"],
        **({} if other is None else {"beyond_m": beyond_ends(np.stack(
            [axes.nodes[axes.parent[1:]], axes.nodes[1:]], axis=1), other())}),
        **({"radius_off": _radii_off(axes)} if name == "tree" else {})}


def _subject(name: str, seed: int) -> tuple[Cloud, dict[str, Any]]:
    if name in WORLDS:
        case = WORLDS[name](seed)
        return Cloud(case.points), case.settings
    if name in ("round", "one-sided"):
        return Cloud((round_case(seed) if name == "round" else one_sided_case(seed + 1)).points), {}
    return raw_scan(name)


def raw_scan(name: str) -> tuple[Cloud, dict[str, Any]]:
    """Return a real scan in its file's unit, and what its user states."""
    return read_points(DATA / _REAL[name].file), _REAL[name].settings


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


def off_any_point(made: Reconstruction) -> float:
    """Fraction of the axes' length whose surface is more than a radius from all points."""
    skeleton = made.meshed.skeleton
    here = Dense.of(skeleton, step=0.25 * float(np.median(skeleton.radius)))
    distance, _ = cKDTree(made.cloud.points).query(here.points)
    asked = skeleton.radius_state[here.high] != BRIDGED
    return float((distance > 2 * here.radius)[asked].mean())


def _radii_off(axes: Skeleton) -> list[float]:
    """Radii over 5 mm against TreeQSM's of the tree: median, median size; share compared."""
    rows = np.genfromtxt(DATA / "aRchi_tree_1/Tree_1_cylinders_TreeQSM.csv", delimiter=",",
                         names=True)
    rows = rows[rows["radius"] > 0.005]
    middle = np.stack([rows["s" + axis] + rows["e" + axis] for axis in "xyz"], axis=1) / 2
    here = Dense.of(axes, step=0.02)
    distance, near = cKDTree(here.points).query(middle)
    close = distance < 2 * rows["radius"]
    ratio = here.radius[near[close]] / rows["radius"][close] - 1
    return [float(np.median(ratio)), float(np.median(np.abs(ratio))), float(close.mean())
            ] if close.any() else [np.nan, np.nan, 0.0]


def beyond_ends(found: np.ndarray, reference: np.ndarray) -> float:
    """Length [m] of axes that go on beyond the free ends of another's skeleton.

    It lies nearest to such an end, and less to the side of its last segment than along it.

    Args:
        found, reference: Line segments [m], shape [k, 2, 3] each.
    """
    ends, count = np.unique(np.round(reference.reshape(-1, 3), 6), axis=0, return_counts=True)
    free = cKDTree(ends[count == 1])
    share = (np.arange(10) + 0.5)[:, None] / 10
    here, there = (each[:, None, 0] + share * (each[:, None, 1] - each[:, None, 0])
                   for each in (found, reference))
    away, near = cKDTree(there.reshape(-1, 3)).query(here.reshape(-1, 3))
    segment = reference[near // 10]
    step = np.linalg.norm(found[:, 1] - found[:, 0], axis=1) / 10
    out = np.zeros(len(away), bool)
    for end in (0, 1):
        last = free.query(segment[:, end])[0] < 2e-6
        way = segment[:, end] - segment[:, 1 - end]
        way /= np.maximum(np.linalg.norm(way, axis=1), 1e-300)[:, None]
        offset = here.reshape(-1, 3) - segment[:, end]
        along = np.einsum("kj,kj->k", offset, way)
        out |= last & (along > np.sqrt(0.5) * np.linalg.norm(offset, axis=1))
    return float(np.repeat(step, 10)[out].sum())


# --- rows -------------------------------------------------------------------------------------

REAL_ROW = Asked("real scans: tube length more than a radius off any point, bridges aside",
                 "under 8 %")
SURFACES = Asked("real scans: surface watertight, no self-intersection; points no farther outside "
                 "a branch than twice their spacing", "all; report")
QSM = Asked("aRchi_tree_1: radii over 5 mm against TreeQSM's", "report")
REAL = Asked("worlds, real scans with independent skeletons: length within its stated interval; "
             "median error; refused though bare", "90 %; 8 %; 0")
WORSE = Asked("worlds, the same degraded (half, one-sided, cut, noisy)", "90 %; 8 %; 0")
BARE = Asked("worlds, bare real scans: points called leaf or flying pixel", "under 1 % each")
_INSIDE = 0.9  # fraction of lengths that their intervals must hold


def _why(trial: Trial) -> str:
    return f"{trial.task[0]} {trial.task[1]}: {trial.failure.splitlines()[0]}"


def real_rows(setting: Setting) -> list[Row]:
    """Fraction of tube length more than a radius off any point, bridges excluded."""
    names = present()[:3:2] if setting.quick else present()
    done = runs(setting, [(name, AS_IT_IS) for name in names])
    if not done:
        return [Row(*REAL_ROW, "not measured: no ../shared/data", None, 0)]
    shares = {run.task[0]: run["off_points"] for run in sound(done)}
    failed = [_why(run) for run in done if run.failure]
    told = ", ".join(f"{name} {share:.1%}" for name, share in shares.items())
    met = bool(shares and max(shares.values()) < 0.08 and not failed)
    return [Row(*REAL_ROW, "; ".join([told, *failed]), met, len(done)), *_body_rows(sound(done))]


def _body_rows(done: list[Trial]) -> list[Row]:
    whole = sum(run["watertight"] for run in done)
    told = "; ".join(f"{run.task[0]} {run['explained']:.0%}" for run in done)
    rows = [Row(*SURFACES, f"{whole} of {len(done)}; {told}", whole == len(done), len(done))]
    for median, size, share in (run["radius_off"] for run in done if run.task[0] == "tree"):
        rows.append(Row(*QSM, f"median {median:+.0%}, median |difference| {size:.0%} on "
                        f"{share:.0%} of its cylinders", None))
    return rows


def length_rows(setting: Setting) -> list[Row]:
    """Lengths of real scans and of degraded ones against others' skeletons; none without data."""
    names = present(_COMPARED)
    tasks = [(name, AS_IT_IS) for name in names]
    if not setting.quick:
        tasks += [(name, change) for change in ("half", *DEGRADED) for name in names
                  if _REAL[name].reference is not None]
    done = runs(setting, tasks)
    plain = [run for run in done if run.task[1] == AS_IT_IS]
    return [*_length_row(REAL, plain), *_bare_row(plain),
            *_length_row(WORSE, [run for run in done if run.task[1] != AS_IT_IS])]


def _length_row(asked: Asked, trials: list[Trial]) -> list[Row]:
    trials = [run for run in trials if reference_length(run.task[0]) is not None]
    if not trials:
        return []
    done, failed = sound(trials), [run for run in trials if run.failure]
    refused = [run for run in failed if _REAL[run.task[0]].bare]
    held, off, each = [], [], []
    for run in done:
        (low, high), true = run["length_interval_m"], reference_length(run.task[0])
        held.append(low <= true <= high)
        off.append(run["length_m"] / true - 1)
        each.append(f"{run.task[0]} {run.task[1]} {100 * off[-1]:+.0f} % ("
                    f"{100 * ((run['length_m'] - run['beyond_m']) / true - 1):+.0f} % up to the "
                    f"other's ends){'' if held[-1] else ' outside'}")
    share, middle = (float(np.mean(held)), float(np.median(np.abs(off)))) if done else (0.0, np.inf)
    return [Row(*asked, f"{sum(held)} of {len(done)}; {middle:.1%}; {len(refused)}: "
                f"{'; '.join([*each, *map(_why, failed)])}",
                bool(share >= _INSIDE and middle <= 0.08 and not refused), len(trials))]


def _bare_row(trials: list[Trial]) -> list[Row]:
    bare = [run for run in trials if _REAL[run.task[0]].bare]
    each = [_why(run) if run.failure else
            f"{run.task[0]} {run['called_leaf']:.1%} / {run['flying']:.1%}" for run in bare]
    good = all(not run.failure and max(run["called_leaf"], run["flying"]) < 0.01 for run in bare)
    return [Row(*BARE, "; ".join(each), good, len(bare))] if bare else []


def subjects() -> list[str]:
    """Names of all scans of the same tree's row: generated, of each world, real."""
    worlds = [f"{source}:{BARE_VIEWS[number % 2]}" for number, source in enumerate(SOURCES)]
    return ["round", "one-sided", *worlds, *present()]


SAME_TREE = Asked("scans: unit, shift of 500 km, turn, shuffle, duplicates, outliers, ground, "
                  "threads; half: length and volume; forks that differ though stated likely",
                  "2 %; 8 %; 0; no crash")


def same_tree_rows(setting: Setting) -> list[Row]:
    """Each changed scan against the scan itself."""
    names = subjects()[:4] if setting.quick else subjects()
    done = runs(setting, [(name, change) for change in CHANGED for name in names])
    first = {run.task[0]: run for run in sound(done) if run.task[1] == AS_IT_IS}
    crashes = [_why(run) for run in done if run.failure]
    changed = [run for run in sound(done) if run.task[1] != AS_IT_IS and run.task[0] in first]
    worst, half, likely, every, agree, notes = 0.0, 0.0, 0, 0, 0, []
    for run in changed:
        other, is_half = first[run.task[0]], run.task[1] == "half"
        off = max(abs(run[name] / other[name] - 1) for name in ("length_m", "volume_m3"))
        differ, sure = other_forks(run["forks"], other["forks"])
        agree += all(max(run[name][0], other[name][0]) <= min(run[name][1], other[name][1])
                     for name in ("length_interval_m", "volume_interval_m3"))
        half = max(half, is_half * off)
        if not is_half:
            worst, every, likely = max(worst, off), every + differ, likely + sure
        if off > (_OFF_HALF if is_half else _OFF) or (sure and not is_half):
            notes.append(f"{run.task[0]} {run.task[1]} {off:.1%}, {differ} forks ({sure} likely)")
    if not changed and not crashes:
        return []
    return [Row(*SAME_TREE,
                f"worst {worst:.1%}; {half:.1%}; {likely} of {every} forks that differ; "
                f"{len(crashes)} crashes; stated intervals meet in {agree} of {len(changed)}"
                + "".join(f"; {text}" for text in notes + crashes),
                worst < _OFF and half < _OFF_HALF and not crashes and not likely, len(changed))]


def other_forks(one: list[list[float]], other: list[list[float]]) -> tuple[int, int]:
    """Forks that only one of two trees has; and of these, those stated to be likely."""
    here, there = (np.array(forks, float).reshape(-1, 5) for forks in (one, other))
    lone = np.concatenate([_alone(here, there), _alone(there, here)])
    return len(lone), int((lone[:, 4] >= _LIKELY).sum())


def _alone(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Forks of one tree, shape [k, 5], that the other one does not have."""
    if len(other) == 0 or len(one) == 0:
        return one
    away, near = cKDTree(other[:, :3]).query(one[:, :3])
    return one[away > _SAME_FORK * np.maximum(one[:, 3], other[near, 3])]
