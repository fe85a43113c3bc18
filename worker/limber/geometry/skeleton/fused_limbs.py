"""Feet of side branches: their axes are followed down while the points show two limbs, not one.

Where a side branch leaves at a small angle, or beside a limb as thick as itself, the contraction
makes one axis of both for some way. Its points then lie on two circles in a section, and on one
below the fork. The likelihoods of both decide at each node, from the fork towards the root.
"""

from dataclasses import dataclass

import numpy as np

from limber.core.numerics.rigid import any_normal
from limber.geometry.skeleton.radii.fit_kernels import nearest_cylinders
from limber.geometry.skeleton.skeleton import Skeleton

_HALF = 1.0  # radii to each side of a section whose points belong to it
_CIRCLE_POINTS = 10  # points of a circle
_FORK_GAP = 1.0  # radii of the thicker limb between two axes
_FORK_EVIDENCE = 3.0  # logarithm: twenty times
_ALIKE = 3.0  # points whose errors are correlated, so that they count as one
_ROUGH = 0.08  # fraction of the radius by which sections of wood are not round
_STRAY = 3.0  # standard deviations from which a point belongs to something else
_KNOWN = 0.3  # deviation of a limb's radius from that above, logarithm
_ROUNDS = 12
_HIDDEN = 2  # sections at the fork that may show one circle
_FORK_SECTIONS = 3  # sections in a row that must show two: a few stray points are in one


@dataclass(frozen=True)
class FusedFork:
    """The axes of a side run beside its carrier: carrier's nodes from the fork down, shape [k], and
    of both limbs there the positions [m], [k, 3], and radii [m], [k]."""

    nodes: np.ndarray
    carrier: np.ndarray
    carrier_radius: np.ndarray
    side: np.ndarray
    side_radius: np.ndarray


def separate_fused_forks(skeleton: Skeleton, points: np.ndarray, noise: float,
                         ) -> tuple[Skeleton, int]:
    """Return the skeleton with side runs that start where their points meet the carrier's, and the
    number of those followed down. ``noise`` is the points' standard deviation [m]."""
    run = skeleton.branch[nearest_cylinders(skeleton, points)[0]]
    done, forks, starts = np.zeros(skeleton.node_count, bool), [], []
    for members in skeleton.runs()[1:]:
        own = np.isin(run, skeleton.branch[members[:2]])
        fork = _fused_fork(skeleton, members, points[own], noise)
        if fork is None or done[fork.nodes].any():
            continue
        done[fork.nodes] = True
        forks.append(fork)
        starts.append(int(members[1]))
    return (_with_side_axes(skeleton, forks, starts), len(forks)) if forks else (skeleton, 0)


def _with_side_axes(skeleton: Skeleton, forks: list[FusedFork], starts: list[int]) -> Skeleton:
    """Return the skeleton with a second axis beside each stretch in ``forks``, whose side run goes
    on at the node in ``starts``."""
    nodes, radius = skeleton.nodes.copy(), skeleton.radius.copy()
    parent, below, first = skeleton.parent.copy(), [], skeleton.node_count
    for fork, start in zip(forks, starts, strict=True):
        nodes[fork.nodes], radius[fork.nodes] = fork.carrier, fork.carrier_radius
        chain = np.arange(first, first + len(fork.nodes))
        first += len(fork.nodes)
        parent[start] = chain[0]
        below.append(np.append(chain[1:], skeleton.parent[fork.nodes[-1]]))
    return Skeleton.from_edges(
        np.vstack([nodes, *(fork.side for fork in forks)]), np.concatenate([parent, *below]),
        np.concatenate([radius, *(fork.side_radius for fork in forks)]))


def _fused_fork(skeleton: Skeleton, members: np.ndarray, points: np.ndarray, noise: float,
                ) -> FusedFork | None:
    """The part of a side run that its carrier's axis hides; None if there is none."""
    fork = int(members[0])
    run = int(skeleton.branch[fork])
    side = float(np.median(skeleton.radius[members[1:6]]))
    at = skeleton.nodes[members[1]]
    found: list[tuple[int, tuple[np.ndarray, np.ndarray, float, float]]] = []
    node, hidden = fork, 0
    way = at - skeleton.nodes[members[min(6, len(members) - 1)]]
    way /= max(float(np.linalg.norm(way)), 1e-300)
    while skeleton.parent[node] >= 0 and skeleton.branch[node] == run and hidden < _HIDDEN:
        step = min(float(np.linalg.norm(at - skeleton.nodes[node])), float(skeleton.steps[node]))
        both = _two_limbs(skeleton, node, at + way * step, side, points, noise)
        if both is not None:
            found.append((node, both))
            at = both[1]
        elif found:
            break
        else:
            hidden += 1
        node = int(skeleton.parent[node])
    if len(found) < _FORK_SECTIONS:
        return None
    return FusedFork(np.array([each for each, _ in found]), *(
        np.array([both[k] for _, both in found]) for k in (0, 2, 1, 3)))


def _two_limbs(skeleton: Skeleton, node: int, at: np.ndarray, side: float, points: np.ndarray,
               noise: float) -> tuple[np.ndarray, np.ndarray, float, float] | None:
    """Axes [3] and radii [m] of carrier and side limb in the section at a node; None if it shows
    one. The side limb is expected ``at`` [3] [m], with its radius above, ``side`` [m]."""
    thick = float(skeleton.radius[node])
    seen = section(skeleton, node, points, 3 * thick + 2 * side, _HALF * min(thick, side))
    if seen is None:
        return None
    (flat, frame), middle = seen, skeleton.nodes[node]
    spread = float(np.hypot(noise, _ROUGH * min(thick, side)))
    aside = (at - middle) @ frame.T
    single = fitted_circles(flat, np.array([[0.0, 0.0, thick]]), spread, np.inf)
    above = float(skeleton.radius[_outwards(skeleton, node)])
    first = np.array([[*(-0.3 * aside), above], [*aside, side]])
    double = fitted_circles(flat, first, spread, _KNOWN)
    if single is None or double is None:
        return None
    (carrier, limb), gap = double[0], float(np.linalg.norm(double[0][0, :2] - double[0][1, :2]))
    if gap < _FORK_GAP * max(carrier[2], limb[2]) or (
            (double[1] - single[1]) / _ALIKE - 1.5 * np.log(len(flat)) < _FORK_EVIDENCE):
        return None
    return (middle + carrier[:2] @ frame, middle + limb[:2] @ frame, float(carrier[2]),
            float(limb[2]))


def section(skeleton: Skeleton, node: int, points: np.ndarray, reach: float, half: float,
            ) -> tuple[np.ndarray, np.ndarray] | None:
    """Points [k, 2] [m] of the section at a node, up to ``reach`` [m] from it, and the plane's two
    unit vectors; None where the axis has no direction. ``half`` is half the section's
    thickness [m]; the node's step counts if larger."""
    axis = skeleton.nodes[node] - skeleton.nodes[int(skeleton.parent[node])]
    size = float(np.linalg.norm(axis))
    if size == 0:
        return None
    axis /= size
    offset = points[np.linalg.norm(points - skeleton.nodes[node], axis=1) < reach
                    ] - skeleton.nodes[node]
    one = any_normal(axis)
    frame = np.stack([one, np.cross(axis, one)])
    return offset[np.abs(offset @ axis) < max(half, size / 2)] @ frame.T, frame


def _outwards(skeleton: Skeleton, node: int) -> int:
    """The node of the same run some radii above."""
    own = np.flatnonzero(skeleton.branch == skeleton.branch[node])
    above = own[own > node]
    far = skeleton.arc_length[above] - skeleton.arc_length[node] > 3 * skeleton.radius[node]
    return int(above[far][0]) if far.any() else int(above[-1]) if len(above) else node


def fitted_circles(flat: np.ndarray, first: np.ndarray, spread: float, known: float,
                   ) -> tuple[np.ndarray, float] | None:
    """Circles (middle and radius) [c, 3] [m] fitted to points [k, 2] [m], each point to the
    nearest, and the log-likelihood; None if a circle has too few points. ``known`` is the deviation
    of the radii's logarithms from those of ``first``."""
    circles = first.copy()
    for _ in range(_ROUNDS):
        offset = flat[:, None] - circles[:, :2]
        distance = np.maximum(np.linalg.norm(offset, axis=2), 1e-12)
        miss = distance - circles[:, 2]
        nearest = np.argmin(np.abs(miss), axis=1)
        for number, circle in enumerate(circles):
            own = np.flatnonzero((nearest == number) & (
                np.abs(miss[:, number]) < np.maximum(2 * _STRAY * spread, circle[2])))
            if len(own) < _CIRCLE_POINTS:
                return None
            off = miss[own, number] / spread
            weight = 1 / (1 + (off / _STRAY)**2)
            slope = np.column_stack([-offset[own, number] / distance[own, number, None],
                                     -np.ones(len(own))]) / spread
            prior = np.diag([0, 0, (known * first[number, 2])**-2]) + 1e-9 / spread**2 * np.eye(3)
            pull = prior @ (circle - first[number]) * [0, 0, 1]
            step = np.linalg.solve((slope * weight[:, None]).T @ slope + prior,
                                   (slope * weight[:, None]).T @ off + pull)
            circles[number] = circle - np.clip(step, -0.5 * circle[2], 0.5 * circle[2])
            circles[number, 2] = max(circles[number, 2], 0.2 * first[number, 2])
    off = np.abs(np.linalg.norm(flat[:, None] - circles[:, :2], axis=2) - circles[:, 2]).min(
        axis=1) / spread
    return circles, float(-0.5 * np.minimum(off, _STRAY)**2 @ np.ones(len(off)))
