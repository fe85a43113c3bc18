"""A binary tree of boxes around points: a search visits only boxes that may hold what it seeks."""

import math

import numpy as np

from limber.core.numerics.compiled import compiled_exactly

Boxes = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""What :func:`boxes` returns."""

_LEAF = 8  # most points of the last boxes


@compiled_exactly
def boxes(points: np.ndarray, label: np.ndarray) -> Boxes:
    """Halve the points along their longest side, again and again.

    Args:
        points: Positions [m], shape [n, 3].
        label: Piece of each point, shape [n].

    Returns:
        An order of the points, shape [n]; and of each box, children of box i being 2 i + 1 and
        2 i + 2: first and last place in that order, shape [b, 2], lower and upper corner [m], both
        of shape [b, 3], and the label of all of its points, -1 if they differ, shape [b].
    """
    total, depth = len(points), 0
    while total > _LEAF << depth:
        depth += 1
    count = (2 << depth) - 1
    order, span = np.arange(total), np.empty((count, 2), np.int64)
    low, high, only = np.empty((count, 3)), np.empty((count, 3)), np.empty(count, np.int64)
    span[0] = (0, total)
    for box in range(count):
        begin, end = span[box]
        low[box], high[box], only[box] = np.inf, -np.inf, -1
        for place in range(begin, end):
            point = order[place]
            for k in range(3):
                low[box, k] = min(low[box, k], points[point, k])
                high[box, k] = max(high[box, k], points[point, k])
            if place == begin:
                only[box] = label[point]
            elif only[box] != label[point]:
                only[box] = -1
        if 2 * box + 2 >= count:
            continue
        middle = (begin + end) // 2
        span[2 * box + 1], span[2 * box + 2] = (begin, middle), (middle, end)
        if end > begin:
            own, axis = order[begin:end].copy(), np.argmax(high[box] - low[box])
            order[begin:end] = own[np.argsort(points[own, axis], kind="mergesort")]
    return order, span, low, high, only


@compiled_exactly
def nearest_in_box(point: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Distance [m] of a point, shape [3], from a box with these corners; infinite if empty."""
    square = 0.0
    for k in range(3):
        beyond = max(low[k] - point[k], point[k] - high[k], 0.0)
        square += beyond * beyond
    return math.sqrt(square)
