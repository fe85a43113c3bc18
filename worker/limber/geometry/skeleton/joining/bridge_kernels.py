"""Loops of the search for bridges: cost of joining each end to each node of other pieces."""

import math

import numpy as np
from numba import njit

_TURN = math.radians(35.0)  # turn that doubles the price
_SIDE = 0.25  # price of a fork over that of a continuation
# Usual angle of twigs to their carrier, and the deviation from it that doubles the price.
_STAND, _STAND_DOUBLES = math.radians(45.0), math.radians(60.0)
_RATIO = 0.7  # price of a radius ratio of e
_FARTHER = 2.0  # an end may reach this many limits if it points at its target
_POINTS_AT = math.radians(25.0)
_LEAST = 1e-12
# Paths of an end that are kept: the cheapest ones, and of these so many to each piece. A round
# takes an end's cheapest allowed path; those to all nodes of thousands of pieces fill the memory.
_KEPT, _KEPT_OF_PIECE = 256, 32


@njit(cache=True)
def _turned(direction: np.ndarray, vector: np.ndarray, radius: float) -> float:
    """Angle [rad] from a direction to a path; an offset of up to a radius is no turn."""
    along = vector[0] * direction[0] + vector[1] * direction[1] + vector[2] * direction[2]
    x, y, z = (vector[0] - along * direction[0], vector[1] - along * direction[1],
               vector[2] - along * direction[2])
    return math.atan2(max(math.sqrt(x * x + y * y + z * z) - radius, 0.0), along)


@njit(cache=True)
def priced(nodes: np.ndarray, thickness: np.ndarray, axis: np.ndarray, single: np.ndarray,
           label: np.ndarray, end_node: np.ndarray, end_direction: np.ndarray,
           end_radius: np.ndarray, end_of: np.ndarray, limit: float,
           ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Price the paths from all ends with a direction to other pieces; keep the cheapest of each.

    Args:
        nodes: Positions [m], shape [n, 3].
        thickness: First radii [m], shape [n].
        axis: Direction of the axis at each node, zero where there is none, shape [n, 3].
        single: Whether a node's piece has neither direction nor thickness, shape [n].
        label: Which piece each node belongs to, shape [n].
        end_node: Nodes of the ends, shape [k].
        end_direction: Outwards, zero where there is none, shape [k, 3].
        end_radius: Typical thickness [m], shape [k].
        end_of: Which end a node is, -1 if none, shape [n].
        limit: Longest path [m], unless an end points straight at its target.

    Returns:
        Columns of :class:`.bridges.Hypotheses`, without the last.
    """
    one, other = [0 for _ in range(0)], [0 for _ in range(0)]
    length, price, turn = ([0.0 for _ in range(0)], [0.0 for _ in range(0)],
                           [0.0 for _ in range(0)])
    meets = [0 for _ in range(0)]
    vector = np.empty(3)
    of_piece = np.zeros(label.max() + 1, np.int64)
    for k in range(len(end_node)):
        begin = len(one)
        own, out, radius = end_node[k], end_direction[k], end_radius[k]
        if out[0] == 0 and out[1] == 0 and out[2] == 0:
            continue
        for node in range(len(nodes)):
            if label[node] == label[own]:
                continue
            square = 0.0
            for j in range(3):
                vector[j] = nodes[node, j] - nodes[own, j]
                square += vector[j] * vector[j]
            far = max(math.sqrt(square), _LEAST)
            if far > _FARTHER * limit:
                continue
            turned = _turned(out, vector, radius)
            if far > (_FARTHER if turned < _POINTS_AT else 1.0) * limit:
                continue
            stand = _STAND
            if axis[node, 0] != 0 or axis[node, 1] != 0 or axis[node, 2] != 0:
                along = abs(vector[0] * axis[node, 0] + vector[1] * axis[node, 1]
                            + vector[2] * axis[node, 2])
                stand = math.acos(min(along / far, 1.0))
            # For a single patch of skin, the contraction gives no thickness.
            thicker = 0.0 if single[node] else math.log(radius / max(thickness[node], _LEAST))
            side = (_SIDE + ((stand - _STAND) / _STAND_DOUBLES)**2
                    + _RATIO * max(thicker, 0.0))
            comes, end = np.inf, end_of[node]
            if end >= 0 and (end_direction[end, 0] != 0 or end_direction[end, 1] != 0
                             or end_direction[end, 2] != 0):
                angle = _turned(end_direction[end], -vector, end_radius[end])
                comes = ((angle / _TURN)**2
                         + _RATIO * abs(math.log(radius / end_radius[end])))
            one.append(own)
            other.append(node)
            length.append(far)
            price.append(far * (1 + (turned / _TURN)**2 + min(side, comes)))
            turn.append(turned)
            meets.append(1 if comes < side else 0)
        if len(one) - begin <= _KEPT_OF_PIECE:
            continue
        kept = _cheapest(np.array(price[begin:]), label[np.array(other[begin:])], of_piece)
        for place, which in enumerate(kept):
            there, here = begin + place, begin + which
            other[there], length[there], price[there] = other[here], length[here], price[here]
            turn[there], meets[there] = turn[here], meets[here]
        for _ in range(len(one) - begin - len(kept)):
            one.pop()
            other.pop()
            length.pop()
            price.pop()
            turn.pop()
            meets.pop()
    return (np.array(one), np.array(other), np.array(length), np.array(price), np.array(turn),
            np.array(meets))


@njit(cache=True)
def _cheapest(price: np.ndarray, label: np.ndarray, of_piece: np.ndarray) -> np.ndarray:
    """Indices of an end's paths to keep, ascending; ``of_piece`` is a counter of zeros."""
    order = np.argsort(price, kind="mergesort")
    kept = np.zeros(len(price), np.bool_)
    count = 0
    for index in order:
        if of_piece[label[index]] < _KEPT_OF_PIECE:
            of_piece[label[index]] += 1
            kept[index] = True
            count += 1
            if count == _KEPT:
                break
    for index in order:
        of_piece[label[index]] = 0
    return np.flatnonzero(kept)


@njit(cache=True)
def nearest_others(nodes: np.ndarray, label: np.ndarray, own: np.ndarray, limit: float,
                   count: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the nodes of other pieces nearest to each of some nodes, nearest first.

    Args:
        nodes: Positions [m], shape [n, 3].
        label: Which piece each node belongs to, shape [n].
        own: The querying nodes, shape [m].
        limit: Only nodes nearer than that [m].
        count: Most nodes to find.

    Returns:
        Nodes, -1 where there are fewer, and distances [m], both of shape [m, count].
    """
    near = np.full((len(own), count), -1)
    distance = np.full((len(own), count), limit)
    order = np.argsort(nodes[:, 0], kind="mergesort")
    rank = np.empty(len(nodes), np.int64)
    rank[order] = np.arange(len(nodes))
    for k in range(len(own)):
        node = own[k]
        for step in (-1, 1):
            # To both sides, as far as a node can still be nearer.
            at = rank[node] + step
            while 0 <= at < len(nodes):
                other = order[at]
                at += step
                x, y, z = (nodes[other, 0] - nodes[node, 0], nodes[other, 1] - nodes[node, 1],
                           nodes[other, 2] - nodes[node, 2])
                if abs(x) >= distance[k, count - 1]:
                    break
                if label[other] == label[node]:
                    continue
                far, worse = math.sqrt(x * x + y * y + z * z), count - 1
                if far >= distance[k, worse]:
                    continue
                while worse > 0 and distance[k, worse - 1] > far:
                    distance[k, worse] = distance[k, worse - 1]
                    near[k, worse] = near[k, worse - 1]
                    worse -= 1
                distance[k, worse], near[k, worse] = far, other
    return near, distance


@njit(cache=True)
def far_sides(nodes: np.ndarray, spread: np.ndarray, label: np.ndarray, own: np.ndarray,
              ) -> np.ndarray:
    """Largest distance of the points of a node's piece from it [m], for each of ``own``, shape [m].

    Args:
        nodes: Positions [m], shape [n, 3].
        spread: Largest distance of each node's points from it [m], shape [n].
        label: Which piece each node belongs to, shape [n].
        own: The querying nodes, in any order, repeats allowed, shape [m].
    """
    order = np.argsort(label, kind="mergesort")
    start = np.searchsorted(label[order], np.arange(label.max() + 2))
    known = np.full(len(nodes), -1.0)
    far = np.empty(len(own))
    for k in range(len(own)):
        node = own[k]
        if known[node] < 0:
            for at in range(start[label[node]], start[label[node] + 1]):
                other = order[at]
                x, y, z = (nodes[other, 0] - nodes[node, 0], nodes[other, 1] - nodes[node, 1],
                           nodes[other, 2] - nodes[node, 2])
                known[node] = max(known[node], math.sqrt(x * x + y * y + z * z) + spread[other])
        far[k] = known[node]
    return far
