"""Loops of the search for bridges: cost of joining each end to each node of other pieces."""

import numpy as np

from limber.kernels import Kernel

Boxes = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""What :func:`boxes` returns."""

# Paths of an end that are kept: the cheapest ones, and of these so many to each piece. A round
# takes an end's cheapest allowed path. Those to all nodes of thousands of pieces take hours: many
# ends keep fewer.
_KEPT, _KEPT_OF_PIECE, _KEPT_OF_ALL = 256, 32, 50_000

_TREE = ("order int64[nodes]", "span int64[boxes, 2]", "low float64[boxes, 3]",
         "high float64[boxes, 3]", "only int64[boxes]")
_boxes = Kernel(
    "boxes_around", "points float64[nodes, 3]", "label int64[nodes]", "out order int64[nodes]",
    "out span int64[boxes, 2]", "out low float64[boxes, 3]", "out high float64[boxes, 3]",
    "out only int64[boxes]", returns="int")
_priced = Kernel(
    "bridges_priced", "nodes float64[nodes, 3]", "thickness float64[nodes]",
    "axis float64[nodes, 3]", "single bool[nodes]", "label int64[nodes]", "end_node int64[ends]",
    "end_direction float64[ends, 3]", "end_radius float64[ends]", "end_of int64[nodes]", *_TREE,
    "out one int64[room]", "out other int64[room]", "out meets int64[room]",
    "out length float64[room]", "out price float64[room]", "out turn float64[room]",
    "limit float", "most int", "most_of_piece int", returns="int")
_nearest_others = Kernel(
    "nearest_others", "nodes float64[nodes, 3]", "label int64[nodes]", "own int64[own]", *_TREE,
    "out near int64[own, count]", "out distance float64[own, count]", "limit float")
_far_sides = Kernel(
    "far_sides", "nodes float64[nodes, 3]", "spread float64[nodes]", "label int64[nodes]",
    "own int64[own]", "order int64[nodes]", "start int64[labels]", "out far float64[own]")


def boxes(points: np.ndarray, label: np.ndarray) -> Boxes:
    """Halve points [n, 3] along their longest side, again and again: their order [n], and boxes,
    where 2 i + 1 and 2 i + 2 are parts of i. Of each: first and last place in that order [b, 2],
    corners [b, 3] [m], and its points' label [b], -1 if they differ."""
    count = 0
    while True:
        found = (np.empty(len(points), np.int64), np.empty((count, 2), np.int64),
                 np.empty((count, 3)), np.empty((count, 3)), np.empty(count, np.int64))
        if (needed := _boxes.of(points, label, *found)) == count:
            return found
        count = needed


def priced(nodes: np.ndarray, thickness: np.ndarray, axis: np.ndarray, single: np.ndarray,
           label: np.ndarray, end_node: np.ndarray, end_direction: np.ndarray,
           end_radius: np.ndarray, end_of: np.ndarray, limit: float, tree: Boxes,
           ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Price the paths from the k ends to the n nodes of other pieces; keep the cheapest of each.
    Returns the columns of Hypotheses but the last. Directions are zero and ``end_of`` is -1 where
    there is none. Only an end that points straight at its target goes beyond ``limit`` [m]."""
    most = min(max(_KEPT_OF_ALL // max(len(end_node), 1), _KEPT_OF_PIECE), _KEPT)
    one, other, meets = np.empty((3, most * len(end_node)), np.int64)
    length, price, turn = np.empty((3, most * len(end_node)))
    count = _priced.of(nodes, thickness, axis, single, label, end_node, end_direction, end_radius,
                       end_of, *tree, one, other, meets, length, price, turn, limit, most,
                       _KEPT_OF_PIECE)
    return (one[:count], other[:count], length[:count], price[:count], turn[:count],
            meets[:count])


def nearest_others(nodes: np.ndarray, label: np.ndarray, own: np.ndarray, limit: float,
                   count: int, tree: Boxes) -> tuple[np.ndarray, np.ndarray]:
    """Find up to ``count`` nodes of other pieces within ``limit`` [m] of each node in ``own``,
    nearest first: nodes, -1 where there are fewer, and distances [m], shape [own, count] each."""
    near, distance = np.empty((len(own), count), np.int64), np.empty((len(own), count))
    _nearest_others.of(nodes, label, own, *tree, near, distance, limit)
    return near, distance


def far_sides(nodes: np.ndarray, spread: np.ndarray, label: np.ndarray, own: np.ndarray,
              ) -> np.ndarray:
    """Largest distance [m] of the points of a node's piece from it, for each node in ``own``.
    ``spread`` [n] [m] is that of each node's own points."""
    order = np.argsort(label, kind="stable")
    start = np.searchsorted(label[order], np.arange(label.max() + 2))
    far = np.empty(len(own))
    _far_sides.of(nodes, spread, label, own, order, start, far)
    return far
