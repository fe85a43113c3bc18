"""Ends and radii along a run, as in wood and within what a scan can show."""

from dataclasses import replace

import numpy as np

from limber.geometry.skeleton.radii.fit_kernels import nearest_cylinders, point_counts
from limber.geometry.skeleton.skeleton import LIMITED, MEASURED, Skeleton
from limber.geometry.skeleton.sweep import arc_lengths

# Ends of runs: the contraction overshoots or shortens them, and a fit lets them slide.

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
    """Lengthen ends that the contraction shortened, as far as there are points [m, 3] [m], whose
    standard deviation is ``noise`` [m]."""
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


# Radii along a run as in wood: steady, tapering, and within what a scan can show.

_RAG = 0.25  # fraction of a run's median radius (by length) below which a part is ignored
_STEADY = 40  # points that make a reliable radius
_SURE = 1.96  # standard deviations
_GROWTH = 1.25  # largest growth of a radius along a run, over the median measured so far
_SPEAK = 1 / 8  # fraction of a run's nodes, and of its points, that decide for what follows


def steadied(skeleton: Skeleton, points: np.ndarray) -> Skeleton:
    """Return the skeleton with each first radius the median of those around it that have points.
    Without points it may be a tenth of that; nodes and smoothing go by it, so the stretch would
    follow the noise and stay far too thin."""
    count = point_counts(skeleton, points)
    radius = skeleton.radius.copy()
    for members, own in zip(skeleton.runs(), skeleton.own_runs(), strict=True):
        speak = own[count[own] > 0]
        if len(speak) == 0:
            continue
        along = arc_lengths(skeleton.nodes[members])
        arc = along[np.searchsorted(members, speak)]
        for node, here in zip(own, along[-len(own):], strict=True):
            # Each has a point or more: no more nodes than that to either side.
            middle = int(np.searchsorted(arc, here))
            around = slice(max(middle - _STEADY, 0), middle + _STEADY)
            order = np.argsort(np.abs(arc[around] - here), kind="stable")
            near = speak[around][order]
            near = near[:int(np.searchsorted(np.cumsum(count[near]), _STEADY)) + 1]
            radius[node] = _middle(skeleton.radius[near], count[near])
    return replace(skeleton, radius=radius)


def tapered(skeleton: Skeleton, count: np.ndarray | None = None) -> Skeleton:
    """Return the skeleton with radii that hardly grow towards tips, changed nodes marked: no more
    than the carrier's at a run's start, nor than 1.25 times the median so far, at its tip that
    median."""
    # Else a bunch of twigs that the scan did not resolve would become a fat cylinder. The limiting
    # radius counts at the upper end of its interval, as a foot with few points says little about
    # the twig. A radius far below most of the run does not count, as a ragged stem foot does not
    # make the stem thin; nor do a few points.
    radius, state = skeleton.radius.copy(), skeleton.radius_state.copy()
    at_most = radius + _SURE * skeleton.radius_sigma
    count = np.ones(skeleton.node_count) if count is None else count
    step = skeleton.steps
    for own in skeleton.own_runs():
        carrier = skeleton.parent[own[0]]
        cap = np.inf if carrier < 0 else max(at_most[carrier], at_most[skeleton.parent[carrier]])
        speaks = (state[own] == MEASURED) & (count[own] > 0)
        if speaks.any():
            speaks &= radius[own] > _RAG * _middle(radius[own[speaks]], step[own[speaks]])
        counted, total = np.cumsum(count[own] * speaks), float(count[own].sum())
        for k, node in enumerate(own):
            before = own[:k][speaks[:k]]
            # The first few are too few to represent the run: a cut stem starts with a ragged end.
            if len(before) >= max(6, int(_SPEAK * len(own))) and (
                    counted[k - 1] >= _SPEAK * total):
                allowed = _GROWTH + (1 - _GROWTH) * k / len(own)
                cap = min(cap, allowed * _middle(at_most[before], count[before]))
            if radius[node] > cap:
                radius[node], at_most[node], state[node] = cap, cap, LIMITED
    return replace(skeleton, radius=radius, radius_state=state)


def _middle(values: np.ndarray, weight: np.ndarray) -> float:
    """Weighted median of values."""
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order[int(np.searchsorted(total, total[-1] / 2))]])
