"""Which cylinder of a skeleton each scanned point belongs to: the one whose surface is nearest."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.skeleton.radii.fit_kernels import nearest_of
from limber.geometry.skeleton.skeleton import Skeleton

_CANDIDATES = 6


def nearest_cylinders(skeleton: Skeleton, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for each point the node whose cylinder is nearest, and its distance [m] from it."""
    segments, residuals = [], []
    for begin in range(0, len(points), 100_000):
        match = match_cylinders(skeleton.parent, skeleton.order, skeleton.nodes, skeleton.radius,
                                points[begin:begin + 100_000])
        segments.append(match.segment)
        residuals.append(match.residual)
    return np.concatenate(segments), np.concatenate(residuals)


def point_counts(skeleton: Skeleton, points: np.ndarray) -> np.ndarray:
    """Number of points on each node's cylinder, shape [n]."""
    return np.bincount(nearest_cylinders(skeleton, points)[0], minlength=skeleton.node_count)


def on_cylinders(skeleton: Skeleton, points: np.ndarray,
                 ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Positions of points along the cylinders that they are nearest to, or inside.

    Returns:
        Lower and upper node of each, shape [m] each; the fraction of the path between them, shape
        [m] (1 throughout in the first cylinder of a twig, which has the twig's radius); and the
        vector from the axis to the point [m], shape [m, 3].
    """
    match = match_cylinders(skeleton.parent, skeleton.order, skeleton.nodes, skeleton.radius,
                            points)
    low, high = skeleton.parent[match.segment], match.segment
    foot = (1 - match.share)[:, None] * skeleton.nodes[low] + match.share[:, None] * (
        skeleton.nodes[high])
    return low, high, np.where(match.own_radius, 1.0, match.share), points - foot


@dataclass(frozen=True)
class Match:
    """For each of m points: the upper node of its cylinder, the fraction of the path to it, the
    unit normal away from the axis [m, 3], the distance from the surface [m], the radius there [m],
    and whether the cylinder has the twig's radius throughout.
    """

    segment: np.ndarray
    share: np.ndarray
    normal: np.ndarray
    residual: np.ndarray
    thick: np.ndarray
    own_radius: np.ndarray


def match_cylinders(parent: np.ndarray, order: np.ndarray, nodes: np.ndarray, radius: np.ndarray,
                    points: np.ndarray, near: np.ndarray | None = None) -> Match:
    """Find the cylinder whose surface is nearest to each point.

    Args:
        near: Upper nodes of the candidate cylinders, shape [m, k]; None: those nearby.
    """
    near = cylinders_around(parent, nodes, points) if near is None else near
    # The first cylinder of a side run has the twig's radius throughout, not its carrier's.
    own = order > order[parent]
    segment, share, normal, residual, thick = nearest_of(
        np.ascontiguousarray(points, np.float64), np.ascontiguousarray(near), parent, own,
        np.ascontiguousarray(nodes, np.float64), np.ascontiguousarray(radius, np.float64))
    return Match(segment, share, normal, residual, thick, own[segment])


def cylinders_around(parent: np.ndarray, nodes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Upper nodes of the cylinders whose middles are nearest to each point, shape [m, k]."""
    ends = np.arange(1, len(nodes))
    tree = cKDTree((nodes[ends] + nodes[parent[ends]]) / 2)
    _, near = tree.query(points, k=min(_CANDIDATES, len(ends)))
    return ends[near.reshape(len(points), -1)]
