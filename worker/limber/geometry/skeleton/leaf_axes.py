"""Axes through the middle of stems and leaves, where most points lie on no cylinder."""

from dataclasses import replace

import numpy as np

from limber.geometry.skeleton.confidence import doubted
from limber.geometry.skeleton.repair.attachment import attached
from limber.geometry.skeleton.repair.resampling import resampled
from limber.geometry.skeleton.repair.run_ends import with_full_tips
from limber.geometry.skeleton.repair.run_radii import limited, tapered
from limber.geometry.skeleton.skeleton import INTERPOLATED, Skeleton

_EVENED = 3  # rounds of smoothing


def through_leaves(skeleton: Skeleton, points: np.ndarray, noise: float,
                   radius_limits: tuple[float, float]) -> Skeleton:
    """Place axes in the middle of stem and leaves, without a fit: leaves are not cylinders.

    A leaf gets the radius of its stalk, for lack of a better one, marked as not measured.

    Args:
        skeleton: With first radii.
        points: The scan, thinned [m], shape [m, 3].
        noise: Standard deviation of the points [m].
        radius_limits: Least and largest radius [m].
    """
    skeleton = attached(resampled(skeleton))
    for _ in range(_EVENED):
        skeleton = skeleton.moved(_evened(skeleton))
    skeleton = with_full_tips(tapered(limited(skeleton, *radius_limits)), points, noise)
    skeleton = replace(skeleton, radius_sigma=0.25 * skeleton.radius,
                       radius_state=np.full(skeleton.node_count, INTERPOLATED, np.int8))
    return doubted(skeleton, points, noise)


def _evened(skeleton: Skeleton) -> np.ndarray:
    """Each node moved half way to the midpoint of its neighbours on the run [m], shape [n, 3]."""
    nodes = skeleton.nodes.copy()
    for members in skeleton.runs():
        inner, old = members[1:-1], skeleton.nodes
        nodes[inner] = 0.5 * old[inner] + 0.25 * (old[members[:-2]] + old[members[2:]])
    return nodes
