"""The paper's radii: the median distance of the nearest points from each node."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.settings import SkeletonSettings
from limber.geometry.skeleton.skeleton import LIMITED, MEASURED, Skeleton


def nearest_point_radii(skeleton: Skeleton, points: np.ndarray, settings: SkeletonSettings,
                        ) -> Skeleton:
    """Return the skeleton with r_i = median |p_j - s_i| over the k nearest points p_j of node s_i.

    Radii are clamped to [alpha D, beta D], with D the diagonal of the cloud's bounding box. The
    method states no error: the standard deviation is that of the fit, and the difference from it.

    Args:
        skeleton: As fitted, in the branch's frame.
        points: The aligned scan [m], shape [m, 3].
        settings: Settings with k, alpha and beta.
    """
    count = min(settings.radius_neighbours, len(points))
    distance = cKDTree(points).query(skeleton.nodes, k=count)[0].reshape(-1, count)
    radius = np.median(distance, axis=1)
    sigma = np.hypot(skeleton.radius_sigma, radius - skeleton.radius)
    limits = np.array(settings.radius_range) * np.linalg.norm(np.ptp(points, axis=0))
    kept = np.clip(radius, *limits)
    return replace(skeleton, radius=kept, radius_sigma=sigma, radius_state=np.where(
        kept == radius, MEASURED, LIMITED).astype(np.int8))
