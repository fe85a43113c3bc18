"""Separation of leaves from stems: points that are likely on leaves, in connected pieces."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from limber.core.files.reading import read_arrays
from limber.geometry.cloud.cloud import OwnFrame
from limber.geometry.cloud.preparation import voxel_thinned
from limber.kernels import Kernel

# Evidence that a point is on a leaf: boosted trees on the shape of its surroundings.
#
# Around a point of a leaf the scan is a sheet: wide in two directions, thin in the third. On a stem
# this holds only within a fraction of the stem's radius; beyond it the stem is round, and farther
# out a line. The trees are trained by ``benchmarks.leaf_training`` on scans with known leaves.

_CELL = 0.25  # cell size, as a fraction of the scale
_FINEST, _STEP, _SCALES = 4.0, 1.5, 11  # first scale in point spacings, ratio, number
TREES = Path(__file__).with_name("leaf_trees.npz")


def surroundings(points: np.ndarray, spacing: float) -> np.ndarray:
    """The shape of the surroundings of points [n, 3] [m] at several scales, shape [n, 44]: ratios
    of the second to the largest and of the smallest to the second standard deviation, the smallest
    over the scale, and the logarithm of the number of filled cells. All are without unit."""
    columns: list[np.ndarray] = []
    for step in range(_SCALES):
        scale = _FINEST * spacing * _STEP**step
        chosen = voxel_thinned(points, _CELL * scale)
        variances, count = _variances(points[chosen], scale)
        small, middle, large = np.sqrt(variances).T / scale
        shape = np.column_stack([middle / np.maximum(large, 1e-9), small / np.maximum(middle, 1e-9),
                                 small, np.log(count)])
        columns.append(shape[cKDTree(points[chosen]).query(points)[1]])
    return np.stack(columns, axis=2).reshape(len(points), -1).astype(np.float32)


def _variances(points: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Variances of each point's neighbourhood [m^2], smallest first, [n, 3]; and its size [n]."""
    pairs = cKDTree(points).query_pairs(scale, output_type="ndarray")
    one, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    total = len(points)
    count = 1 + np.bincount(one, minlength=total)
    offset = points[other] - points[one]
    first = np.stack([np.bincount(one, offset[:, k], total) for k in range(3)], axis=1)
    # Without a single pair, bincount returns integers, so there is no division in place.
    first = first / count[:, None]
    second = np.empty((total, 3, 3))
    for i in range(3):
        for j in range(i + 1):
            moment = np.bincount(one, offset[:, i] * offset[:, j], total) / count
            second[:, i, j] = second[:, j, i] = moment - first[:, i] * first[:, j]
    return np.maximum(np.linalg.eigvalsh(second), 0.0), count


def leaf_log_odds(features: np.ndarray) -> np.ndarray:
    """Logarithm of the odds that each point is on a leaf, shape [n], from its surroundings."""
    trees, total = _trees(), np.empty(len(features))
    _voted.of(features, *(trees[name] for name in (
        "first", "depth", "feature", "threshold", "low", "high", "value")), total,
        float(trees["start"]))
    return total


_voted = Kernel(
    "trees_voted", "features float64[rows, columns]", "first int64[trees]", "depth int64[trees]",
    "feature int64[nodes]", "threshold float64[nodes]", "low int64[nodes]", "high int64[nodes]",
    "value float64[nodes]", "out total float64[rows]", "start float")


def prior_log_odds() -> float:
    """Logarithm of the odds that any point is on a leaf, in the scans of the training."""
    return float(_trees()["start"])


@cache
def _trees() -> dict[str, np.ndarray]:
    return read_arrays(TREES, "the classifier of leaves, a part of Limber")


_SMALLEST = 40  # fewest points of a leaf
_NEAR = 3.0  # largest distance between connected points, in spacings
ALIKE = 16
"""Neighbours whose evidence counts for a point, and once for all."""
_ROUNDS = 2  # how often
_MOST_ODDS = 4.0  # logarithm of the odds above which a single point is no more evidence
# Mean of it from which a piece is a leaf: first by the training's fraction of leaf points, then by
# the scan's own, which is at least and at most this.
_LIKELY, _SHARES = 2.5, (0.005, 0.95)


@dataclass(frozen=True)
class Leaf:
    """One leaf, or several that touch: indices of its points, and the area of one side [m^2]."""

    points: np.ndarray
    area: float


def find_leaves(points: np.ndarray) -> list[Leaf]:
    """Find the leaves of a scan of points [n, 3] [m]."""
    own = OwnFrame.of(points)
    return [Leaf(own.order[leaf.points], leaf.area) for leaf in _found(own.coordinates)]


def leaf_evidence(points: np.ndarray) -> np.ndarray:
    """What each point's surroundings add to the logarithm of the odds that a scan shows leaves,
    shape [n]: over 0 if it is likelier on one. Neighbours share theirs, which count once."""
    own = OwnFrame.of(points)
    spacing, odds = point_spacing(own.coordinates), np.full(len(points), prior_log_odds())
    if len(points) >= _SMALLEST and spacing > 0:
        odds[own.order] = leaf_log_odds(surroundings(own.coordinates, spacing))
    return np.clip(odds, -_MOST_ODDS, _MOST_ODDS) / ALIKE


def point_spacing(points: np.ndarray) -> float:
    """Median distance between neighbouring points [m]; 0 where most coincide with another."""
    some = points[::max(1, len(points) // 5000)]
    return float(np.median(cKDTree(points).query(some, k=2)[0][:, 1]))


def _found(points: np.ndarray) -> list[Leaf]:
    if len(points) < _SMALLEST:
        return []
    spacing = point_spacing(points)
    if spacing <= 0:
        return []  # Neighbourhoods have no shape.
    return leaves_by_odds(points, leaf_log_odds(surroundings(points, spacing)), spacing,
                          prior_log_odds())


def leaves_by_odds(points: np.ndarray, odds: np.ndarray, spacing: float, prior: float,
                   ) -> list[Leaf]:
    """Find leaves by each point's log odds [n] of being on one; ``prior`` is that of any point of
    the training. They move with the fraction on leaves in this scan, so a few flat clumps are none
    (Saerens, Latinne and Decaestecker 2002, doi:10.1162/089976602753284446)."""
    odds = np.clip(odds, -_MOST_ODDS, _MOST_ODDS)
    near = cKDTree(points).query(points, k=min(ALIKE, len(points)))[1]
    for _ in range(_ROUNDS):
        odds = odds[near].mean(axis=1)
    certain = [leaf for leaf in _pieces(points, odds > 0, _NEAR * spacing)
               if odds[leaf.points].mean() > _LIKELY]
    share = np.clip(sum(len(leaf.points) for leaf in certain) / len(points), *_SHARES)
    odds += np.log(share / (1 - share)) - prior
    return [leaf for leaf in _pieces(points, odds > 0, _NEAR * spacing)
            if odds[leaf.points].mean() > _LIKELY]


def _labels(points: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Which connected piece each point belongs to, shape [n], and the pieces' sizes."""
    pairs = cKDTree(points).query_pairs(reach, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), (len(points), len(points)))
    label = connected_components(graph, directed=False)[1]
    return label, np.bincount(label)


def _pieces(points: np.ndarray, on_leaf: np.ndarray, reach: float) -> list[Leaf]:
    """Connected points of leaves, without specks."""
    own = np.flatnonzero(on_leaf)
    if len(own) < _SMALLEST:
        return []
    label, count = _labels(points[own], reach)
    around = min(9, len(own))
    distance = cKDTree(points[own]).query(points[own], k=around)[0][:, -1]
    area = np.pi * distance**2 / (around - 1)
    leaves = []
    for piece in np.flatnonzero(count >= _SMALLEST):
        members = np.flatnonzero(label == piece)
        # The median is used: at a leaf's edge, neighbours are missing on one side.
        leaves.append(Leaf(own[members], len(members) * float(np.median(area[members]))))
    return leaves
