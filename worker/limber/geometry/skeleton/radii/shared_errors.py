"""Errors that neighbouring points share, which no number of them averages out.

Stations that are registered a little apart, a hand scanner's drift, sections that are not round:
patches of points then lie inside or outside the fitted surface together. Their means scatter more
than independent errors of their points would let them, by as much as they share.
"""

import numpy as np

from limber.geometry.skeleton.radii.cylinders import on_cylinders
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.sweep import any_normal

_SECTORS, _LONG = 8, 2.0  # patches: so many around a branch, as long as so many radii
_LEAST = 4  # points of a patch
_SHARP = 0.2  # noise over radius, beyond which a ring's own blur moves the means of its patches
_PATCHES = 30  # that tell


def shared_error(skeleton: Skeleton, points: np.ndarray, noise: float) -> float:
    """Standard deviation [m] of what the points of a patch are off together; 0 if too few tell.

    Args:
        skeleton: Fitted to the points.
        points: The scan [m], shape [m, 3].
        noise: Standard deviation of the points [m].
    """
    low, high, share, offset = on_cylinders(skeleton, points)
    radius = share * skeleton.radius[high] + (1 - share) * skeleton.radius[low]
    residual = np.linalg.norm(offset, axis=1) - radius
    good = (np.abs(residual) < 3 * noise) & (noise < _SHARP * radius)
    if not good.any():
        return 0.0
    patch = _patches(skeleton, high[good], offset[good])
    count = np.bincount(patch)
    mean = np.bincount(patch, residual[good]) / np.maximum(count, 1)
    inside = np.bincount(patch, (residual[good] - mean[patch])**2)
    tell = count >= _LEAST
    if tell.sum() < _PATCHES:
        return 0.0
    own = inside[tell].sum() / (count[tell] - 1).sum()
    off = mean[tell] - np.median(mean[tell])
    return float(np.sqrt(max(np.mean(off**2 - own / count[tell]), 0.0)))


def _patches(skeleton: Skeleton, node: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """A number for the patch of each point: stretch of its run and sector, shape [m]."""
    axis = skeleton.nodes[node] - skeleton.nodes[skeleton.parent[node]]
    axis /= np.maximum(np.linalg.norm(axis, axis=1), 1e-300)[:, None]
    # One direction for the scan, so that sectors hardly turn along a run.
    straight = any_normal(axis[0])
    one = straight - (axis @ straight)[:, None] * axis
    angle = np.arctan2(np.einsum("ij,ij->i", offset, np.cross(axis, one)),
                       np.einsum("ij,ij->i", offset, one))
    sector = np.floor((angle / (2 * np.pi) + 0.5) * _SECTORS).astype(np.int64) % _SECTORS
    typical = np.array([np.median(skeleton.radius[own]) for own in skeleton.own_runs()])
    stretch = np.floor(skeleton.arc_length[node] / (
        _LONG * typical[skeleton.branch[node]])).astype(np.int64)
    key = (skeleton.branch[node].astype(np.int64) * (stretch.max() + 1) + stretch
           ) * _SECTORS + sector
    return np.unique(key, return_inverse=True)[1]
