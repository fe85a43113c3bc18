"""Limbs that stand so close together that contraction makes one axis of both, up to their tips.

Their points lie on two circles in a section, not on one. Both are fitted to each section of a run
that one circle explains badly. Where two explain several sections in a row so much better that
nothing else can be meant, the run is split into two.
"""

import numpy as np

from limber.geometry.skeleton.radii.cylinders import nearest_cylinders
from limber.geometry.skeleton.repair.fused_forks import (
    FusedFork,
    fitted_circles,
    section,
    with_side_axes,
)
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.sweep import stretches

_OFF = 0.12  # radii that points are off a section's circle, from which two circles are tried
_RESOLVED = 3.0  # radius of either limb in deviations of its points
_APART = 1.2  # radii of the thicker limb between two axes
_LIKELIER = 10.0  # logarithm of a section's likelihood ratio: twenty thousand times
_POINTS = 20  # fewest in a section
_ALIKE = 3.0  # points whose errors are correlated, so that they count as one
_LEAST = 0.02  # fraction of the radius by which no section of wood is rounder
_SECTIONS, _MISSED = 4, 2  # sections in a row that must show two, and between them one
_FREE = 1.0  # deviation of the limbs' radii from half of the common one, logarithm


def with_split_limbs(skeleton: Skeleton, points: np.ndarray, noise: float,
                     ) -> tuple[Skeleton, int]:
    """Return the skeleton with runs split where their points show two limbs, and their number.

    Args:
        skeleton: Fitted to the points.
        points: Scanned points [m], shape [m, 3].
        noise: Standard deviation of the points [m].
    """
    segment, residual = nearest_cylinders(skeleton, points)
    count = np.maximum(np.bincount(segment, minlength=skeleton.node_count), 1)
    off = np.bincount(segment, np.abs(residual), skeleton.node_count) / count
    tried = (off > _OFF * skeleton.radius) & (skeleton.radius > _RESOLVED * noise)
    forks = []
    for number, members in enumerate(skeleton.runs()):
        own = members[1:]
        mine = points[skeleton.branch[segment] == number]
        for part in _stretches(tried[own]):
            shown = {int(node): both for node in own[part][tried[own[part]]]
                     if (both := _two(skeleton, int(node), mine)) is not None}
            forks += [_limbs(skeleton, own[part][inner], shown)
                      for inner in _stretches(np.isin(own[part], list(shown)))]
    return (with_side_axes(skeleton, forks, [None] * len(forks)), len(forks)) if forks else (
        skeleton, 0)


def _stretches(chosen: np.ndarray) -> list[slice]:
    """Stretches of enough chosen sections in a row, with a few others between."""
    filled = chosen.copy()
    for part in stretches(~chosen):
        if part.start > 0 and part.stop < len(chosen) and part.stop - part.start <= _MISSED:
            filled[part] = True
    return [part for part in stretches(filled) if chosen[part].sum() >= _SECTIONS]


def _two(skeleton: Skeleton, node: int, points: np.ndarray) -> np.ndarray | None:
    """Middles [m] and radii [m] of two limbs in the section at a node, shape [2, 4]; None where one
    circle may explain it.
    """
    thick = float(skeleton.radius[node])
    seen = section(skeleton, node, points, 2 * thick, thick / 2)
    if seen is None or len(seen[0]) < _POINTS:
        return None
    flat, frame = seen
    middle = flat.mean(axis=0)
    along = np.linalg.svd(flat - middle, full_matrices=False)[2][0]
    reach = float(np.quantile(np.abs((flat - middle) @ along), 0.9)) / 2
    one = fitted_circles(flat, np.array([[*middle, thick]]), 0.1 * thick, _FREE)
    two = fitted_circles(flat, np.array([[*(middle + side * reach * along), reach]
                                         for side in (-1, 1)]), 0.1 * thick, _FREE)
    if one is None or two is None:
        return None
    spread, circles = _scatter(flat, two[0]), two[0]
    gap, thicker = float(np.linalg.norm(circles[0, :2] - circles[1, :2])), float(
        circles[:, 2].max())
    gain = len(flat) / _ALIKE * np.log(_scatter(flat, one[0]) / spread) - 1.5 * np.log(len(flat))
    if gap < _APART * thicker or circles[:, 2].min() < _RESOLVED * spread or gain < _LIKELIER:
        return None
    return np.column_stack([skeleton.nodes[node] + circles[:, :2] @ frame, circles[:, 2]])


def _scatter(flat: np.ndarray, circles: np.ndarray) -> float:
    """Standard deviation of points [k, 2] about the nearest of circles [m]."""
    off = np.abs(np.linalg.norm(flat[:, None] - circles[:, :2], axis=2) - circles[:, 2])
    return max(float(np.sqrt((off.min(axis=1)**2).mean())), _LEAST * float(circles[:, 2].max()))


def _limbs(skeleton: Skeleton, nodes: np.ndarray, shown: dict[int, np.ndarray]) -> FusedFork:
    """Axes and radii of both limbs along nodes, given from the root outwards."""
    nodes = nodes[::-1]  # the carrier goes on where the run does, beyond the outermost
    known = np.array([k for k, node in enumerate(nodes) if int(node) in shown])
    pairs = []
    beyond = np.flatnonzero(skeleton.parent == nodes[0])
    last = np.stack([skeleton.nodes[beyond[0]]] * 2) if len(beyond) else None
    for k in known:
        pair = shown[int(nodes[k])]
        if last is not None and np.linalg.norm(pair[0, :3] - last[0]) > np.linalg.norm(
                pair[1, :3] - last[0]):
            pair = pair[::-1]
        pairs.append(pair)
        last = pair[:, :3]
    every = np.stack(pairs)
    filled = np.stack([[np.interp(np.arange(len(nodes)), known, every[:, limb, column])
                        for column in range(4)] for limb in range(2)])
    return FusedFork(nodes, filled[0, :3].T, filled[0, 3], filled[1, :3].T, filled[1, 3])
