"""How much of a skeleton's volume points show by lying on a surface, and not all through it."""

from typing import Any

import numpy as np

from limber.geometry.skeleton.qsm_tables import cylinders
from limber.geometry.skeleton.skeleton import Skeleton

RESOLVED = 0.5
"""Fraction of the volume that points must show, for the whole to be stated."""
_STRETCH = 10.0  # length, in median radii of a run, that is judged by itself
_FITTED = 5  # numbers of a cylinder that were fitted to a stretch's points
_SURE = np.log(19.0)  # odds of 95 %
_FAR = 0.05  # fraction of points, the farthest, that do not count: leaves, other branches


def surface_share(skeleton: Skeleton, node_of_point: np.ndarray, residual: np.ndarray) -> float:
    """Fraction of the volume in stretches whose points show a surface.

    Models of the distances from the axis are compared: a mean and a scatter around it, or points
    all through the section. A stretch shows a surface if the first is 19 times as likely. One depth
    camera shows it as well as a scan from all around.

    Args:
        skeleton: Axes and radii [m].
        node_of_point: Node of each point, shape [m].
        residual: Distance of each point from the surface of its cylinder [m], shape [m].
    """
    stretch = _stretches(skeleton)
    of_point = stretch[node_of_point]
    away = np.maximum(1 + residual / skeleton.radius[node_of_point], 1e-3)
    order = np.lexsort((away, of_point))
    ends = np.cumsum(np.bincount(of_point, minlength=stretch.max() + 1))
    shown = np.array([_log_odds(own[:int(np.ceil((1 - _FAR) * len(own)))]) > _SURE
                      for own in np.split(away[order], ends[:-1])])
    volume = cylinders(skeleton)[1]
    return float(volume[shown[stretch[1:]]].sum() / max(volume.sum(), 1e-300))


def without_volumes(share: float) -> dict[str, Any]:
    """Return the numbers of a stage's result of which a scan with this share states none."""
    return {"surface_share": share} | ({} if share >= RESOLVED else dict.fromkeys((
        "surface_volume_m3", "mesh_volume_m3", "expected_volume_m3", "volume_interval_m3")))


def _stretches(skeleton: Skeleton) -> np.ndarray:
    """Number of each node's stretch, shape [n]."""
    label = np.zeros(skeleton.node_count, np.int64)
    for run, nodes in enumerate(skeleton.own_runs()):
        along = np.cumsum(skeleton.steps[nodes])
        label[nodes] = skeleton.node_count * run + (
            along - along[0]) // (_STRETCH * float(np.median(skeleton.radius[nodes])))
    return np.unique(label, return_inverse=True)[1]


def _log_odds(away: np.ndarray) -> float:
    """Logarithm of the odds of a surface, from distances over radii, shape [m]."""
    count = len(away)
    if count <= _FITTED:
        return -np.inf
    # What was fitted to the points makes their scatter look small.
    scatter = np.sqrt(max(float(away.var()), 1e-4) * count / (count - _FITTED))
    square = float(np.mean(away**2)) / 2
    return float(count * (np.log(square / scatter) + 0.5 - 0.5 * np.log(2 * np.pi)) - np.sum(
        np.log(away)))
