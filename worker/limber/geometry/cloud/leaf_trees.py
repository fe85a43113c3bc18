"""Evidence that a point is on a leaf: boosted trees on the shape of its surroundings.

Around a point of a leaf the scan is a sheet: wide in two directions, thin in the third. On a stem
this holds only within a fraction of the stem's radius; beyond it the stem is round, and farther out
a line. The trees are trained by ``benchmarks.leaf_training`` on scans with known leaves.
"""

from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from limber.core.files.reading import read_arrays
from limber.core.numerics.compiled import compiled_exactly
from limber.geometry.cloud.preparation import voxel_thinned

_CELL = 0.25  # cell size, as a fraction of the scale
_FINEST, _STEP, _SCALES = 4.0, 1.5, 11  # first scale in point spacings, ratio, number
TREES = Path(__file__).with_name("leaf_trees.npz")


def surroundings(points: np.ndarray, spacing: float) -> np.ndarray:
    """The shape of each point's surroundings at several scales, shape [n, 44].

    Ratios of the second to the largest and of the smallest to the second standard deviation, the
    smallest over the scale, and the logarithm of the number of filled cells: all without unit.

    Args:
        points: Positions [m], shape [n, 3].
        spacing: Of the points [m].
    """
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
    trees = _trees()
    return _voted(features, float(trees["start"]), *(trees[name] for name in (
        "first", "depth", "feature", "threshold", "low", "high", "value")))


@compiled_exactly
def _voted(features: np.ndarray, start: float, first: np.ndarray, depth: np.ndarray,
           feature: np.ndarray, threshold: np.ndarray, low: np.ndarray, high: np.ndarray,
           value: np.ndarray) -> np.ndarray:
    total = np.full(len(features), start)
    for row in range(len(features)):
        for tree in range(len(first)):
            node = first[tree]
            for _ in range(depth[tree]):
                # An end of the tree leads to itself.
                is_low = features[row, feature[node]] <= threshold[node]
                node = first[tree] + (low[node] if is_low else high[node])
            total[row] += value[node]
    return total


def prior_log_odds() -> float:
    """Logarithm of the odds that any point is on a leaf, in the scans of the training."""
    return float(_trees()["start"])


@cache
def _trees() -> dict[str, np.ndarray]:
    return read_arrays(TREES, "the classifier of leaves, a part of Limber")
