"""Bridges over gaps of a scan, as hypotheses: which ends of its pieces belong together.

The shortest way over a gap is often wrong: where a fork is missing, it leads from the stem along a
twig and back. An end of a piece goes on in its own direction, meets another end that comes towards
it and is about as thick, or the side of a thicker piece at the angle that twigs stand at. How far
that is from what was found prices a hypothesis; the cheapest ones for their thickness are taken
first, so that stems come before twigs, and what they fill in can carry the next.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

_CHAIN = 6.0  # radii of an end that tell its direction
_CHAIN_NODES = 4  # and so many nodes at least
_UNSURE = 2  # nodes of a piece that tell none
_BEYOND, _LONG = 3, 0.9  # nodes past a fork that tell how its axis comes; of a length as long
_TURN = np.deg2rad(35.0)  # a turn that doubles the price
_SIDE = 0.25  # what a fork costs against going on
_STAND = np.deg2rad(45.0), np.deg2rad(60.0)  # angle that twigs stand at, and what doubles the price
_RATIO = 0.7  # price of a radius e times another
_BLIND = 5.0  # price of a bridge that no direction speaks for
_BLIND_NEAR = 3  # nodes of other pieces that each node is tried with
_FARTHER = 2.0  # an end may reach that times the limit, if it points at what it reaches
_POINTS_AT = np.deg2rad(25.0)
_STRAIGHT = np.deg2rad(45.0)  # ends that turn more tell no direction to a bridge


@dataclass(frozen=True)
class Ends:
    """Free ends of pieces.

    Attributes:
        node: Which node each is, shape [k].
        direction: Outwards, a unit vector; zero where there is none, shape [k, 3].
        radius: Typical thickness near it [m], shape [k].
    """

    node: np.ndarray
    direction: np.ndarray
    radius: np.ndarray


@dataclass(frozen=True)
class Hypotheses:
    """Possible bridges, cheapest for their thickness first.

    Attributes:
        one: Node at the end that reaches out, shape [h].
        other: Node that it reaches, shape [h].
        length: [m], shape [h].
        price: Length times how odd the bridge is [m], shape [h].
        turn: Angle between the end's direction and the bridge [rad], pi where it has none,
            shape [h].
        meets: 1 where the other node is an end that comes towards this one, else 0, shape [h].
        thick: How thick the end that reaches out is [m]; of a blind one the thinner, shape [h].
    """

    one: np.ndarray
    other: np.ndarray
    length: np.ndarray
    price: np.ndarray
    turn: np.ndarray
    meets: np.ndarray
    thick: np.ndarray


def free_ends(nodes: np.ndarray, edges: np.ndarray, thickness: np.ndarray,
              joints: np.ndarray | None = None) -> Ends:
    """Find the ends of all pieces and where they point.

    Args:
        nodes: Positions [m], shape [n, 3].
        edges: Node pairs of a forest, shape [e, 2].
        thickness: First radii [m], shape [n].
        joints: Those of the edges by which a bridge joined a side, the bridge's node first, shape
            [j, 2]: a twig that came to a stem's end does not close that.
    """
    near: list[list[int]] = [[] for _ in nodes]
    for a, b in edges.tolist():
        near[a].append(b)
        near[b].append(a)
    reaching = set()
    for bridge, side in ([] if joints is None else joints.tolist()):
        near[bridge].remove(side)
        near[side].remove(bridge)
        reaching.add(bridge)
    ends = [node for node, others in enumerate(near) if len(others) <= 1 and node not in reaching]
    direction, radius = np.zeros((len(ends), 3)), np.empty(len(ends))
    for place, end in enumerate(ends):
        # Points are missing beside an end too, where it looks thinner than it is.
        chain = _straight_chain(nodes, near, end, _CHAIN * thickness[end])
        chain = _straight_chain(nodes, near, end, _CHAIN * float(thickness[chain].max()))
        # What hangs beside a longer axis has neither its thickness nor its direction.
        chain = chain[:_beside(nodes, near, thickness, chain)]
        radius[place] = float(np.median(thickness[chain]))
        if len(chain) > _UNSURE:
            direction[place] = _direction(nodes[chain])
    return Ends(np.array(ends, np.int64), direction, radius)


def hypotheses(nodes: np.ndarray, edges: np.ndarray, thickness: np.ndarray, label: np.ndarray,
               weight: np.ndarray, limit: float, ends: Ends) -> Hypotheses:
    """Price the ways in which pieces can be joined.

    Args:
        nodes: Positions [m], shape [n, 3].
        edges: Node pairs of a forest, shape [e, 2].
        thickness: First radii [m], shape [n].
        label: Which piece each node belongs to, shape [n].
        weight: Points of each piece, shape [pieces].
        limit: No bridge is longer [m], unless an end points straight at what it reaches.
        ends: The pieces' free ends.
    """
    end_of = np.full(len(nodes), -1)
    end_of[ends.node] = np.arange(len(ends.node))
    axis = _axes(nodes, edges)
    single = np.bincount(label)[label] <= _UNSURE
    largest = int(np.argmax(weight))
    rest = np.flatnonzero(label != largest)
    trees = {True: (cKDTree(nodes[rest]), rest), False: (cKDTree(nodes), np.arange(len(nodes)))}
    parts = []
    for place, end in enumerate(ends.node):
        direction = ends.direction[place]
        if not direction.any():
            continue
        tree, index = trees[bool(label[end] == largest)]
        others = index[tree.query_ball_point(nodes[end], _FARTHER * limit)]
        others = others[label[others] != label[end]]
        if len(others):
            parts.append(_priced(
                nodes, thickness, axis, single, ends, end_of, place, others, limit))
    parts.append(_blind(nodes, label, largest, limit))
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

    A cubic from end to end in their directions; where only one end has a direction, it leaves in
    that and arrives as it comes.
    """
    start, stop = nodes[one], nodes[other]
    way = stop - start
    length = float(np.linalg.norm(way))
    count = int(length / max(step, 1e-12)) - 1
    if count < 1:
        return np.empty((0, 3)), np.empty(0)
    leave = _lead(ends, one, way)
    arrive = _lead(ends, other, -way)
    leave = None if leave is None else leave * length
    arrive = None if arrive is None else -arrive * length
    if leave is None and arrive is None:
        leave = arrive = way
    elif leave is None:
        leave = (3 * way - arrive) / 2
    elif arrive is None:
        arrive = (3 * way - leave) / 2
    t = (np.arange(count) + 1)[:, None] / (count + 1)
    curve = ((2 * t**3 - 3 * t**2 + 1) * start + (t**3 - 2 * t**2 + t) * leave
             + (3 * t**2 - 2 * t**3) * stop + (t**3 - t**2) * arrive)
    thick = thickness[one] + t[:, 0] * (min(thickness[other], thickness[one]) - thickness[one])
    return curve, thick


def _straight_chain(nodes: np.ndarray, near: list[list[int]], end: int, reach: float,
                    before: int = -1) -> list[int]:
    """Nodes inwards from an end, straight on at forks, as far as ``reach`` [m].

    With ``before`` the chain starts at a node within a piece and goes away from that neighbour.
    """
    chain, length = [end], 0.0
    while length < reach or len(chain) < _CHAIN_NODES:
        ahead = [node for node in near[chain[-1]] if node != before]
        if not ahead:
            break
        if len(ahead) > 1 and len(chain) > 1:
            line = nodes[chain[-1]] - nodes[chain[0]]
            way = nodes[ahead] - nodes[chain[-1]]
            cosine = way @ line / np.maximum(np.linalg.norm(way, axis=1), 1e-300)
            ahead = [ahead[int(np.argmax(cosine))]]
        before = chain[-1]
        length += float(np.linalg.norm(nodes[ahead[0]] - nodes[before]))
        chain.append(ahead[0])
    return chain


def _beside(nodes: np.ndarray, near: list[list[int]], thickness: np.ndarray, chain: list[int],
            ) -> int:
    """How many of an end's nodes belong to a stub beside a longer axis; all if it is none.

    At a fork that the chain passes, that axis goes on along another arm, which is longer than the
    stub and turns less.
    """
    length = 0.0
    for place in range(1, len(chain) - 1):
        fork, ahead = chain[place], chain[place + 1]
        stub = nodes[chain[0]] - nodes[fork]
        length += float(np.linalg.norm(nodes[fork] - nodes[chain[place - 1]]))
        inwards = nodes[chain[min(place + _BEYOND, len(chain) - 1)]] - nodes[fork]
        for other in near[fork]:
            if other in (chain[place - 1], ahead):
                continue
            reach = max(length, _CHAIN * float(thickness[fork]))
            arm = _straight_chain(nodes, near, other, reach, before=fork)
            goes_on = nodes[arm[-1]] - nodes[fork]
            if float(np.linalg.norm(goes_on)) > _LONG * reach and (
                    _cosine(inwards, goes_on) < _cosine(inwards, stub)):
                return place
    return len(chain)


def _cosine(one: np.ndarray, other: np.ndarray) -> float:
    return float(one @ other) / max(float(np.linalg.norm(one) * np.linalg.norm(other)), 1e-300)


def _direction(chain: np.ndarray) -> np.ndarray:
    """Unit vector of a chain's own line, towards its first node, shape [3]."""
    line = np.linalg.svd(chain - chain.mean(axis=0), full_matrices=False)[2][0]
    out = chain[0] - chain[-1]
    line = line if line @ out >= 0 else -line
    return line if out.any() else np.zeros(3)


def _axes(nodes: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Direction of the axis at each node, without sign; zero at single nodes, shape [n, 3]."""
    sums = np.zeros((len(nodes), 3, 3))
    way = nodes[edges[:, 1]] - nodes[edges[:, 0]]
    square = way[:, :, None] * way[:, None, :]
    np.add.at(sums, edges[:, 0], square)
    np.add.at(sums, edges[:, 1], square)
    return np.linalg.eigh(sums)[1][:, :, 2] * (np.trace(sums, axis1=1, axis2=2) > 0)[:, None]


def _turned(direction: np.ndarray, way: np.ndarray, radius: float) -> np.ndarray:
    """Angle [rad] from a direction to each way [k, 3]; aside by up to a radius is no turn."""
    along = way @ direction
    aside = np.linalg.norm(way - along[:, None] * direction, axis=1)
    return np.arctan2(np.maximum(aside - radius, 0.0), along)


def _priced(nodes: np.ndarray, thickness: np.ndarray, axis: np.ndarray, single: np.ndarray,
            ends: Ends, end_of: np.ndarray, place: int, others: np.ndarray, limit: float,
            ) -> tuple[np.ndarray, ...]:
    """What it costs to join one end to each of ``others``: columns of :class:`Hypotheses`."""
    own, direction, radius = ends.node[place], ends.direction[place], ends.radius[place]
    way = nodes[others] - nodes[own]
    length = np.maximum(np.linalg.norm(way, axis=1), 1e-12)
    turn = _turned(direction, way, radius)
    stand = np.arccos(np.clip(np.abs(np.einsum("kj,kj->k", way, axis[others])) / length, 0, 1))
    stand = np.where(axis[others].any(axis=1), stand, _STAND[0])
    # Of a single patch of skin the contraction tells no thickness.
    thicker = np.where(single[others], 0.0, np.log(radius / np.maximum(thickness[others], 1e-12)))
    side = _SIDE + ((stand - _STAND[0]) / _STAND[1])**2 + _RATIO * np.maximum(thicker, 0)
    other_end = end_of[others]
    comes = np.full(len(others), np.inf)
    for k in np.flatnonzero(other_end >= 0):
        end = other_end[k]
        if ends.direction[end].any():
            angle = _turned(ends.direction[end], -way[k:k + 1], ends.radius[end])[0]
            comes[k] = (angle / _TURN)**2 + _RATIO * abs(np.log(radius / ends.radius[end]))
    price = length * (1 + (turn / _TURN)**2 + np.minimum(side, comes))
    able = length <= np.where(turn < _POINTS_AT, _FARTHER, 1.0) * limit
    return (np.full(able.sum(), own), others[able], length[able], price[able], turn[able],
            (comes < side)[able].astype(np.int8))


def _blind(nodes: np.ndarray, label: np.ndarray, largest: int, limit: float,
           ) -> tuple[np.ndarray, ...]:
    """The shortest ways from each piece to others, whatever the directions."""
    one, other, length = [], [], []
    for piece in np.setdiff1d(np.unique(label), largest):
        own, others = np.flatnonzero(label == piece), np.flatnonzero(label != piece)
        distance, near = cKDTree(nodes[others]).query(
            nodes[own], k=min(_BLIND_NEAR, len(others)), distance_upper_bound=limit)
        distance, near = distance.reshape(len(own), -1), near.reshape(len(own), -1)
        place, which = np.nonzero(distance < np.inf)
        one.append(own[place])
        other.append(others[near[place, which]])
        length.append(distance[place, which])
    if not one:
        return (np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0), np.empty(0),
                np.empty(0), np.empty(0, np.int8))
    length = np.concatenate(length)
    return (np.concatenate(one), np.concatenate(other), length, (1 + _BLIND) * length,
            np.full(len(length), np.pi), np.zeros(len(length), np.int8))


def _lead(ends: Ends, node: int, way: np.ndarray) -> np.ndarray | None:
    """Direction that an end gives to a bridge along ``way``; None if it is none or turns much."""
    place = np.flatnonzero(ends.node == node)
    if len(place) == 0 or not ends.direction[place[0]].any():
        return None
    direction = ends.direction[place[0]]
    cosine = direction @ way / max(float(np.linalg.norm(way)), 1e-300)
    return direction if cosine > np.cos(_STRAIGHT) else None
