"""Loops of the search for bridges: cost of joining each end to each node of other pieces."""

import heapq
import math

import numpy as np

from limber.core.numerics.compiled import compiled_exactly

# A binary tree of boxes around points: a search visits only boxes that may hold what it seeks.

Boxes = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""What :func:`boxes` returns."""

_LEAF = 8  # most points of the last boxes


@compiled_exactly
def boxes(points: np.ndarray, label: np.ndarray) -> Boxes:
    """Halve points [n, 3] along their longest side, again and again: their order [n], and boxes,
    where 2 i + 1 and 2 i + 2 are parts of i. Of each: first and last place in that order [b, 2],
    corners [b, 3] [m], and its points' label [b], -1 if they differ."""
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


_TURN = math.radians(35.0)  # turn that doubles the price
_SIDE = 0.25  # price of a fork over that of a continuation
# Usual angle of twigs to their carrier, and the deviation from it that doubles the price.
_STAND, _STAND_DOUBLES = math.radians(45.0), math.radians(60.0)
_RATIO = 0.7  # price of a radius ratio of e
_FARTHER = 2.0  # an end may reach this many limits if it points at its target
_POINTS_AT = math.radians(25.0)
_LEAST = 1e-12
# Paths of an end that are kept: the cheapest ones, and of these so many to each piece. A round
# takes an end's cheapest allowed path. Those to all nodes of thousands of pieces take hours: many
# ends keep fewer.
_KEPT, _KEPT_OF_PIECE, _KEPT_OF_ALL = 256, 32, 50_000
_ROUNDING = 1e-9  # relative error of a bound


@compiled_exactly
def _turned(direction: np.ndarray, vector: np.ndarray, radius: float) -> float:
    """Angle [rad] from a direction to a path; an offset of up to a radius is no turn."""
    along = vector[0] * direction[0] + vector[1] * direction[1] + vector[2] * direction[2]
    x, y, z = (vector[0] - along * direction[0], vector[1] - along * direction[1],
               vector[2] - along * direction[2])
    return math.atan2(max(math.sqrt(x * x + y * y + z * z) - radius, 0.0), along)


@compiled_exactly
def priced(nodes: np.ndarray, thickness: np.ndarray, axis: np.ndarray, single: np.ndarray,
           label: np.ndarray, end_node: np.ndarray, end_direction: np.ndarray,
           end_radius: np.ndarray, end_of: np.ndarray, limit: float, tree: Boxes,
           ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Price the paths from the k ends to the n nodes of other pieces; keep the cheapest of each.
    Returns the columns of Hypotheses but the last. Directions are zero and ``end_of`` is -1 where
    there is none. Only an end that points straight at its target goes beyond ``limit`` [m]."""
    most = min(max(_KEPT_OF_ALL // max(len(end_node), 1), _KEPT_OF_PIECE), _KEPT)
    total = most * len(end_node)
    one, other, meets = (np.empty(total, np.int64), np.empty(total, np.int64),
                         np.empty(total, np.int64))
    length, price, turn = np.empty(total), np.empty(total), np.empty(total)
    vector, of_piece, count = np.empty(3), np.zeros(label.max() + 1, np.int64), 0
    near, row = np.empty(len(nodes), np.int64), np.empty((len(nodes), 4))
    for k in range(len(end_node)):
        own, out, radius = end_node[k], end_direction[k], end_radius[k]
        if out[0] == 0 and out[1] == 0 and out[2] == 0:
            continue
        here, cheap, known, tried = nodes[own], np.inf, 0, most
        waiting = [(0.0, 0)]
        while waiting:
            least, box = heapq.heappop(waiting)
            if least > cheap:
                break
            if 2 * box + 2 < len(tree[1]):
                for child in (2 * box + 1, 2 * box + 2):
                    if tree[4][child] != label[own]:
                        least = _least_price(here, out, radius, limit, tree[2][child],
                                             tree[3][child])
                        if least <= cheap:
                            heapq.heappush(waiting, (least, child))
                continue
            for place in range(tree[1][box, 0], tree[1][box, 1]):
                node = tree[0][place]
                if label[node] == label[own]:
                    continue
                for j in range(3):
                    vector[j] = nodes[node, j] - here[j]
                far, cost, turned, meet = _path(vector, out, radius, limit, thickness[node],
                                                axis[node], single[node], end_of[node],
                                                end_direction, end_radius)
                if cost < np.inf:
                    near[known], row[known] = node, (far, cost, turned, meet)
                    known += 1
            if known >= 2 * tried:
                cheap = (1 + _ROUNDING) * _kept_to(row[:known, 1], label[near[:known]], of_piece,
                                                   most)
                tried = known
        # By node, as equal prices are taken in that order.
        order = np.argsort(near[:known], kind="mergesort")
        for which in order[_cheapest(row[order, 1], label[near[order]], of_piece, most)]:
            one[count], other[count], meets[count] = own, near[which], int(row[which, 3])
            length[count], price[count], turn[count] = row[which, 0], row[which, 1], row[which, 2]
            count += 1
    return (one[:count], other[:count], length[:count], price[:count], turn[:count],
            meets[:count])


@compiled_exactly
def _path(vector: np.ndarray, out: np.ndarray, radius: float, limit: float, thick: float,
          axis: np.ndarray, single: bool, end: int, end_direction: np.ndarray,
          end_radius: np.ndarray) -> tuple[float, float, float, float]:
    """Length [m], price [m] (infinite: too long) and turn of a path from an end, and whether its
    target is an end that comes towards it."""
    far = max(math.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2]),
              _LEAST)
    if far > _FARTHER * limit:
        return far, np.inf, 0.0, 0.0
    turned = _turned(out, vector, radius)
    if far > (_FARTHER if turned < _POINTS_AT else 1.0) * limit:
        return far, np.inf, turned, 0.0
    stand = _STAND
    if axis[0] != 0 or axis[1] != 0 or axis[2] != 0:
        along = abs(vector[0] * axis[0] + vector[1] * axis[1] + vector[2] * axis[2])
        stand = math.acos(min(along / far, 1.0))
    # For a single patch of skin, the contraction gives no thickness.
    thicker = 0.0 if single else math.log(radius / max(thick, _LEAST))
    side = _SIDE + ((stand - _STAND) / _STAND_DOUBLES)**2 + _RATIO * max(thicker, 0.0)
    comes = np.inf
    if end >= 0 and (end_direction[end, 0] != 0 or end_direction[end, 1] != 0
                     or end_direction[end, 2] != 0):
        angle = _turned(end_direction[end], -vector, end_radius[end])
        comes = (angle / _TURN)**2 + _RATIO * abs(math.log(radius / end_radius[end]))
    return (far, far * (1 + (turned / _TURN)**2 + min(side, comes)), turned,
            1.0 if comes < side else 0.0)


@compiled_exactly
def _least_price(here: np.ndarray, out: np.ndarray, radius: float, limit: float, low: np.ndarray,
                 high: np.ndarray) -> float:
    """A lower bound of the price [m] of paths from an end into a box: shares of the length, and of
    the turn into a ball around the box. Infinite: none is allowed."""
    far = nearest_in_box(here, low, high)
    if far > _FARTHER * limit:
        return np.inf
    x, y, z = ((low[0] + high[0]) / 2 - here[0], (low[1] + high[1]) / 2 - here[1],
               (low[2] + high[2]) / 2 - here[2])
    half = math.sqrt((high[0] - low[0])**2 + (high[1] - low[1])**2 + (high[2] - low[2])**2) / 2
    along = x * out[0] + y * out[1] + z * out[2]
    aside = math.sqrt(max(x * x + y * y + z * z - along * along, 0.0))
    # The angle falls with the path's part along the direction, and ahead it rises with the part
    # aside.
    ahead = along + half
    aside += -half if ahead >= 0 else half
    turned = math.atan2(max(aside - radius, 0.0), ahead)
    if far > limit and turned >= _POINTS_AT:
        return np.inf
    return (1 - _ROUNDING) * far * (1 + (turned / _TURN)**2)


@compiled_exactly
def _kept_to(price: np.ndarray, label: np.ndarray, of_piece: np.ndarray, most: int) -> float:
    """The largest price [m] that an end keeps; infinite while it may keep more paths."""
    kept = _cheapest(price, label, of_piece, most)
    return price[kept].max() if len(kept) == most else np.inf


@compiled_exactly
def _cheapest(price: np.ndarray, label: np.ndarray, of_piece: np.ndarray, most: int) -> np.ndarray:
    """Indices of an end's paths to keep, ascending; ``of_piece`` is a counter of zeros."""
    order = np.argsort(price, kind="mergesort")
    kept = np.zeros(len(price), np.bool_)
    count = 0
    for index in order:
        if of_piece[label[index]] < _KEPT_OF_PIECE:
            of_piece[label[index]] += 1
            kept[index] = True
            count += 1
            if count == most:
                break
    for index in order:
        of_piece[label[index]] = 0
    return np.flatnonzero(kept)


@compiled_exactly
def nearest_others(nodes: np.ndarray, label: np.ndarray, own: np.ndarray, limit: float,
                   count: int, tree: Boxes) -> tuple[np.ndarray, np.ndarray]:
    """Find up to ``count`` nodes of other pieces within ``limit`` [m] of each node in ``own``,
    nearest first: nodes, -1 where there are fewer, and distances [m], shape [own, count] each."""
    near = np.full((len(own), count), -1)
    distance = np.full((len(own), count), limit)
    waiting = np.empty(2 * len(tree[1]), np.int64)
    for k in range(len(own)):
        node, last, waiting[0] = own[k], 0, 0
        while last >= 0:
            box = waiting[last]
            last -= 1
            if tree[4][box] == label[node] or nearest_in_box(
                    nodes[node], tree[2][box], tree[3][box]) >= distance[k, count - 1]:
                continue
            if 2 * box + 2 < len(tree[1]):
                near_first = 1 if nearest_in_box(nodes[node], tree[2][2 * box + 1], tree[3][
                    2 * box + 1]) <= nearest_in_box(nodes[node], tree[2][2 * box + 2], tree[3][
                        2 * box + 2]) else 2
                waiting[last + 1], waiting[last + 2] = (2 * box + 3 - near_first,
                                                        2 * box + near_first)
                last += 2
                continue
            for place in range(tree[1][box, 0], tree[1][box, 1]):
                other = tree[0][place]
                if label[other] == label[node]:
                    continue
                x, y, z = (nodes[other, 0] - nodes[node, 0], nodes[other, 1] - nodes[node, 1],
                           nodes[other, 2] - nodes[node, 2])
                far, worse = math.sqrt(x * x + y * y + z * z), count - 1
                if far >= distance[k, worse]:
                    continue
                while worse > 0 and distance[k, worse - 1] > far:
                    distance[k, worse] = distance[k, worse - 1]
                    near[k, worse] = near[k, worse - 1]
                    worse -= 1
                distance[k, worse], near[k, worse] = far, other
    return near, distance


@compiled_exactly
def far_sides(nodes: np.ndarray, spread: np.ndarray, label: np.ndarray, own: np.ndarray,
              ) -> np.ndarray:
    """Largest distance [m] of the points of a node's piece from it, for each node in ``own``.
    ``spread`` [n] [m] is that of each node's own points."""
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
