"""Bridges over gaps of a scan, as hypotheses: which ends of its pieces belong together.

The shortest way over a gap is often wrong: where a fork is missing, it leads from the stem along a
twig and back. An end of a piece goes on in its own direction, meets another end that comes towards
it and is about as thick, or the side of a thicker piece at the angle that twigs stand at. How far
that is from what was found prices a hypothesis; the cheapest ones for their thickness are taken
first, so that stems come before twigs, and what they fill in can carry the next.
"""

from dataclasses import dataclass, field

import numpy as np

from limber.geometry.skeleton.contraction.bridge_kernels import nearest_others, priced

_CHAIN = 6.0  # radii of an end that tell its direction
_CHAIN_NODES = 4  # and so many nodes at least
_UNSURE = 2  # nodes of a piece that tell none
_BEYOND, _LONG = 3, 0.9  # nodes past a fork that tell how its axis comes; of a length as long
_BLIND = 5.0  # price of a bridge that no direction speaks for
_BLIND_NEAR = 3  # nodes of other pieces that each node is tried with
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
              joints: np.ndarray | None = None, known: "Known | None" = None,
              ) -> Ends:
    """Find the ends of all pieces and where they point.

    Args:
        nodes: Positions [m], shape [n, 3].
        edges: Node pairs of a forest, shape [e, 2].
        thickness: First radii [m], shape [n].
        joints: Those of the edges by which a bridge joined a side, the bridge's node first, shape
            [j, 2]: a twig that came to a stem's end does not close that.
        known: What earlier calls found, with fewer edges between the same nodes; what this one
            finds is added.
    """
    found = {} if known is None else known.ends
    near: list[list[int]] = [[] for _ in range(len(nodes))]
    for a, b in edges.tolist():
        near[a].append(b)
        near[b].append(a)
    reaching = set()
    for bridge, side in ([] if joints is None else joints.tolist()):
        near[bridge].remove(side)
        near[side].remove(bridge)
        reaching.add(bridge)
    ends = [node for node, others in enumerate(near) if len(others) <= 1 and node not in reaching]
    for end in ends:
        if end not in found or not found[end].holds(near):
            found[end] = _end(nodes, _Neighbours(near), thickness, end)
    return Ends(np.array(ends, np.int64),
                np.array([found[end].direction for end in ends]).reshape(-1, 3),
                np.array([found[end].radius for end in ends], float))


@dataclass
class Known:
    """What earlier calls found, which holds where nothing has changed since.

    Attributes:
        ends: Of each end.
        sums: Squares of the edges at each node [m^2], shape [n, 3, 3].
        axes: Direction of the axis that these tell, shape [n, 3].
    """

    ends: dict[int, "KnownEnd"] = field(default_factory=dict)
    sums: np.ndarray = field(default_factory=lambda: np.empty((0, 3, 3)))
    axes: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))

    def copy(self) -> "Known":
        """The same, to which other findings are added."""
        return Known(dict(self.ends), self.sums, self.axes)


@dataclass(frozen=True)
class KnownEnd:
    """What was found of an end, and all the neighbours that this depended on."""

    direction: np.ndarray
    radius: float
    asked: dict[int, list[int]]

    def holds(self, near: list[list[int]]) -> bool:
        """Whether those neighbours are the same still."""
        return all(near[node] == others for node, others in self.asked.items())


class _Neighbours:
    """Neighbours of nodes, and a record of which were asked for."""

    def __init__(self, near: list[list[int]]) -> None:
        self._near = near
        self.asked: dict[int, list[int]] = {}

    def __getitem__(self, node: int) -> list[int]:
        self.asked[node] = self._near[node]
        return self._near[node]


def _end(nodes: np.ndarray, near: _Neighbours, thickness: np.ndarray, end: int) -> KnownEnd:
    # Points are missing beside an end too, where it looks thinner than it is.
    chain = _straight_chain(nodes, near, end, _CHAIN * thickness[end])
    chain = _straight_chain(nodes, near, end, _CHAIN * float(thickness[chain].max()))
    # What hangs beside a longer axis has neither its thickness nor its direction.
    chain = chain[:_beside(nodes, near, thickness, chain)]
    direction = _direction(nodes[chain]) if len(chain) > _UNSURE else np.zeros(3)
    return KnownEnd(direction, float(np.median(thickness[chain])), near.asked)


def hypotheses(nodes: np.ndarray, edges: np.ndarray, thickness: np.ndarray, label: np.ndarray,
               weight: np.ndarray, limit: float, ends: Ends, known: Known | None = None,
               ) -> Hypotheses:
    """Price the ways in which pieces can be joined.

    Args:
        nodes: Positions [m], shape [n, 3].
        edges: Node pairs of a forest, shape [e, 2].
        thickness: First radii [m], shape [n].
        label: Which piece each node belongs to, shape [n].
        weight: Points of each piece, shape [pieces].
        limit: No bridge is longer [m], unless an end points straight at what it reaches.
        ends: The pieces' free ends.
        known: What earlier calls found; what this one finds is added.
    """
    axes = _axes(nodes, edges, known or Known())
    end_of = np.full(len(nodes), -1)
    end_of[ends.node] = np.arange(len(ends.node))
    nodes, label = np.ascontiguousarray(nodes, float), label.astype(np.int64)
    single = np.bincount(label)[label] <= _UNSURE
    parts = [priced(nodes, thickness, axes, single, label, ends.node, ends.direction, ends.radius,
                    end_of, float(limit)),
             _blind(nodes, label, int(np.argmax(weight)), limit)]
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


def _straight_chain(nodes: np.ndarray, near: _Neighbours, end: int, reach: float,
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


def _beside(nodes: np.ndarray, near: _Neighbours, thickness: np.ndarray, chain: list[int],
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


def _axes(nodes: np.ndarray, edges: np.ndarray, known: Known) -> np.ndarray:
    """Direction of the axis at each node, without sign; zero at single nodes, shape [n, 3]."""
    sums = np.zeros((len(nodes), 3, 3))
    way = nodes[edges[:, 1]] - nodes[edges[:, 0]]
    square = way[:, :, None] * way[:, None, :]
    np.add.at(sums, edges[:, 0], square)
    np.add.at(sums, edges[:, 1], square)
    axes = np.zeros((len(nodes), 3))
    axes[:len(known.axes)] = known.axes
    fresh = np.trace(sums, axis1=1, axis2=2) > 0
    fresh[:len(known.sums)] &= (sums[:len(known.sums)] != known.sums).any(axis=(1, 2))
    axes[fresh] = np.linalg.eigh(sums[fresh])[1][:, :, 2]
    known.sums, known.axes = sums, axes
    return axes


def _blind(nodes: np.ndarray, label: np.ndarray, largest: int, limit: float,
           ) -> tuple[np.ndarray, ...]:
    """The shortest ways from each piece to others, whatever the directions."""
    own = np.argsort(label, kind="stable")
    own = own[label[own] != largest]
    near, distance = nearest_others(nodes, label, own, float(limit), _BLIND_NEAR)
    place, which = np.nonzero(near >= 0)
    length = distance[place, which]
    return (own[place], near[place, which], length, (1 + _BLIND) * length,
            np.full(len(length), np.pi), np.zeros(len(length), np.int64))


def _lead(ends: Ends, node: int, way: np.ndarray) -> np.ndarray | None:
    """Direction that an end gives to a bridge along ``way``; None if it is none or turns much."""
    place = np.flatnonzero(ends.node == node)
    if len(place) == 0 or not ends.direction[place[0]].any():
        return None
    direction = ends.direction[place[0]]
    cosine = direction @ way / max(float(np.linalg.norm(way)), 1e-300)
    return direction if cosine > np.cos(_STRAIGHT) else None
