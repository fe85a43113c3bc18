"""Reconstructions of cases with known truth, as a user makes them, and their scores."""

import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from benchmarks.scan_cases import KINDS, ScanCase
from benchmarks.table import Setting
from benchmarks.trials import Trial, column, sound
from benchmarks.worlds.sources import WORLDS
from limber.core.alignment import Alignment
from limber.geometry.io.clouds import read_points
from limber.geometry.io.skeletons import read_cylinders
from limber.geometry.settings import SkeletonSettings
from limber.geometry.skeleton.radii.fit_kernels import nearest_cylinders
from limber.geometry.skeleton.radii.nearest_points import nearest_point_radii
from limber.geometry.skeleton.skeleton import Skeleton
from limber.stages.shape.reconstruct import Reconstruct

_STEP = 0.001  # [m] between the places on the axes that are compared
_DETOUR, _AROUND = 1.5, 3.0  # longest true path of a true bridge, in its lengths plus these radii
_SAME = 1e-4  # [m] between a point and its copy in a file of single precision
_FEW = 8  # points of a twig, under which nothing is lost with it
_MOST = 0.5  # of a twig's points, that are dropped with it


# --- cases ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcomes:
    """Trials of one kind of case; a case that could not be reconstructed is a failure."""

    trials: Sequence[Trial]

    @property
    def scores(self) -> list[Trial]:
        return sound(self.trials)

    @property
    def failed(self) -> list[str]:
        return [f"{trial.task[0]} {trial.task[1]}: {trial.failure}" for trial in self.trials
                if trial.failure]

    @property
    def count(self) -> int:
        return len(self.trials)

    def column(self, key: str) -> np.ndarray:
        return column(self.scores, key)

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

    def told(self, most: int = 0) -> str:
        """Number of failed cases, and the first reasons."""
        failed = self.failed
        return f"; {len(failed)} not reconstructed" + (
            f": {'; '.join(failed[:most])}" if most else "") if failed else ""


def outcomes(setting: Setting, counts: dict[str, int]) -> dict[str, Outcomes]:
    """Reconstruct and score cases of each kind in turn, as many as there is time for.

    Args:
        setting: Cases kept from other parts or an earlier run are not repeated.
        counts: Most cases of each kind.
    """
    seeds = setting.seeds(max(counts.values()), max(counts.values()))
    trials = setting.trials(
        "cases", [(kind, seed) for seed in seeds for kind, count in counts.items()
                  if seed < seeds.start + count],
        scored_case, "geometry", workers=None, catch=Exception)
    return {kind: Outcomes([trial for trial in trials if trial.task[0] == kind]) for kind in counts}


def scored_case(task: tuple[str, int]) -> dict[str, Any]:
    """Write the file of a case by kind and seed, reconstruct it, score it in the file's frame."""
    with tempfile.TemporaryDirectory() as folder:
        return _scored((KINDS | WORLDS)[task[0]](task[1]), Path(folder))


def _scored(case: ScanCase, folder: Path) -> dict[str, Any]:
    path, branch = case.write(folder), folder / f"{case.name}.branch"
    result = Reconstruct(cloud=path, output=branch, **{"root": "auto"} | case.settings).run()
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
               "length_held": held(result["length_interval_m"], seen.length),
               "volume_held": held(result["volume_interval_m3"], shown * case.volume)
               if case.volume else True,
               "volume": result["mesh_volume_m3"] / (shown * case.volume) - 1 if case.volume else (
                   0.0)}
    if case.leaf is not None:
        scored["leaf_points_on_stems"] = points_on_axes(case.points[case.leaf], case.truth, found)
    paper = nearest_point_radii(found, case.points, SkeletonSettings()).radius
    scored["paper"] = float(np.median(np.abs(paper / found.radius - 1)))
    scored["watertight"] = result["watertight"]
    return scored | dropped_points(case, branch)


def held(interval: list[float], value: float) -> bool:
    """Whether an interval contains a true value."""
    return interval[0] <= value <= interval[1]


def dropped_points(case: ScanCase, branch: Path) -> dict[str, float]:
    """Fractions of wood's points called leaf or dropped before; twigs mostly lost so; leaves kept.

    Args:
        case: The case.
        branch: Folder of its reconstruction.
    """
    cloud = read_points(branch / "cloud.ply")
    alignment = Alignment.model_validate(json.loads((branch / "branch.json").read_text())[
        "alignment"])
    away, near = cKDTree(alignment.undo(cloud.points)).query(case.points)
    called = np.asarray(cloud.attributes.get("leaf", np.zeros(len(cloud)))) > 0
    gone = away > _SAME
    leaf = ~gone & called[near]
    wood = np.ones(len(gone), bool) if case.leaf is None else ~case.leaf
    run = case.truth.branch[nearest_cylinders(case.truth, case.points[wood])[0]]
    total = np.bincount(run)
    lost = np.bincount(run, (gone | leaf)[wood], len(total))
    return {"called_leaf": float(leaf[wood].mean()), "gone": float(gone[wood].mean()),
            "twigs_lost": int(((total >= _FEW) & (lost > _MOST * total)).sum())}


# --- scores -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Dense:
    """Points on a skeleton's axes, a millimetre apart; each represents the same length.

    Attributes:
        points: Positions [m], shape [n, 3].
        radius: Radius of the axis there [m], shape [n].
        low, high: The nodes before and after, shape [n] each.
        share: Fraction of the distance from ``low`` to ``high``, shape [n].
    """

    points: np.ndarray
    radius: np.ndarray
    low: np.ndarray
    high: np.ndarray
    share: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton, chain: np.ndarray | None = None, step: float = _STEP,
           ) -> "Dense":
        """Points of the whole skeleton, or of one ``chain`` of nodes from the root outwards."""
        low = skeleton.parent[1:] if chain is None else chain[:-1]
        high = np.arange(1, skeleton.node_count) if chain is None else chain[1:]
        length = np.linalg.norm(skeleton.nodes[high] - skeleton.nodes[low], axis=1)
        count = np.maximum(np.round(length / step).astype(int), 1)
        share = np.concatenate([(np.arange(n) + 0.5) / n for n in count])
        low, high = np.repeat(low, count), np.repeat(high, count)
        points = (1 - share)[:, None] * skeleton.nodes[low] + share[:, None] * skeleton.nodes[high]
        own = skeleton.branch[low] != skeleton.branch[high]
        radius = np.where(own, skeleton.radius[high],
                          (1 - share) * skeleton.radius[low] + share * skeleton.radius[high])
        return cls(points, radius, low, high, share)


def seen_part(truth: Skeleton, points: np.ndarray, margin: float = 2 * _STEP) -> Skeleton:
    """The part of the truth that a scan shows: ends beyond the last point near them are cut off.

    A stretch between points is required, whatever its length. Wood beyond all points is not, nor is
    a twig without points of its own: its carrier's points do not show its base. Points count up to
    ``margin`` [m] and a quarter radius off the wood.
    """
    run, distance = truth.branch[nearest_cylinders(truth, points)[0]], np.full(
        truth.node_count, np.inf)
    for number in np.unique(run):
        own = truth.branch == number
        distance[own] = cKDTree(points[run == number]).query(truth.nodes[own])[0]
    shown = distance < truth.radius + margin + 0.25 * truth.radius
    below = shown.copy()
    for node in range(truth.node_count - 1, 0, -1):
        below[truth.parent[node]] |= below[node]
    start = 0
    children = truth.child_counts()
    while not shown[start] and children[start] == 1:
        start = int(np.flatnonzero(truth.parent == start)[0])
    below[:start] = False
    parent = truth.parent[below]
    parent = np.where(np.arange(len(parent)) == 0, -1, (np.cumsum(below) - 1)[parent])
    return Skeleton.from_edges(truth.nodes[below], parent, truth.radius[below])


def cylinder_volume(skeleton: Skeleton) -> float:
    """Volume of a skeleton's cylinders [m^3], forks counted twice."""
    length = np.linalg.norm(skeleton.nodes[1:] - skeleton.nodes[skeleton.parent[1:]], axis=1)
    return float(np.pi * (length * skeleton.radius[1:]**2).sum())


def fork_matches(truth: Skeleton, found: Skeleton) -> tuple[int, np.ndarray]:
    """Number of true side branches whose fork was found, and whether that of each found one is
    true, shape [side branches].

    A fork counts as found within three radii of the true one. Side branches are matched one to
    one, as many as possible: of a pair at one node each counts, found at one node or at two.
    """
    wanted, got = (np.array([run[0] for run in tree.runs()[1:]], int) for tree in (truth, found))
    away = cdist(truth.nodes[wanted], found.nodes[got]) / (3 * truth.radius[wanted])[:, None]
    one, other = linear_sum_assignment(np.where(away < 1, away, len(wanted) + 1.0))
    right = np.zeros(len(got), bool)
    right[other[away[one, other] < 1]] = True
    return int(right.sum()), right


def score(truth: Skeleton, found: Skeleton) -> dict[str, float]:
    """Compare centrelines, radii, stated intervals, forks, root, main axis and lengths."""
    there, here = Dense.of(truth), Dense.of(found)
    away, near = cKDTree(there.points).query(here.points)
    back, _ = cKDTree(here.points).query(there.points)
    in_radii = np.concatenate([away / there.radius[near], back / there.radius])
    error = here.radius / there.radius[near] - 1
    hits, true_fork = fork_matches(truth, found)
    right = (away < np.maximum(there.radius[near], 0.001)) & ~doubled(found, here, near)
    on_axis = away < 1.5 * there.radius[near]
    covered = np.abs(here.radius - there.radius[near]) < 1.96 * found.radius_sigma[here.high]
    main_off = main_axis_error(truth, found)
    stated = [float(found.probability[run[1]]) for run in found.runs()[1:]]
    return {
        "centre_m": float(np.concatenate([away, back]).mean()),
        "centre_radii": float(in_radii.mean()),
        "radius_error": float(np.median(np.abs(error))), "radius_bias": float(np.median(error)),
        "covered": float(covered[on_axis].mean()),
        **twig_lengths(there, back, truth, here, right, found),
        "forks": truth.branch_count - 1, "forks_found": hits,
        "forks_false": int((~true_fork).sum()),
        "main_axis_radii": main_off, "length_error": found.length / truth.length - 1,
        "told_forks": [[p, bool(r)] for p, r in zip(stated, true_fork, strict=True)],
        "told_nodes": _told_nodes(found.probability[here.high], right, found.branch[here.high]),
        "recall": float((back < np.maximum(there.radius, 0.001)).mean()),
        "right": float(right.mean())}


def bridges_right(bridges: list[dict], truth: Skeleton) -> np.ndarray:
    """Whether the truth joins the ends of each bridge by about as short a path, shape [bridges].

    Args:
        bridges: Each with ``from``, ``to`` [m, 3], in the truth's frame, and ``length`` [m].
        truth: The true axes.
    """
    here = Dense.of(truth)
    tree = cKDTree(here.points)
    graph = coo_matrix((truth.steps[1:], (truth.parent[1:], np.arange(1, truth.node_count))),
                       (truth.node_count,) * 2).tocsr()
    there = []
    for bridge in bridges:
        away, near = tree.query(np.array([bridge["from"], bridge["to"]], float))
        path = dijkstra(graph, directed=False, indices=int(here.high[near[0]]))[here.high[near[1]]]
        radius = np.maximum(here.radius[near], _STEP)
        there.append(bool((away < 2 * radius).all()
                          and path <= _DETOUR * bridge["length"] + _AROUND * radius.max()))
    return np.array(there, bool)


def twig_lengths(there: Dense, back: np.ndarray, truth: Skeleton, here: Dense,
                 right: np.ndarray, found: Skeleton) -> dict[str, float]:
    """Length of side runs [m]: true, of these found, and of found ones what is false."""
    twig = truth.branch[there.high] != 0
    held = back[twig] < np.maximum(there.radius[twig], 0.001)
    false = (found.branch[here.high] != 0) & ~right
    return {"twig_m": _STEP * float(twig.sum()), "twig_found_m": _STEP * float(held.sum()),
            "twig_false_m": _STEP * float(false.sum())}


def doubled(found: Skeleton, here: Dense, near: np.ndarray) -> np.ndarray:
    """Which places are on a run that mostly coincides with its carrier: not a run of its own.

    Args:
        found: The found skeleton.
        here: Places on it.
        near: The nearest true place to each.
    """
    run, twice = found.branch[here.high], np.zeros(len(near), bool)
    for number, members in enumerate(found.runs()[1:], start=1):
        own, carrier = run == number, run == found.branch[members[0]]
        twice |= own & (np.isin(near[own], near[carrier]).mean() > 0.5 if own.any() else False)
    return twice


def _told_nodes(stated: np.ndarray, right: np.ndarray, branch: np.ndarray) -> list[list[float]]:
    """For each tenth of stated probabilities: length, sum stated, sum correct, and branches."""
    place = np.minimum((10 * stated).astype(int), 9)
    return [[float(np.bincount(place, values, 10)[k]) for values in (
        np.ones(len(place)), stated, right.astype(float))]
        + [len(np.unique(branch[place == k]))] for k in range(10)]


def points_on_axes(points: np.ndarray, truth: Skeleton, found: Skeleton) -> float:
    """Fraction of points [m], shape [n, 3], that are on a found axis and on no true one."""
    there, here = Dense.of(truth), Dense.of(found)
    distance, place = cKDTree(here.points).query(points)
    away, near = cKDTree(there.points).query(points)
    return float(((distance < 1.5 * here.radius[place])
                  & (away > there.radius[near] + 0.002)).mean())


def main_axis_error(truth: Skeleton, found: Skeleton) -> float:
    """Largest distance of the path to the true main tip from the true main axis, in its radii.

    In both directions: the found axis must be on the true axis, and the true one on the found one.
    """
    main = truth.runs()[0]
    axis = Dense.of(truth, main)
    tip = int(np.argmin(np.linalg.norm(found.nodes - truth.nodes[main[-1]], axis=1)))
    way = [tip]
    while found.parent[way[-1]] >= 0:
        way.append(int(found.parent[way[-1]]))
    if len(way) < 2:
        return np.inf
    ours = Dense.of(found, np.array(way[::-1]))
    away, near = cKDTree(axis.points).query(ours.points)
    back, _ = cKDTree(ours.points).query(axis.points)
    # The ends may be a radius short: no scan shows where exactly a round tip's axis ends.
    inner = slice(int(2 * truth.radius[0] / _STEP), len(back) - int(3 * axis.radius[-1] / _STEP))
    return float(max((away / axis.radius[near]).max(), (back / axis.radius)[inner].max()))


def explained(points: np.ndarray, skeleton: Skeleton) -> float:
    """Fraction of points no farther outside a branch than twice their own spacing."""
    _, residual = nearest_cylinders(skeleton, points)
    own = np.median(cKDTree(points).query(points, k=min(5, len(points)))[0][:, 1:], axis=1)
    return float((residual <= 2 * own).mean())
