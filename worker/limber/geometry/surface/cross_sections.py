"""Positions of a run's cross-sections, and their number of sides."""

import numpy as np

from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.sweep import resample

SPACING = 1.5
"Distance between cross-sections in local radii."

_SIDES, _MOST_SIDES = 12, 48
_FACET = 0.025  # deviation of a carrier's facets from its circle, in radii of its thinnest twig


def sides_of_runs(skeleton: Skeleton, requested: int | None = None) -> list[int]:
    """Sides of each run's cross-section: given, or enough to hide facets beside a twig.
    """
    if requested is not None:
        return [requested] * skeleton.branch_count
    sides = [_SIDES] * skeleton.branch_count
    for members in skeleton.runs()[1:]:
        carrier = int(skeleton.branch[members[0]])
        ratio = skeleton.radius[members[0]] / max(skeleton.radius[members[1]], 1e-300)
        # polygon_factor(n) is about 1 + pi^2 / (3 n^2).
        needed = 2 * int(np.ceil(np.pi * np.sqrt(ratio / (3 * _FACET)) / 2))
        sides[carrier] = min(max(sides[carrier], needed), _MOST_SIDES)
    return sides


def run_axis(skeleton: Skeleton, run: int, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Axis [m], shape [k, 3], and radii [m] of a run, ``spacing`` radii from point to point.

    A side run starts on its parent's axis, with a radius that stays inside the parent.
    """
    nodes = skeleton.runs()[run]
    points, radius = skeleton.nodes[nodes], skeleton.radius[nodes].copy()
    if run > 0:
        # The first node is the parent's, whose radius is not this twig's.
        radius[0] = min(radius[1] if len(radius) > 1 else radius[0], 0.95 * radius[0])
    points, radius = resample(points, radius, spacing * radius)
    if len(points) < 3:
        middle = np.linspace(0, 1, 3)[:, None]
        points = points[0] + middle * (points[-1] - points[0])
        radius = np.linspace(radius[0], radius[-1], 3)
    return points, radius
