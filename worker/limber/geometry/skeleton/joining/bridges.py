"""Bridges over gaps of a scan, as hypotheses: which ends of its pieces belong together.

The shortest path over a gap is often wrong: where a fork is missing, it runs from the stem along a
twig and back. An end of a piece continues in its own direction. It meets another end that points
towards it and is about as thick, or the side of a thicker piece at the usual angle of twigs. The
deviation from that sets the price of a hypothesis. The cheapest ones for their thickness are taken
first, so stems come before twigs, and the nodes added along them can carry later ones.
"""

from dataclasses import dataclass

import numpy as np

from limber.geometry.skeleton.joining.boxes import Boxes, boxes
from limber.geometry.skeleton.joining.bridge_kernels import nearest_others, priced
from limber.geometry.skeleton.joining.free_ends import UNSURE, Ends, Known

_BLIND = 5.0  # price factor of a bridge without a direction
_BLIND_NEAR = 3  # nodes of other pieces tried for each node
_STRAIGHT = np.deg2rad(45.0)  # ends that turn more give a bridge no direction


@dataclass(frozen=True)
class Hypotheses:
    """Possible bridges, cheapest for their thickness first.

    Attributes:
        one: Node at the end that reaches out, shape [h].
        other: Node that it reaches, shape [h].
        length: [m], shape [h].
        price: Length times the implausibility of the bridge [m], shape [h].
        turn: Angle between the end's direction and the bridge [rad], pi where it has none,
            shape [h].
        meets: 1 where the other node is an end that comes towards this one, else 0, shape [h].
        thick: Thickness of the end that reaches out [m]; for a blind one, of the thinner, shape
        [h].
    """

    one: np.ndarray
    other: np.ndarray
    length: np.ndarray
    price: np.ndarray
    turn: np.ndarray
    meets: np.ndarray
    thick: np.ndarray


def hypotheses(nodes: np.ndarray, edges: np.ndarray, thickness: np.ndarray, label: np.ndarray,
               weight: np.ndarray, limit: float, ends: Ends, known: Known | None = None,
               ) -> Hypotheses:
    """Price the paths by which pieces can be joined.

    Args:
        nodes: Positions [m], shape [n, 3].
        edges: Node pairs of a forest, shape [e, 2].
        thickness: First radii [m], shape [n].
        label: Which piece each node belongs to, shape [n].
        weight: Points of each piece, shape [pieces].
        limit: Longest bridge [m], unless an end points straight at its target.
        ends: The pieces' free ends.
        known: Results of earlier calls; those of this call are added.
    """
    axes = _axes(nodes, edges, known or Known())
    end_of = np.full(len(nodes), -1)
    end_of[ends.node] = np.arange(len(ends.node))
    nodes, label = np.ascontiguousarray(nodes, float), label.astype(np.int64)
    single = np.bincount(label)[label] <= UNSURE
    tree = boxes(nodes, label)
    parts = [priced(nodes, thickness, axes, single, label, ends.node, ends.direction, ends.radius,
                    end_of, float(limit), tree),
             _blind(nodes, label, int(np.argmax(weight)), limit, tree)]
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    thick = thickness.copy()
    thick[ends.node] = ends.radius
    thick = np.where(columns[4] == np.pi, np.minimum(thick[columns[0]], thick[columns[1]]),
                     thick[columns[0]])
    thick = np.maximum(thick, 1e-12)
    order = np.argsort(columns[3] / thick, kind="stable")
    return Hypotheses(*(column[order] for column in (*columns, thick)))


def filled(nodes: np.ndarray, thickness: np.ndarray, ends: Ends, one: int, other: int,
           step: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes [m], shape [k, 3], and radii [m] along a bridge, about ``step`` [m] apart.

    A cubic from end to end in their directions. If only one end has a direction, the curve leaves
    in that direction, and its arrival is free.
    """
    start, stop = nodes[one], nodes[other]
    vector = stop - start
    length = float(np.linalg.norm(vector))
    count = int(length / max(step, 1e-12)) - 1
    if count < 1:
        return np.empty((0, 3)), np.empty(0)
    leave = _lead(ends, one, vector)
    arrive = _lead(ends, other, -vector)
    leave = None if leave is None else leave * length
    arrive = None if arrive is None else -arrive * length
    if leave is None and arrive is None:
        leave = arrive = vector
    elif leave is None:
        leave = (3 * vector - arrive) / 2
    elif arrive is None:
        arrive = (3 * vector - leave) / 2
    t = (np.arange(count) + 1)[:, None] / (count + 1)
    curve = ((2 * t**3 - 3 * t**2 + 1) * start + (t**3 - 2 * t**2 + t) * leave
             + (3 * t**2 - 2 * t**3) * stop + (t**3 - t**2) * arrive)
    thick = thickness[one] + t[:, 0] * (min(thickness[other], thickness[one]) - thickness[one])
    return curve, thick


def _axes(nodes: np.ndarray, edges: np.ndarray, known: Known) -> np.ndarray:
    """Direction of the axis at each node, without sign; zero at single nodes, shape [n, 3]."""
    sums = np.zeros((len(nodes), 3, 3))
    vector = nodes[edges[:, 1]] - nodes[edges[:, 0]]
    square = vector[:, :, None] * vector[:, None, :]
    np.add.at(sums, edges[:, 0], square)
    np.add.at(sums, edges[:, 1], square)
    axes = np.zeros((len(nodes), 3))
    axes[:len(known.axes)] = known.axes
    fresh = np.trace(sums, axis1=1, axis2=2) > 0
    fresh[:len(known.sums)] &= (sums[:len(known.sums)] != known.sums).any(axis=(1, 2))
    axes[fresh] = np.linalg.eigh(sums[fresh])[1][:, :, 2]
    known.sums, known.axes = sums, axes
    return axes


def _blind(nodes: np.ndarray, label: np.ndarray, largest: int, limit: float, tree: Boxes,
           ) -> tuple[np.ndarray, ...]:
    """The shortest paths from each piece to others, regardless of direction."""
    own = np.argsort(label, kind="stable")
    own = own[label[own] != largest]
    near, distance = nearest_others(nodes, label, own, float(limit), _BLIND_NEAR, tree)
    row, which = np.nonzero(near >= 0)
    length = distance[row, which]
    return (own[row], near[row, which], length, (1 + _BLIND) * length,
            np.full(len(length), np.pi), np.zeros(len(length), np.int64))


def _lead(ends: Ends, node: int, vector: np.ndarray) -> np.ndarray | None:
    """Direction of an end for a bridge along ``vector``; None if there is none or it turns much."""
    rows = np.flatnonzero(ends.node == node)
    if len(rows) == 0 or not ends.direction[rows[0]].any():
        return None
    direction = ends.direction[rows[0]]
    cosine = direction @ vector / max(float(np.linalg.norm(vector)), 1e-300)
    return direction if cosine > np.cos(_STRAIGHT) else None
