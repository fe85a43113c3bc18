"""Loops of the axis fit over points: nearest cylinder of each, and its normal equations."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.skeleton.skeleton import Skeleton
from limber.kernels import Kernel

_nearest = Kernel(
    "nearest_cylinder", "points float64[points, 3]", "near int64[points, candidates]",
    "parent int64[nodes]", "own_radius bool[nodes]", "nodes float64[nodes, 3]",
    "radius float64[nodes]", "out segment int64[points]", "out share float64[points]",
    "out normal float64[points, 3]", "out residual float64[points]", "out thick float64[points]")
_blocks = Kernel(
    "normal_blocks", "segment int64[points]", "share float64[points]", "low float64[points]",
    "high float64[points]", "normal float64[points, 3]", "across float64[points, 3]",
    "gradient float64[points, 8]", "weight float64[points]", "out block float64[count, 8, 8]",
    "out right float64[count, 8]")
_mean = Kernel(
    "mean_on_circle", "cosine float64[points]", "sine float64[points]",
    "sharpness float64[points]", "density float64[steps]", "out mean float64[points, 2]")
_reach = Kernel(
    "reach_on_circle", "angle float64[points]", "sharpness float64[points]",
    "bessel float64[points]", "out log float64[points]", "out by_angle float64[points]",
    "out by_limit float64[points]", "limit float", "least float")


def normal_blocks(segment: np.ndarray, share: np.ndarray, low: np.ndarray, high: np.ndarray,
                  normal: np.ndarray, across: np.ndarray, gradient: np.ndarray,
                  weight: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of each cylinder's points in (x, y, z, r) of both ends: [count, 8, 8],
    [count, 8]. ``low`` and ``high`` are the radius's derivatives by the ends' radii, ``gradient``
    those of the residual, ``across`` how firmly points hold the axis across their direction."""
    block, right = np.empty((count, 8, 8)), np.empty((count, 8))
    _blocks.of(segment, share, low, high, normal, across, gradient, weight, block, right)
    return block, right


def mean_on_circle(cosine: np.ndarray, sine: np.ndarray, sharpness: np.ndarray,
                   density: np.ndarray) -> np.ndarray:
    """Mean (cos, sin) [points, 2] of positions on a circle with a ``density`` in the middles of
    even intervals, times exp(sharpness (cos(place - angle) - 1)) for each point (von Mises)."""
    mean = np.empty((len(cosine), 2))
    _mean.of(cosine, sine, sharpness, density, mean)
    return mean


def reach_on_circle(angle: np.ndarray, sharpness: np.ndarray, bessel: np.ndarray, limit: float,
                    least: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log-likelihood of points on a side seen up to ``limit``, and its derivatives by angle and
    limit. Positions beyond count ``least``, each is blurred by a von Mises distribution; the sum
    over all does not divide it. ``bessel`` is I0(sharpness) exp(-sharpness). Angles in [rad]."""
    log, by_angle, by_limit = np.empty((3, len(angle)))
    _reach.of(angle, sharpness, bessel, log, by_angle, by_limit, limit, least)
    return log, by_angle, by_limit


# Which cylinder of a skeleton each scanned point belongs to: the one whose surface is nearest.

_CANDIDATES = 6


def nearest_cylinders(skeleton: Skeleton, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for each point the node whose cylinder is nearest, and its distance [m] from it."""
    segments, residuals = [], []
    for begin in range(0, len(points), 100_000):
        match = match_cylinders(skeleton, points[begin:begin + 100_000])
        segments.append(match.segment)
        residuals.append(match.residual)
    return np.concatenate(segments), np.concatenate(residuals)


def point_counts(skeleton: Skeleton, points: np.ndarray) -> np.ndarray:
    """Number of points on each node's cylinder, shape [n]."""
    return np.bincount(nearest_cylinders(skeleton, points)[0], minlength=skeleton.node_count)


def on_cylinders(skeleton: Skeleton, points: np.ndarray,
                 ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Lower and upper node of the cylinder nearest to each point, or around it, the fraction of the
    path between them (1 in the first of a twig, which has the twig's radius), and the vector from
    the axis to the point [m]."""
    match = match_cylinders(skeleton, points)
    low, high = skeleton.parent[match.segment], match.segment
    foot = (1 - match.share)[:, None] * skeleton.nodes[low] + match.share[:, None] * (
        skeleton.nodes[high])
    return low, high, np.where(match.own_radius, 1.0, match.share), points - foot


@dataclass(frozen=True)
class Match:
    """For each of m points: the upper node of its cylinder, the fraction of the path to it, the
    unit normal away from the axis [m, 3], the distance from the surface [m], the radius there [m],
    and whether the cylinder has the twig's radius throughout."""

    segment: np.ndarray
    share: np.ndarray
    normal: np.ndarray
    residual: np.ndarray
    thick: np.ndarray
    own_radius: np.ndarray


def match_cylinders(skeleton: Skeleton, points: np.ndarray, near: np.ndarray | None = None,
                    ) -> Match:
    """Find the cylinder whose surface is nearest to each point, among those of the upper nodes
    ``near`` [m, k]; None: those nearby."""
    near = cylinders_around(skeleton.parent, skeleton.nodes, points) if near is None else near
    # The first cylinder of a side run has the twig's radius throughout, not its carrier's.
    own = skeleton.order > skeleton.order[skeleton.parent]
    share, residual, thick = np.empty((3, len(points)))
    found = np.empty(len(points), np.int64), share, np.empty((len(points), 3)), residual, thick
    _nearest.of(points, near, skeleton.parent, own, skeleton.nodes, skeleton.radius, *found)
    return Match(*found, own[found[0]])


def cylinders_around(parent: np.ndarray, nodes: np.ndarray, points: np.ndarray,
                     count: int = _CANDIDATES) -> np.ndarray:
    """Upper nodes of the cylinders whose middles are nearest to each point, shape [m, k]."""
    ends = np.arange(1, len(nodes))
    tree = cKDTree((nodes[ends] + nodes[parent[ends]]) / 2)
    _, near = tree.query(points, k=min(count, len(ends)))
    return ends[near.reshape(len(points), -1)]
