"""Walls and ground in a scan: wide flat sheets, which branches do not have."""

import numpy as np
from scipy.spatial import cKDTree

from limber.core.numerics.rigid import principal_axes
from limber.geometry.cloud.canonical_frame import own_order

_SAMPLE = 400
_ENOUGH = 150  # fewest points that define a plane
_REACH = 0.05  # neighbourhood of a point, as a fraction of the cloud's diagonal
_FLAT, _WIDE = 0.01, 0.3  # variance across and along a sheet, over the next larger
_TRIES = 200
_IN_PLANE = 3  # fewest flat neighbourhoods that span a plane
_BROAD = 0.11  # smallest standard deviation across a sheet, over the diagonal; leaves have 0.08
_FILLED = 0.25  # smallest fraction of its bounding box that a sheet fills


def find_sheet(points: np.ndarray, least: float) -> np.ndarray | None:
    """Find the largest plane that is filled with points in both of its directions.

    Args:
        points: Positions [m], shape [n, 3].
        least: Smallest number of points of a sheet.

    Returns:
        True where a point is on it, shape [n]; None if there is no such plane.
    """
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    reach = _REACH * diagonal
    order, rng = own_order(points), np.random.default_rng(0)
    sample = order[:_SAMPLE]
    # Tested on as many points as the sample needs; fewer points do not make a sheet less flat.
    dense = points[order[-20 * _SAMPLE:]]
    tree = cKDTree(dense)
    centres, normals, spreads = [], [], []
    for point, near in zip(points[sample], tree.query_ball_point(points[sample], reach),
                           strict=True):
        if len(near) > 10:
            near = near[::len(near) // _ENOUGH + 1]
            values, axes = np.linalg.eigh(np.cov(dense[near].T))
            if values[0] < _FLAT * values[1] and values[1] > _WIDE * values[2]:
                centres.append(point)
                normals.append(axes[:, 0])
                spreads.append(values[0])
    if len(centres) < max(10, 0.5 * least / len(points) * len(sample)):
        return None
    centres, normals = np.array(centres), np.array(normals)
    thick = 4 * float(np.sqrt(np.median(spreads))) + 1e-4 * diagonal
    best, share = None, 0
    for start in rng.permutation(len(centres))[:_TRIES]:
        on = np.abs((centres - centres[start]) @ normals[start]) < 2 * thick
        on &= np.abs(normals @ normals[start]) > 0.9
        if on.sum() > share:
            best, share = on, int(on.sum())
    if share < _IN_PLANE:
        return None
    middle = centres[best].mean(axis=0)
    axes = principal_axes(centres[best])
    offset = (points - middle) @ axes.T
    on = np.abs(offset[:, 2]) < thick
    if on.sum() < least or not _is_broad(offset[on][:, :2], diagonal):
        return None
    return on


def _is_broad(flat: np.ndarray, diagonal: float) -> bool:
    """Whether points of a plane, shape [n, 2], fill an area, not a line or a fan of lines."""
    if flat.std(axis=0).min() < _BROAD * diagonal:
        return False
    low, high = np.quantile(flat, [0.02, 0.98], axis=0)
    side = np.sqrt(np.prod(high - low) / min(400, len(flat) / 8))
    cells = np.unique(np.floor((flat - low) / side).astype(np.int64)[
        ((flat >= low) & (flat <= high)).all(axis=1)], axis=0)
    return len(cells) * side**2 > _FILLED * float(np.prod(high - low))
