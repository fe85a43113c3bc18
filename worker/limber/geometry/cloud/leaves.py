"""Separation of leaves from stems: points that are likely on leaves, in connected pieces."""

from dataclasses import dataclass
from functools import cache
from itertools import accumulate
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.special import expit, logit

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


_REACHES = (0, 1, 2, 4, 8, 16, 32, 64)  # rounds of averaging over the nearest points
_MOST_ODDS = 4.0  # logarithm of the odds above which a single point is no more evidence
ALIKE = 16
"""Neighbours whose evidence counts for a point, and once for all."""


def leaf_log_odds(points: np.ndarray) -> np.ndarray:
    """Logarithm of the odds that each of points [n, 3] [m] is on a leaf, shape [n].

    What one part looks like may deceive, as on a leaf's rim. So further trees judge it by the odds
    around it too (Tu 2008, doi:10.1109/CVPR.2008.4587436).
    """
    own = OwnFrame.of(points)
    spacing, odds = point_spacing(own.coordinates), np.full(len(points), -_MOST_ODDS)
    if len(points) >= _SMALLEST and spacing > 0:  # else neighbourhoods have no shape
        shape = surroundings(own.coordinates, spacing)
        odds[own.order] = voted(in_context(own.coordinates, shape, voted(shape, "shape")),
                                "context")
    return odds


def in_context(points: np.ndarray, shape: np.ndarray, odds: np.ndarray) -> np.ndarray:
    """The ``shape`` of surroundings [n, 44], and the log ``odds`` [n] of points on average over
    ever wider ones, shape [n, 52]."""
    odds, count = np.clip(odds, -_MOST_ODDS, _MOST_ODDS), len(points)
    near = cKDTree(points).query(points, k=min(ALIKE, count))[1]
    step = csr_matrix((np.full(near.size, 1 / near.shape[1]), near.ravel(), np.arange(
        0, near.size + 1, near.shape[1])), (count, count))
    wider = list(accumulate(range(_REACHES[-1]), lambda around, _: step @ around, initial=odds))
    return np.column_stack([shape, *(wider[reach] for reach in _REACHES)]).astype(np.float32)


def voted(features: np.ndarray, trees: str) -> np.ndarray:
    """Logarithm of the odds that each point is on a leaf, shape [n], by the trees of a name."""
    arrays, total = _trees(), np.empty(len(features))
    _voted.of(features, *(arrays[f"{trees}_{name}"] for name in (
        "first", "depth", "feature", "threshold", "low", "high", "value")), total,
        float(arrays[f"{trees}_start"]))
    return total


_voted = Kernel(
    "trees_voted", "features float64[rows, columns]", "first int64[trees]", "depth int64[trees]",
    "feature int64[nodes]", "threshold float64[nodes]", "low int64[nodes]", "high int64[nodes]",
    "value float64[nodes]", "out total float64[rows]", "start float")


@cache
def _trees() -> dict[str, np.ndarray]:
    return read_arrays(TREES, "the classifier of leaves, a part of Limber")


_SMALLEST = 40  # fewest points of a leaf
_NEAR = 3.0  # largest distance between connected points, in spacings
_ROUNDS = 50  # until the fraction on leaves has settled
_LIKELY = 2.5  # logarithm of a leaf's odds: wood that is taken for one is a dozen times worse


@dataclass(frozen=True)
class Leaf:
    """One leaf, or several that touch: indices of its points, and the area of one side [m^2]."""

    points: np.ndarray
    area: float


def find_leaves(points: np.ndarray, odds: np.ndarray | None = None) -> list[Leaf]:
    """Find the leaves of a scan of points [n, 3] [m]; ``odds`` [n] are :func:`leaf_log_odds`, if
    known. They are connected points; specks go with the nearest. A piece is as likely one as its
    points are, and its odds move with the fraction on leaves in this scan, so a few flat clumps are
    none (Saerens, Latinne and Decaestecker 2002, doi:10.1162/089976602753284446)."""
    frame, odds = OwnFrame.of(points), leaf_log_odds(points) if odds is None else odds
    own = frame.order[odds[frame.order] > 0]
    if len(own) < _SMALLEST:
        return []
    tree = cKDTree(points[own])
    pairs = tree.query_pairs(_NEAR * point_spacing(frame.coordinates), output_type="ndarray")
    label = connected_components(coo_matrix((np.ones(len(pairs)), pairs.T), 2 * own.shape))[1]
    if not (large := np.bincount(label)[label] >= _SMALLEST).any():
        return []
    label = label[large][cKDTree(points[own[large]]).query(points[own])[1]]
    pieces = [np.flatnonzero(label == piece) for piece in np.unique(label)]
    like = logit([expit(odds[own[piece]]).mean() for piece in pieces])
    share = 1 / len(points)
    for _ in range(_ROUNDS):  # from a bare scan on, so that it is one unless shown otherwise
        shift = logit(share) - _trees()["context_start"]
        share = expit(like + shift) @ np.array(list(map(len, pieces))) / len(points)
    # The median is used: at a leaf's edge, neighbours are missing on one side.
    area = np.pi * tree.query(points[own], k=9)[0][:, -1]**2 / 8
    return [Leaf(own[piece], len(piece) * float(np.median(area[piece])))
            for piece, is_leaf in zip(pieces, like + shift > _LIKELY, strict=True) if is_leaf]


def leaf_evidence(points: np.ndarray) -> np.ndarray:
    """What each point's surroundings add to the logarithm of the odds that a scan shows leaves,
    shape [n]: over 0 if it is likelier on one than before looking. Neighbours share theirs, which
    count once."""
    odds = leaf_log_odds(points) - _trees()["context_start"]
    return np.clip(odds, -_MOST_ODDS, _MOST_ODDS) / ALIKE


def point_spacing(points: np.ndarray) -> float:
    """Median distance between neighbouring points [m]; 0 where most coincide with another."""
    some = points[::max(1, len(points) // 5000)]
    return float(np.median(cKDTree(points).query(some, k=2)[0][:, 1]))
