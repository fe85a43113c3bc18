"""Loops of the search for bridges: what each end costs to join to each node of other pieces."""

import math

import numpy as np
from numba import njit

_TURN = math.radians(35.0)  # a turn that doubles the price
_SIDE = 0.25  # what a fork costs against going on
# Angle that twigs stand at, and what doubles the price.
_STAND, _STAND_DOUBLES = math.radians(45.0), math.radians(60.0)
_RATIO = 0.7  # price of a radius e times another
_FARTHER = 2.0  # an end may reach that times the limit, if it points at what it reaches
_POINTS_AT = math.radians(25.0)
_LEAST = 1e-12


@njit(cache=True)
def _turned(direction: np.ndarray, way: np.ndarray, radius: float) -> float:
    """Angle [rad] from a direction to a way; aside by up to a radius is no turn."""
    along = way[0] * direction[0] + way[1] * direction[1] + way[2] * direction[2]
    x, y, z = (way[0] - along * direction[0], way[1] - along * direction[1],
               way[2] - along * direction[2])
    return math.atan2(max(math.sqrt(x * x + y * y + z * z) - radius, 0.0), along)


@njit(cache=True)
def priced(nodes: np.ndarray, thickness: np.ndarray, axis: np.ndarray, single: np.ndarray,
           label: np.ndarray, end_node: np.ndarray, end_direction: np.ndarray,
           end_radius: np.ndarray, end_of: np.ndarray, limit: float,
           ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Price the ways from all ends that have a direction to the nodes of other pieces.

    Args:
        nodes: Positions [m], shape [n, 3].
        thickness: First radii [m], shape [n].
        axis: Direction of the axis at each node, zero where there is none, shape [n, 3].
        single: Whether a node's piece tells neither direction nor thickness, shape [n].
        label: Which piece each node belongs to, shape [n].
        end_node: Nodes of the ends, shape [k].
        end_direction: Outwards, zero where there is none, shape [k, 3].
        end_radius: Typical thickness [m], shape [k].
        end_of: Which end a node is, -1 if none, shape [n].
        limit: Longest way [m], unless an end points straight at what it reaches.

    Returns:
        Columns of :class:`.bridges.Hypotheses`, without the last.
    """
    one, other = [0 for _ in range(0)], [0 for _ in range(0)]
    length, price, turn = ([0.0 for _ in range(0)], [0.0 for _ in range(0)],
                           [0.0 for _ in range(0)])
    meets = [0 for _ in range(0)]
    way = np.empty(3)
    for k in range(len(end_node)):
        own, out, radius = end_node[k], end_direction[k], end_radius[k]
        if out[0] == 0 and out[1] == 0 and out[2] == 0:
            continue
        for node in range(len(nodes)):
            if label[node] == label[own]:
                continue
            square = 0.0
            for j in range(3):
                way[j] = nodes[node, j] - nodes[own, j]
                square += way[j] * way[j]
            far = max(math.sqrt(square), _LEAST)
            if far > _FARTHER * limit:
                continue
            turned = _turned(out, way, radius)
            if far > (_FARTHER if turned < _POINTS_AT else 1.0) * limit:
                continue
            stand = _STAND
            if axis[node, 0] != 0 or axis[node, 1] != 0 or axis[node, 2] != 0:
                along = abs(way[0] * axis[node, 0] + way[1] * axis[node, 1]
                            + way[2] * axis[node, 2])
                stand = math.acos(min(along / far, 1.0))
            # Of a single patch of skin the contraction tells no thickness.
            thicker = 0.0 if single[node] else math.log(radius / max(thickness[node], _LEAST))
            side = (_SIDE + ((stand - _STAND) / _STAND_DOUBLES)**2
                    + _RATIO * max(thicker, 0.0))
            comes, end = np.inf, end_of[node]
            if end >= 0 and (end_direction[end, 0] != 0 or end_direction[end, 1] != 0
                             or end_direction[end, 2] != 0):
                angle = _turned(end_direction[end], -way, end_radius[end])
                comes = ((angle / _TURN)**2
                         + _RATIO * abs(math.log(radius / end_radius[end])))
            one.append(own)
            other.append(node)
            length.append(far)
            price.append(far * (1 + (turned / _TURN)**2 + min(side, comes)))
            turn.append(turned)
            meets.append(1 if comes < side else 0)
    return (np.array(one), np.array(other), np.array(length), np.array(price), np.array(turn),
            np.array(meets))


@njit(cache=True)
def nearest_others(nodes: np.ndarray, label: np.ndarray, own: np.ndarray, limit: float,
                   count: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the nodes of other pieces nearest to each of some nodes, nearest first.

    Args:
        nodes: Positions [m], shape [n, 3].
        label: Which piece each node belongs to, shape [n].
        own: The nodes that ask, shape [m].
        limit: Only nodes nearer than that [m].
        count: How many at most.

    Returns:
        Nodes, -1 where there are fewer, and distances [m], both of shape [m, count].
    """
    near = np.full((len(own), count), -1)
    distance = np.full((len(own), count), limit)
    for place in range(len(own)):
        node = own[place]
        farthest = limit * limit
        for other in range(len(nodes)):
            x, y, z = (nodes[other, 0] - nodes[node, 0], nodes[other, 1] - nodes[node, 1],
                       nodes[other, 2] - nodes[node, 2])
            square = x * x + y * y + z * z
            if square >= farthest or label[other] == label[node]:
                continue
            far, at = math.sqrt(square), count - 1
            if far >= distance[place, at]:
                continue
            while at > 0 and distance[place, at - 1] > far:
                distance[place, at], near[place, at] = distance[place, at - 1], near[place, at - 1]
                at -= 1
            distance[place, at], near[place, at] = far, other
            farthest = distance[place, count - 1]**2
    return near, distance
