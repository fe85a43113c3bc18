"""Even thinning of a cloud."""

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.cloud.canonical_frame import own_axes


def thinned(points: np.ndarray, limit: int) -> np.ndarray:
    """Indices of at most ``limit`` points, one from each cell of a grid that fits that number.

    The grid follows the cloud's own axes, so a rotated cloud is thinned in the same way.
    """
    if len(points) <= limit:
        return np.arange(len(points))
    points = points @ own_axes(points)
    low = points.min(axis=0)
    # Points are on a surface: the cell size grows with the square root of the excess of points.
    size = float(np.median(cKDTree(points).query(
        points[:: max(len(points) // 2000, 1)], k=2)[0][:, 1])) * np.sqrt(len(points) / limit)
    size = max(size, 1e-6 * float(np.ptp(points, axis=0).max()), 1e-12)
    for _ in range(40):
        cell = np.floor((points - low) / size).astype(np.int64)
        extent = cell.max(axis=0) + 1
        key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
        _, first = np.unique(key, return_index=True)
        if len(first) <= limit:
            return np.sort(first)
        size *= max(1.03, np.sqrt(len(first) / limit))
    return np.sort(first)
