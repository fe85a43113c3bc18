"""Ends of runs: the contraction overshoots or shortens them, and a fit lets them slide."""

import numpy as np

from limber.geometry.skeleton.radii.cylinders import nearest_cylinders, point_counts
from limber.geometry.skeleton.skeleton import Skeleton

_REACHED = 0.98  # quantile of the points along an end at which it ends


def without_bare_ends(skeleton: Skeleton, points: np.ndarray) -> Skeleton:
    """Drop end nodes that no point belongs to: the contraction can overshoot an end."""
    count = point_counts(skeleton, points)
    keep = np.ones(skeleton.node_count, bool)
    for members in skeleton.runs():
        if (skeleton.parent == members[-1]).any():
            continue
        own = list(members[1:])
        while len(own) > 2 and count[own[-1]] == 0:
            keep[own.pop()] = False
    # The root end: a bare first segment belongs to its upper node.
    children = skeleton.child_counts()
    root, parent = 0, skeleton.parent.copy()
    while children[root] == 1:
        following = int(np.flatnonzero(parent == root)[0])
        if count[following] > 0 or children[following] != 1:
            break
        keep[root], parent[following], root = False, -1, following
    return skeleton.subset(keep, parent)


def ends_within(skeleton: Skeleton, points: np.ndarray) -> Skeleton:
    """Shorten ends that slid along their axis beyond the points during a fit."""
    nodes = skeleton.nodes.copy()
    segment, _ = nearest_cylinders(skeleton, points)
    inner = np.flatnonzero(skeleton.parent == 0)
    ends = [(int(tip), int(skeleton.parent[tip])) for tip in skeleton.tips()]
    for end, before in [*ends, *([(0, int(inner[0]))] if len(inner) == 1 else [])]:
        step = nodes[end] - skeleton.nodes[before]
        length = float(np.linalg.norm(step))
        mine = points[np.isin(segment, [end, before] if end else [
            before, *np.flatnonzero(skeleton.parent == before)])]
        if length == 0 or len(mine) < 3:
            continue
        reach = float(np.quantile((mine - skeleton.nodes[before]) @ step / length, _REACHED))
        if length > reach + 0.5 * skeleton.radius[end]:
            nodes[end] = skeleton.nodes[before] + step * max(reach / length, 0.1)
    return skeleton.moved(nodes)


def with_full_tips(skeleton: Skeleton, points: np.ndarray, noise: float) -> Skeleton:
    """Lengthen ends that the contraction shortened, as far as there are points.

    Args:
        skeleton: With radii.
        points: Scanned points [m], shape [m, 3].
        noise: Standard deviation of the points [m].
    """
    nodes = skeleton.nodes.copy()
    segment, _ = nearest_cylinders(skeleton, points)
    inner = int(np.flatnonzero(skeleton.parent == 0)[0])
    for end, before in [*((int(tip), int(skeleton.parent[tip])) for tip in skeleton.tips()),
                        (0, inner)]:
        direction = nodes[end] - skeleton.nodes[_direction_node(skeleton, end, before)]
        length = np.linalg.norm(direction)
        if length == 0:
            continue
        direction /= length
        # The contraction may overshoot an end by far: then the next cylinder has its points.
        beside = [end, before] if end else [inner, *np.flatnonzero(skeleton.parent == inner)]
        along = _points_along(points[np.isin(segment, beside)] - nodes[end], direction,
                              skeleton.radius[end], noise)
        if len(along) < 3:
            continue
        reach = float(np.quantile(along, _REACHED)) - (skeleton.radius[end] if end else 0.0)
        nodes[end] = nodes[end] + direction * np.clip(
            reach, -0.8 * length, 20 * skeleton.radius[end])
    return skeleton.moved(nodes)


def _direction_node(skeleton: Skeleton, end: int, before: int) -> int:
    """The node that gives an end's direction: up to three before a tip."""
    for _ in range(2):
        if end and skeleton.parent[before] > 0:
            before = int(skeleton.parent[before])
    return before


def _points_along(offset: np.ndarray, direction: np.ndarray, radius: float, noise: float,
                  ) -> np.ndarray:
    """Distances of points around an end along its direction, up to the next gap [m], sorted."""
    along = offset @ direction
    across = np.linalg.norm(offset - along[:, None] * direction, axis=1)
    along = np.sort(along[across < 2.0 * radius + 3 * noise])
    # An end does not reach over a gap.
    breaks = np.flatnonzero((np.diff(along) > 2 * radius) & (along[1:] > 0))
    return along[:breaks[0] + 1] if len(breaks) else along
