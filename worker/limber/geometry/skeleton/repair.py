"""The repairs that fit a skeleton of contracted points to the scan, as an ordered list."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from limber.core.progress import SILENT, Progress
from limber.geometry.cloud.single_view import View
from limber.geometry.skeleton.confidence import KINK, assessed, doubted, turns
from limber.geometry.skeleton.radii.axis_fit import AxisFit, fit_axes
from limber.geometry.skeleton.radii.sampling_evidence import fit_of_rays
from limber.geometry.skeleton.radii.stations import registered
from limber.geometry.skeleton.run_ends import (
    ends_within,
    steadied,
    with_full_tips,
    without_bare_ends,
)
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.sweep import arc_lengths, resample

# Attachment of twigs to their carriers.


# Nodes at a twig's start that may mislead, and nodes that show its direction.
_MISLEADING_NODES, _NODES_AHEAD = 5, 7
_KINK = np.deg2rad(50.0)
# Longest start of a twig, in radii of its carrier; least kink at its end; nodes to each side.
_HOOK_REACH, _SHARP_KINK, _BESIDE = 6.0, np.deg2rad(45.0), 3
_LINE = 2.0  # length of a twig's start in carrier radii over which its direction is measured


def attached(skeleton: Skeleton) -> Skeleton:
    """Attach side runs where their own direction meets the carrier's axis, as contraction draws
    forks outwards: nodes inside the carrier are dropped, and the line is extended back."""
    parent, keep = skeleton.parent.copy(), np.ones(skeleton.node_count, bool)
    runs = skeleton.runs()
    for run in range(1, len(runs)):
        members = runs[run][1:]
        carrier = runs[int(skeleton.branch[skeleton.parent[members[0]]])]
        distance, near = cKDTree(skeleton.nodes[carrier]).query(skeleton.nodes[members])
        outside = distance > 1.05 * skeleton.radius[carrier[near]]
        first = int(np.argmax(outside)) if outside.any() else len(members) - 1
        first = _past_hook(skeleton, members, min(first, max(len(members) - 2, 0)))
        keep[members[:first]] = False
        # A very thin run's first nodes are so close together that there is only noise between them.
        along = np.cumsum(np.linalg.norm(np.diff(skeleton.nodes[members[first:]], axis=0), axis=1))
        least = int(np.searchsorted(along, _LINE * skeleton.radius[carrier[near[first]]])) + 2
        ahead = members[first:first + max(least, 5)]
        if len(ahead) < 2:
            parent[members[first]] = carrier[near[first]]
            continue
        direction = skeleton.nodes[ahead[-1]] - skeleton.nodes[ahead[0]]
        direction /= np.linalg.norm(direction)
        parent[members[first]] = _meeting(skeleton, carrier, members[first], direction)
    # A run attached to dropped nodes is attached to the next kept ancestor.
    for node in range(skeleton.node_count):
        while parent[node] >= 0 and not keep[parent[node]]:
            parent[node] = parent[parent[node]]
    return skeleton.subset(keep, parent)


def _past_hook(skeleton: Skeleton, members: np.ndarray, first: int) -> int:
    """The position in a twig from which its direction continues. Where the scan lacks its base, a
    short path across attaches it to its carrier, with a kink where its own axis begins."""
    nodes = skeleton.nodes
    last = min(first + _MISLEADING_NODES, len(members) - _NODES_AHEAD)
    start = max(first, last)
    for k in range(first, last):
        step = nodes[members[k + 1]] - nodes[members[k]]
        ahead = nodes[members[k + _NODES_AHEAD - 1]] - nodes[members[k + 1]]
        size = np.linalg.norm(step) * np.linalg.norm(ahead)
        if size > 0 and step @ ahead > np.cos(_KINK) * size:
            start = k
            break
    reach = _HOOK_REACH * skeleton.radius[skeleton.parent[members[0]]]
    length = 0.0
    for k in range(start + 1, len(members) - _NODES_AHEAD):
        step = nodes[members[k]] - nodes[members[k - 1]]
        length += float(np.linalg.norm(step))
        if length > reach:
            break
        before = nodes[members[k]] - nodes[members[max(k - _BESIDE, start)]]
        ahead = nodes[members[k + _NODES_AHEAD - 1]] - nodes[members[k]]
        size = np.linalg.norm(before) * np.linalg.norm(ahead)
        if size > 0 and before @ ahead < np.cos(_SHARP_KINK) * size:
            start = k
    return start


def _meeting(skeleton: Skeleton, carrier: np.ndarray, first: int, direction: np.ndarray) -> int:
    """Carrier node nearest to the twig's line, extended back from its first node outside. Nodes
    that it meets ahead do not count unless all are ahead: a twig grows away from its fork."""
    offset = skeleton.nodes[carrier] - skeleton.nodes[first]
    back = -(offset @ direction)
    across = np.linalg.norm(offset + back[:, None] * direction, axis=1)
    # No farther back than the carrier's thickness: at a small angle the lines meet far away.
    reach = np.linalg.norm(offset, axis=1).min() * 2.5
    allowed = np.linalg.norm(offset, axis=1) <= reach
    if (allowed & (back > 0)).any():
        allowed &= back > 0
    return int(carrier[np.argmin(np.where(allowed, across, np.inf))])


# Kinks within a branch that wood does not make.

_END = 8.0  # radii from a kink to the tip below which the rest is a folded end
_ROUNDED = 4.0  # radii on each side of a kink that are smoothed
_ROUNDS = 60


def without_kinks(skeleton: Skeleton) -> tuple[Skeleton, int]:
    """Repair kinks of over 70 degrees within runs, and count them. A run that folds back near its
    tip and carries nothing beyond ends there. Elsewhere nodes are smoothed to a bend of wood."""
    count = 0
    while True:
        folded = _folded(skeleton)
        if not folded:
            break
        keep = np.ones(skeleton.node_count, bool)
        keep[np.concatenate(folded)] = False
        skeleton, count = skeleton.subset(keep), count + len(folded)
    nodes = skeleton.nodes.copy()
    for members in skeleton.runs():
        sharp = np.flatnonzero(turns(skeleton, members) > KINK)
        if len(sharp):
            count += int((np.diff(sharp) > 1).sum()) + 1
            _round_off(skeleton, nodes, members)
    return replace(skeleton, nodes=nodes), count


def _folded(skeleton: Skeleton) -> list[np.ndarray]:
    """Nodes of each folded end beyond its kink."""
    children, found = skeleton.child_counts(), []
    for members in skeleton.runs():
        for k in np.flatnonzero(turns(skeleton, members) > KINK):
            rest = members[k:]
            step = np.linalg.norm(np.diff(skeleton.nodes[rest], axis=0), axis=1)
            if k > 1 and len(rest) > 1 and (children[rest] < 2).all() and (
                    step.sum() < _END * skeleton.radius[rest[0]]):
                found.append(rest[1:])
                break
    return found


def _round_off(skeleton: Skeleton, nodes: np.ndarray, members: np.ndarray) -> None:
    """Smooth a run's ``nodes`` around its kinks, in place."""
    for _ in range(_ROUNDS):
        now = skeleton.moved(nodes)
        sharp = np.flatnonzero(turns(now, members) > KINK)
        if len(sharp) == 0:
            return
        along = arc_lengths(nodes[members])
        reach = _ROUNDED * skeleton.radius[members[sharp]]
        near = (np.abs(along[:, None] - along[sharp]) < reach).any(axis=1)
        near[[0, -1]] = False
        inner = np.flatnonzero(near)
        old = nodes[members]
        nodes[members[inner]] = 0.5 * old[inner] + 0.25 * (old[inner - 1] + old[inner + 1])


# Spurs: side twigs that hardly reach out of their carrier.

SPUR_REACH = 2.5
"""A twig is kept if it reaches this many radii of its carrier beyond the carrier's axis."""


def prune_spurs(nodes: np.ndarray, parent: np.ndarray, thickness: np.ndarray, factor: float,
                ) -> tuple[np.ndarray, int]:
    """Mask [n] of the nodes that stay, and the number of dropped spurs: twigs that reach less than
    ``factor`` radii of the node they start from beyond it. ``parent`` is -1 for the root."""
    keep, pruned = np.ones(len(nodes), bool), 0
    step = np.where(parent >= 0, np.linalg.norm(nodes - nodes[parent], axis=1), 0.0)
    children = np.bincount(parent[parent >= 0], minlength=len(nodes))
    spurs: list[tuple[float, int, list[int], int]] = []
    tips_of: dict[int, set[int]] = {}

    def follow(tip: int) -> None:
        """Note the end of a tip's twig, and the twig if it is a spur."""
        chain, length, node = [], 0.0, tip
        while parent[node] >= 0 and children[node] <= 1:
            chain.append(node)
            length += step[node]
            node = int(parent[node])
        tips_of.setdefault(node, set()).add(tip)
        if children[node] > 1 and length < factor * max(
                thickness[node], float(np.median(thickness[chain]))):
            heappush(spurs, (length, tip, chain, node))

    for tip in np.flatnonzero((children == 0) & (parent >= 0)):
        follow(int(tip))
    while spurs:
        # The shortest first: the fork may no longer be one afterwards.
        _, tip, chain, fork = heappop(spurs)
        if tip not in tips_of.get(fork, ()):
            continue
        keep[chain] = False
        pruned += 1
        children[fork] -= 1
        tips_of[fork].remove(tip)
        if children[fork] == 1:
            for other in tips_of.pop(fork):
                follow(other)
    return keep, pruned


# Nodes along runs, at distances proportional to the radius and no closer than the points.

_NEIGHBOURS = 4  # of a point that show how far apart they are
_NEAR = 8  # points around a node that count


def resampled(skeleton: Skeleton, spacing: float = 1.0, least: np.ndarray | float = 0.0,
              ) -> Skeleton:
    """Return the skeleton with nodes ``spacing`` local radii apart along each run, but at least
    ``least`` [m], for each of its nodes [n] or for all."""
    least = np.broadcast_to(least, skeleton.node_count)
    nodes: list[np.ndarray] = []
    radius: list[np.ndarray] = []
    parent: list[np.ndarray] = []
    made: dict[int, np.ndarray] = {}
    count = 0
    for run, members in enumerate(skeleton.runs()):
        points, thick = skeleton.curve(run)
        new_points, new_radius = resample(
            points, thick, np.maximum(spacing * thick, least[members]))
        if run == 0:
            hang = np.arange(len(new_points)) - 1
        else:
            carrier = made[int(skeleton.branch[members[0]])]
            node = carrier[int(np.argmin(np.linalg.norm(
                np.vstack(nodes)[carrier] - points[0], axis=1)))]
            new_points, new_radius = new_points[1:], new_radius[1:]
            hang = np.concatenate([[node], count + np.arange(len(new_points) - 1)])
        made[run] = count + np.arange(len(new_points))
        count += len(new_points)
        nodes.append(new_points)
        radius.append(new_radius)
        parent.append(hang)
    return Skeleton.from_edges(np.vstack(nodes), np.concatenate(parent), np.concatenate(radius))


@dataclass(frozen=True)
class PointSpacing:
    """How far apart points are: the mean ``distance`` [m] of each from its nearest neighbours."""

    tree: cKDTree
    distance: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> "PointSpacing":
        """The spacing of points [m], shape [m, 3]."""
        tree = cKDTree(points)
        near = tree.query(points, k=min(_NEIGHBOURS + 1, len(points)))[0]
        return cls(tree, near[:, 1:].mean(axis=1))

    def at(self, places: np.ndarray) -> np.ndarray:
        """The spacing around places [m, shape [n, 3]], shape [n]."""
        near = self.tree.query(places, k=min(_NEAR, len(self.distance)))[1]
        return self.distance[near.reshape(len(places), -1)].mean(axis=1)


_COARSE = 1.5  # local radii between the nodes of the first fit
_NOISY = 0.2  # fraction of the median radius
_SETTLED = 18  # rounds of the last fit


@dataclass(frozen=True)
class Repaired:
    """A skeleton between two passes, and the state that they use.

    Attributes:
        points: The scan, thinned, its stations registered [m], shape [m, 3].
        view: The depth camera's view of the points, if they are one's.
        rays: The points are one sensor's, evenly spaced across its sight and scattered along it.
        fit: The last fit.
        common: Deviation of what all radii are off together by the stations' registration [m].
    """

    skeleton: Skeleton
    points: np.ndarray
    view: View | None = None
    rays: bool = False
    fit: AxisFit | None = None
    progress: Progress = SILENT
    common: float = 0.0

    def of(self, skeleton: Skeleton) -> "Repaired":
        """The same with another skeleton."""
        return replace(self, skeleton=skeleton)

    def fitted(self, first: Skeleton, **how: Any) -> "Repaired":
        """The same after a fit that starts from ``first``."""
        fit = fit_axes(first, self.points, along_sight=self.view is not None,
                       progress=self.progress, **how)
        if self.rays:
            fit = fit_of_rays(fit, self.points, certain=True, view=self.view) or fit
        return replace(self, fit=fit, skeleton=fit.skeleton)

    def sampled(self, skeleton: Skeleton, spacing: float = 1.0) -> Skeleton:
        """A skeleton with nodes ``spacing`` local radii apart, where there are points for each."""
        return resampled(skeleton, spacing, PointSpacing.of(self.points).at(skeleton.nodes))

    @property
    def noise(self) -> float:
        """Standard deviation of the points [m], as the last fit has it."""
        return self.last_fit.noise

    @property
    def last_fit(self) -> AxisFit:
        """The last fit, once there is one."""
        assert self.fit is not None, "the first fit must run before its results are used"
        return self.fit


@dataclass(frozen=True)
class Pass:
    """A repair. ``until`` is the fraction of all passes' work that is done after it; None: it takes
    hardly any time."""

    name: str
    run: Callable[[Repaired], Repaired]
    until: float | None = None


def _fit_coarsely(now: Repaired) -> Repaired:
    after = now.fitted(now.sampled(now.skeleton, _COARSE), uncertainty=False)
    by_rays = fit_of_rays(after.last_fit, now.points, now.view is not None, now.view)
    return after if by_rays is None else replace(
        after, rays=True, fit=by_rays, skeleton=by_rays.skeleton)


def _settle(now: Repaired) -> Repaired:
    # Noise leaves little information per round.
    noisy = now.noise > _NOISY * float(np.median(now.skeleton.radius))
    return now.fitted(now.skeleton, rounds=_SETTLED * noisy, settled=noisy, seen=now.last_fit.seen)


def _register_stations(now: Repaired) -> Repaired:
    seen = now.last_fit.seen
    found = None if now.rays or seen.one_sided or seen.along_sight else registered(
        now.skeleton, now.points, now.noise)
    if found is None:
        return now
    return replace(now, points=found[0], common=found[1]).fitted(now.skeleton, settled=True)


def _mend_kinks(now: Repaired) -> Repaired:
    skeleton, count = without_kinks(now.skeleton)
    # Where a folded end carried the run's number, the runs are others now: so is what they state.
    return now.of(doubted(skeleton, now.points, now.noise) if count else skeleton)


# Where points are missing, a first radius is far too small.
STEADY = Pass("steady radii", lambda now: now.of(steadied(now.skeleton, now.points)))

PASSES = (
    STEADY,
    # The contracted axes lie beside the axes that the points show.
    Pass("fit coarsely", _fit_coarsely, until=0.4),
    # The contraction pulls a fork towards its twig.
    Pass("attach twigs", lambda now: now.of(attached(now.skeleton))),
    # The contraction shortens an end.
    Pass("lengthen ends",
         lambda now: now.of(with_full_tips(now.skeleton, now.points, now.noise))),
    STEADY,
    # Axes and radii come from too few nodes, and from forks that have moved since.
    Pass("fit finely", lambda now: now.fitted(now.sampled(now.skeleton), uncertainty=False),
         until=0.8),
    # Noise leaves the fit unfinished.
    Pass("settle", _settle, until=0.9),
    # The stations of a merged scan are a little apart, so that all radii are off together.
    Pass("register stations", _register_stations, until=1.0),
    # A fit moves an end along its axis beyond the points; nodes without points go first.
    Pass("draw ends back", lambda now: now.of(
        ends_within(without_bare_ends(now.skeleton, now.points), now.points))),
    # A radius that few points, the spacing or the noise determine, or that no wood has, is treated
    # as measured.
    Pass("find the likeliest axes and radii", lambda now: now.of(assessed(
        now.skeleton, now.points, now.noise, rays=now.rays,
        one_sided=now.last_fit.seen.one_sided, view=now.view, common=now.common))),
    # A branch turns more sharply than wood does.
    Pass("mend kinks", _mend_kinks),
)
"""In the order in which they run; some run again after a fit."""


def repaired(skeleton: Skeleton, points: np.ndarray, view: View | None,
             progress: Progress = SILENT) -> Repaired:
    """Run all passes on the skeleton, with first radii, of the contracted points. ``points``
    [m, 3] [m] are the scan, thinned; ``view`` is the depth camera's, if they are one's."""
    now = Repaired(skeleton, points, view)
    done = 0.0
    for each in PASSES:
        until = done if each.until is None else each.until
        now = each.run(replace(now, progress=progress.part(done, until)))
        now = now.of(now.skeleton.on_grid())
        done = until
    return now
