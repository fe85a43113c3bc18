"""Joining of a scan's pieces to one tree over its gaps: the likeliest bridges are made."""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from limber.geometry.skeleton.bridge_kernels import Boxes, boxes, far_sides, nearest_others, priced
from limber.geometry.skeleton.free_ends import UNSURE, Ends, Known, free_ends
from limber.geometry.skeleton.skeleton import Skeleton

# Bridges over gaps of a scan, as hypotheses: which ends of its pieces belong together.
#
# The shortest path over a gap is often wrong: where a fork is missing, it runs from the stem along
# a twig and back. An end of a piece continues in its own direction. It meets another end that
# points towards it and is about as thick, or the side of a thicker piece at the usual angle of
# twigs. The deviation from that sets the price of a hypothesis. The cheapest ones for their
# thickness are taken first, so stems come before twigs, and the nodes added along them can carry
# later ones.

_BLIND = 5.0  # price factor of a bridge without a direction
_BLIND_NEAR = 3  # nodes of other pieces tried for each node
_STRAIGHT = np.deg2rad(45.0)  # ends that turn more give a bridge no direction


@dataclass(frozen=True)
class Hypotheses:
    """Possible bridges [h], cheapest for their thickness first. ``meets`` is 1 where the other node
    is an end that comes towards this one. ``price`` is length times implausibility [m], ``turn``
    the angle to the end's direction [rad] (pi: none), ``thick`` the end's or the thinner's [m]."""

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
    """Price the paths by which pieces of the forest can be joined. ``weight`` has the points of
    each piece. Only an end that points straight at its target bridges more than ``limit`` [m].
    Results are added to ``known``."""
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
    """Nodes [k, 3] and radii [m] along a bridge, about ``step`` [m] apart, on a cubic in the
    directions of both ends. If only one has a direction, the arrival is free."""
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


# Pieces of a scan and their state during joining.


# Length in thicknesses below which a piece has no direction; that for few points; fewer points are
# few.
_SPECK, _SPECK_FEW, _FEW = 5.0, 10.0, 30


@dataclass
class Joined:
    """All nodes [n, 3] [m], those along bridges after the given ones, and all edges [e, 2].

    Attributes:
        thickness: First radii [m], shape [n].
        support: Number of points of each node, none along bridges, shape [n].
        spread: Largest distance of each node's points from it [m], 0 along bridges, shape [n].
        bridges: Node pairs that were joined, shape [b, 2].
        prices: Cost of each bridge over its length, shape [b]: 1 where an end continues straight
            into another of equal thickness, higher for less plausible bridges.
        plants: Node pairs between pieces that are plants of their own, shape [p, 2].
        joints: Edges by which bridges joined the side of a piece, the bridge's node first, [j, 2].
        piece: The given piece of each node, -1 along bridges, shape [n]; ``label``: the one now.
        rivals: For each bridge the other place for the piece that it attaches, if there is one.
    """

    nodes: np.ndarray
    thickness: np.ndarray
    support: np.ndarray
    spread: np.ndarray
    edges: np.ndarray
    bridges: np.ndarray
    prices: np.ndarray
    plants: np.ndarray
    label: np.ndarray
    joints: np.ndarray
    piece: np.ndarray
    known: Known = field(default_factory=Known)
    rounds: list["Round"] = field(default_factory=list)
    rivals: list[Any] = field(default_factory=list)

    def copy(self, rounds: list["Round"]) -> "Joined":
        """A copy of the state that changes independently, after these ``rounds``."""
        return replace(self, known=self.known.copy(), rounds=list(rounds))

    def ends(self) -> Ends:
        """The free ends of the pieces."""
        return free_ends(self.nodes, self.edges, self.thickness, self.joints, self.known)

    def bridge(self, ends: Ends, found: Hypotheses, index: int, step: float) -> None:
        """Add a bridge, with nodes along it that others may be joined to."""
        one, other = int(found.one[index]), int(found.other[index])
        curve, thick = filled(self.nodes, self.thickness, ends, one, other, step)
        chain = np.concatenate([[one], len(self.nodes) + np.arange(len(curve)), [other]])
        self.edges = np.vstack([self.edges, np.stack([chain[:-1], chain[1:]], axis=1)])
        if not found.meets[index]:
            own, met = (_pointing(ends, node) for node in (one, other))
            if met > 0:
                # Of two ends side by side, the thicker one continues.
                joint = chain[[1, 0]] if own > met else chain[[-2, -1]]
                self.joints = np.vstack([self.joints, joint])
        self.nodes = np.vstack([self.nodes, curve])
        self.thickness = np.concatenate([self.thickness, thick])
        self.support = np.concatenate([self.support, np.zeros(len(curve), self.support.dtype)])
        self.spread = np.concatenate([self.spread, np.zeros(len(curve))])
        self.bridges = np.vstack([self.bridges, [one, other]])
        self.piece = np.concatenate([self.piece, np.full(len(curve), -1)])
        self.prices = np.append(self.prices, found.price[index] / found.length[index])

    def lengths(self) -> np.ndarray:
        """Length of each bridge [m], shape [b]."""
        return np.linalg.norm(self.nodes[self.bridges[:, 0]] - self.nodes[self.bridges[:, 1]],
                              axis=1)

    def cost(self) -> float:
        """Cost of all bridges [m]."""
        return float(self.prices @ self.lengths())


@dataclass(frozen=True)
class Round:
    """A round of bridges: it is the same without the hypotheses of any pair of pieces that is not
    ``decisive``. While ``alone``, pieces without a direction wait. ``found`` has refused pairs too.
    ``work`` counts paths between ends and nodes, and what each node costs besides."""

    before: Joined
    alone: bool
    decisive: set[tuple[int, int]]
    found: Hypotheses
    work: int


@dataclass(frozen=True)
class Rules:
    """Limits on bridges, as in :func:`join_pieces`."""

    gap: float
    bridge_limit: float
    up: np.ndarray
    join_plants: bool


def _pointing(ends: Ends, node: int) -> float:
    """Radius [m] of a node that is an end with a direction of its own, else 0."""
    own = (ends.node == node) & ends.direction.any(axis=1)
    return float(ends.radius[own].sum())


def labels(count: int, edges: np.ndarray) -> np.ndarray:
    """Which piece each of ``count`` nodes belongs to, by ``edges`` [e, 2], shape [count]."""
    return connected_components(edge_matrix(count, edges), directed=False)[1]


def edge_matrix(count: int, edges: np.ndarray, weight: np.ndarray | None = None,
                ) -> sparse.csr_matrix:
    """Weights of the edges between ``count`` nodes, or ones; each edge once."""
    values = np.ones(len(edges)) if weight is None else weight
    return sparse.coo_matrix((values, (edges[:, 0], edges[:, 1])), (count, count)).tocsr()


def specks(nodes: np.ndarray, edges: np.ndarray, thickness: np.ndarray, support: np.ndarray,
           ) -> np.ndarray:
    """A number [n] for each node: its own, but one per piece too short for a direction. Contraction
    makes random lines of a few points; a piece joined to the middle of one finds no end."""
    label = labels(len(nodes), edges)
    low, high = np.full((label.max() + 1, 3), np.inf), np.full((label.max() + 1, 3), -np.inf)
    np.minimum.at(low, label, nodes)
    np.maximum.at(high, label, nodes)
    thick = np.zeros(label.max() + 1)
    np.maximum.at(thick, label, thickness)
    few = np.bincount(label, support) < _FEW
    short = np.linalg.norm(high - low, axis=1) < np.where(few, _SPECK_FEW, _SPECK) * thick
    return np.where(short[label], len(nodes) + label, np.arange(len(nodes)))


# The rival of each bridge: the cheapest other place at which the same end could be attached.

_ELSEWHERE = 3.0  # thicknesses within which two places are the same fork
_MOST = 20.0  # largest ratio of prices that counts
# Logistic model of a bridge that joins what belongs together: a constant, and a slope for each
# column of `bridge_evidence`; fitted by benchmarks.scan_probabilities to 266 bridges of 70 scans of
# seven sources. With each left out, tenths agree with the outcome within their binomial error.
BRIDGE_ODDS = (7.64, 0.08, -3.39, -1.47)


@dataclass(frozen=True)
class Rival:
    """Another place ``to`` [3] [m] for the end [3] [m] of the smaller piece that a bridge attaches,
    and the cost of a bridge to it [m]."""

    end: np.ndarray
    to: np.ndarray
    price: float


def rivals(state: Joined, rules: Rules) -> list[Rival | None]:
    """The rival of each bridge over a gap, None where there is none. It is sought among all
    hypotheses of the round in which the bridge was made, later refused ones included."""
    found: list[Rival | None] = [None] * len(state.bridges)
    long = state.lengths() > rules.gap
    for number, past in enumerate(state.rounds):
        before = past.before
        after = state.rounds[number + 1].before if number + 1 < len(state.rounds) else state
        made = np.arange(len(before.bridges), len(after.bridges))
        made = made[long[made]]
        if len(made) == 0:
            continue
        weight = np.bincount(before.label, before.support)
        for bridge in made:
            one, other = state.bridges[bridge]
            small_first = weight[before.label[one]] <= weight[before.label[other]]
            found[bridge] = _rival(before, past.found, *(
                (one, other) if small_first else (other, one)))
    return found


def _rival(state: Joined, able: Hypotheses, end: int, onto: int) -> Rival | None:
    nodes, thick, label = state.nodes, state.thickness, state.label
    own = np.where(label[able.one] == label[end], able.one, able.other)
    to = np.where(label[able.one] == label[end], able.other, able.one)
    rows = np.flatnonzero(label[own] == label[end])
    own, to = own[rows], to[rows]
    same_end = np.linalg.norm(nodes[own] - nodes[end], axis=1) <= _ELSEWHERE * thick[end]
    away = np.linalg.norm(nodes[to] - nodes[onto], axis=1)
    # A long bridge does not show its foot to more than its own length.
    elsewhere = away > np.maximum(_ELSEWHERE * np.maximum(thick[onto], thick[to]),
                                  np.linalg.norm(nodes[end] - nodes[onto]))
    rows = rows[same_end & elsewhere]
    if len(rows) == 0:
        return None
    best = rows[np.argmin(able.price[rows])]
    at = able.other[best] if label[able.one[best]] == label[end] else able.one[best]
    return Rival(nodes[end], nodes[at], float(able.price[best]))


def bridge_evidence(price: float, length: float, thickness: float, rival_price: float | None,
                    ) -> np.ndarray:
    """Evidence [3] for a bridge: ln of ``rival_price`` [m] (None: no rival) over its own, ln of
    ``price`` (cost over length), and ln(1 + length / thickness of the thinner end)."""
    ratio = _MOST if rival_price is None else rival_price / max(price * length, 1e-300)
    return np.array([np.log(np.clip(ratio, 1 / _MOST, _MOST)), np.log(max(price, 1e-12)),
                     np.log1p(length / max(thickness, 1e-12))])


def bridge_probability(evidence: np.ndarray) -> float:
    """Probability that a bridge with this evidence joins what belongs together."""
    start, *slopes = BRIDGE_ODDS
    return float(1 / (1 + np.exp(-(start + evidence @ np.array(slopes)))))


# Pieces, or tips of one, that are on the ground as separate plants.

PLANT_SHARE = 0.2
"""Fraction of all points from which a piece may be a separate plant."""
_BASE_SHARE = 0.12  # fraction of a piece's extent within which a bridge starts at its base
_FAR_SHARE = 0.3  # fraction from which it starts far from the base
_THICK = 0.45  # fraction of a piece's largest thickness above which the base may be there
_GROUND = 0.2  # fraction of the scan's height below which a base stands on the ground


def are_plants(nodes: np.ndarray, thickness: np.ndarray, label: np.ndarray,
               bridge: tuple[int, int], up: np.ndarray) -> bool:
    """Whether two pieces are each on the ground, and neither base is on the other's end."""
    height = nodes @ up
    ground = height.min() + _GROUND * np.ptp(height)
    share = []
    for node in bridge:
        own = nodes[label == label[node]]
        base = _base(own, thickness[label == label[node]], up)
        if base @ up > ground:
            return False
        reach = float(np.linalg.norm(own - base, axis=1).max())
        share.append(float(np.linalg.norm(nodes[node] - base)) / max(reach, 1e-300))
    # The base of one on the other's far end: a stem cut near the ground.
    return min(share) > _BASE_SHARE or max(share) < _FAR_SHARE


def plants_apart(nodes: np.ndarray, thickness: np.ndarray, support: np.ndarray,
                 label: np.ndarray, up: np.ndarray) -> list[tuple[int, int]]:
    """Nearest nodes between the largest piece and each large one that was not joined to it."""
    weight = np.bincount(label, support)
    main = np.flatnonzero(label == int(np.argmax(weight)))
    found = []
    large = np.flatnonzero(weight > PLANT_SHARE * support.sum())
    for piece in np.setdiff1d(large, np.argmax(weight)):
        own = np.flatnonzero(label == piece)
        distance, near = cKDTree(nodes[main]).query(nodes[own])
        k = int(np.argmin(distance))
        bridge = (int(own[k]), int(main[near[k]]))
        if are_plants(nodes, thickness, label, bridge, up):
            found.append(bridge)
    return found


def _base(nodes: np.ndarray, thickness: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The lowest position where a piece is thick [m], shape [3]."""
    _, near = cKDTree(nodes).query(nodes, k=min(6, len(nodes)))
    thick = np.median(thickness[near.reshape(len(nodes), -1)], axis=1)
    able = np.flatnonzero(thick >= _THICK * np.quantile(thick, 0.9))
    return nodes[able[int(np.argmin(nodes[able] @ up))]]


def second_base(skeleton: Skeleton, up: np.ndarray) -> np.ndarray | None:
    """Position [3] [m] where a tree reaches the ground again, or None: a tip about as thick and low
    as the root, that its branch runs down to, is the base of another plant or stem."""
    nodes, parent, radius = skeleton.nodes, skeleton.parent, skeleton.radius
    height = nodes @ up / np.linalg.norm(up)
    extent = float(np.ptp(height))
    best = None
    for tip in skeleton.tips():
        chain, length = [int(tip)], 0.0
        while parent[chain[-1]] >= 0 and length < 0.1 * extent:
            length += float(np.linalg.norm(nodes[chain[-1]] - nodes[parent[chain[-1]]]))
            chain.append(int(parent[chain[-1]]))
        comes_down = height[chain[-1]] - height[tip] > 0.7 * length > 0
        thick = float(np.median(radius[chain])) > 0.6 * float(np.median(radius[:len(chain)]))
        low = height[tip] - height.min() < 0.1 * extent
        if comes_down and thick and low and (best is None or height[tip] < height[best]):
            best = int(tip)
    return None if best is None else nodes[best]


# Selection of the bridges that are made in a round.

_SHORT = 0.5  # fraction of the longest bridge below which a piece may have any size
# Longest bridge beyond, in reaches of the smaller piece; the same if straight; price per length of
# a straight one.
_REACH, _REACH_STRAIGHT, _STRAIGHT_ON = 5.0, 10.0, 1.5
# Largest turn at which an end points at its target, and the angle within which its piece is
# straight behind it: an end that is straight for such a length reaches as far.
_AHEAD, _BEHIND = np.deg2rad(10.0), np.deg2rad(15.0)
_AT_ONCE = 1024  # hypotheses evaluated together


def mutual(found: Hypotheses, state: Joined, ends: Ends, weight: np.ndarray, rules: Rules,
           alone: bool) -> tuple[list[int], set[tuple[int, int]]]:
    """Indices of the hypotheses that are the cheapest allowed for both of their pieces, cheapest
    first; and the pairs of given pieces whose hypotheses were decisive."""
    # A piece takes a second bridge in a round if no bridge of the round can offer its new part a
    # cheaper one: else a stem with many twigs would take as many rounds. Stems join before twigs: a
    # knob of a stem that points past a twig is not its foot.
    pairs = np.sort(state.label[np.stack([found.one, found.other])], axis=0)
    own_price = found.price / np.sqrt(found.thick)
    best: dict[int, int] = {}
    made = _Made(state)
    decisive: set[tuple[int, int]] = set()
    allowed = _Allowed(found, state, ends, weight, rules, alone)
    key = pairs[0].astype(np.int64) * len(weight) + pairs[1]
    by_key = np.argsort(key, kind="stable")
    sorted_key = key[by_key]

    def decide(index: int) -> None:
        one, other = sorted(state.piece[[found.one[index], found.other[index]]].tolist())
        decisive.add((one, other))

    for index, a, b in _unsettled(pairs, allowed.likely, best, len(weight)):
        if not allowed.holds(index):
            continue
        decide(index)
        fresh = [piece for piece in (a, b) if piece not in best]
        if len(fresh) == 2 or (made.has(a, b) and made.is_clear(found, index, fresh[0])):
            same = by_key[slice(*np.searchsorted(sorted_key, [key[index], key[index] + 1]))]
            same = same[allowed.likely[same]]
            index = next(other for other in same[np.argsort(own_price[same], kind="stable")]
                         if allowed.holds(other))
            decide(index)
            if len(fresh) == 2 or made.is_clear(found, index, fresh[0]):
                made.add(found, index, a, b)
        best.setdefault(a, index)
        best.setdefault(b, index)
    return made.indices, decisive


class _Made:
    """The bridges of a round so far."""

    def __init__(self, state: Joined) -> None:
        self.indices: list[int] = []
        self._state = state
        self._by_label = np.argsort(state.label, kind="stable")
        self._start = np.searchsorted(state.label[self._by_label],
                                      np.arange(state.label.max() + 2))
        self._joined: set[int] = set()
        self._middles: list[np.ndarray] = []
        self._halves: list[float] = []

    def add(self, found: Hypotheses, index: int, a: int, b: int) -> None:
        """Take a hypothesis between pieces ``a`` and ``b``."""
        self.indices.append(int(index))
        self._joined |= {a, b}
        nodes = self._state.nodes[[found.one[index], found.other[index]]]
        self._middles.append(nodes.mean(axis=0))
        self._halves.append(float(found.length[index]) / 2)

    def has(self, a: int, b: int) -> bool:
        """Whether one of two pieces has a bridge."""
        return a in self._joined or b in self._joined

    def is_clear(self, found: Hypotheses, index: int, piece: int) -> bool:
        """Whether all bridges are farther from a piece than its hypothesis costs: no path to their
        added nodes is cheaper. Blind paths are compared with blind ones."""
        own = self._state.nodes[self._by_label[self._start[piece]:self._start[piece + 1]]]
        gap = np.linalg.norm(own[:, None] - np.array(self._middles), axis=2).min(axis=0)
        blind = found.turn[index] == np.pi
        cost = found.length[index] if blind else found.price[index]
        return bool((gap - np.array(self._halves) > cost).all())


def _unsettled(pairs: np.ndarray, likely: np.ndarray, best: dict[int, int], count: int,
               ) -> Iterator[tuple[int, int, int]]:
    """Those of the ``likely`` hypotheses, in order, whose ``pairs`` [2, h] of pieces do not both
    have a ``best`` by then; the caller updates it during the iteration."""
    has = np.zeros(count, bool)
    for start in range(0, pairs.shape[1], _AT_ONCE):
        if len(best) == count:
            return
        has[list(best)] = True
        part = pairs[:, start:start + _AT_ONCE]
        rows = np.flatnonzero(likely[start:start + _AT_ONCE] & ~has[part].all(axis=0))
        for index, a, b in zip((start + rows).tolist(), *part[:, rows].tolist(), strict=True):
            if a not in best or b not in best:
                yield index, a, b


class _Allowed:
    """Whether the smaller piece of a bridge is large enough for it, and not a plant of its own;
    ``likely`` [h] judges it by the lengths and prices of all."""

    def __init__(self, found: Hypotheses, state: Joined, ends: Ends, weight: np.ndarray,
                 rules: Rules, alone: bool) -> None:
        self._found, self._state, self._ends = found, state, ends
        self._rules = rules
        a, b = state.label[found.one], state.label[found.other]
        of_one = weight[a] <= weight[b]
        reach = far_sides(state.nodes, np.maximum(state.spread, state.thickness), state.label,
                          np.where(of_one, found.one, found.other))
        # An end may reach far straight ahead to the rest of its tip; the rest itself has no
        # reliable direction.
        odd = found.price > _STRAIGHT_ON * found.length
        straight = (found.price < _STRAIGHT_ON * found.length) & ~of_one
        self._near = found.length <= np.maximum(
            np.where(straight, _REACH_STRAIGHT, _REACH) * reach, _SHORT * rules.bridge_limit)
        ahead = straight & (found.turn < _AHEAD) & (found.length <= rules.bridge_limit)
        single = np.bincount(state.label) <= UNSURE
        self.likely = (self._near | ahead) & ~(alone & odd & (single[a] | single[b]))
        self._large = (np.minimum(weight[a], weight[b]) > PLANT_SHARE * state.support.sum()) & (
            found.length > rules.gap) & (not rules.join_plants)

    def holds(self, index: int) -> bool:
        """Whether a likely hypothesis is allowed."""
        pair = int(self._found.one[index]), int(self._found.other[index])
        state = self._state
        if not self._near[index] and self._found.length[index] > _straight_behind(
                state, self._ends, pair[0]):
            return False
        return not (self._large[index] and are_plants(state.nodes, state.thickness, state.label,
                                                      pair, self._rules.up))


def _straight_behind(state: Joined, ends: Ends, end: int) -> float:
    """Length over which an end's piece is straight behind it [m]."""
    direction = ends.direction[int(np.flatnonzero(ends.node == end)[0])]
    offset = state.nodes[state.label == state.label[end]] - state.nodes[end]
    behind = -(offset @ direction)
    aside = np.linalg.norm(offset + behind[:, None] * direction, axis=1)
    return float(behind[aside <= np.tan(_BEHIND) * behind].max(initial=0.0))


# Pieces of a scan: those of one plant are bridged, the others discarded.

_ODD = 1.9  # price of a bridge over its length above which its neighbours are tried without it
_AROUND = 2.0  # neighbourhood, in lengths of that bridge
_CLEARLY = 0.98  # fraction of the price of all bridges below which others are better
# Work of all trials, in paths between ends and nodes: some seconds; and what a node costs besides.
_MOST_WORK, _NODE_WORK = 150_000_000, 1500


def join_pieces(nodes: np.ndarray, edges: np.ndarray, thickness: np.ndarray, support: np.ndarray,
                spread: np.ndarray, *, gap: float, bridge_limit: float, up: np.ndarray,
                join_plants: bool) -> Joined:
    """Join pieces over gaps, steps over ``gap`` [m] (the paper's gamma), as directions and radii
    say. Two large pieces on the ground join only with ``join_plants``. Only an end that points
    straight at its target bridges more than ``bridge_limit`` [m]."""
    label = labels(len(nodes), edges)
    first = Joined(nodes, thickness, support, spread, edges, np.empty((0, 2), np.int64),
                   np.empty(0), np.empty((0, 2), np.int64), label, np.empty((0, 2), np.int64),
                   label)
    rules = Rules(gap, bridge_limit, up, join_plants)
    state = _reconsidered(_joined(first, rules), rules)
    plants = plants_apart(state.nodes, state.thickness, state.support, state.label, up)
    state.rivals = rivals(state, rules)
    state.plants = np.array(plants, np.int64).reshape(-1, 2)
    return state


def _joined(first: Joined, rules: Rules, refused: frozenset[tuple[int, int]] = frozenset(),
            dearest: float = np.inf, alone: bool = True) -> Joined:
    """Make bridges from a state, none between ``refused`` pieces, until they cost ``dearest`` [m].
    While ``alone``, pieces without a direction join only ends that point straight at them."""
    state = first.copy(first.rounds)
    while True:
        weight = np.bincount(state.label, state.support)
        if len(weight) == 1 or state.cost() >= dearest:
            break
        ends = state.ends()
        every = hypotheses(state.nodes, state.edges, state.thickness, state.label, weight,
                           rules.bridge_limit, ends, state.known)
        found = _unrefused(every, state.piece, refused)
        chosen, decisive = mutual(found, state, ends, weight, rules, alone)
        state.rounds.append(Round(state.copy([]), alone, decisive, every,
                                  (len(ends.node) + _NODE_WORK) * len(state.nodes)))
        if not chosen and alone:
            alone = False
            continue
        if not chosen:
            break
        for index in chosen:
            state.bridge(ends, found, index, rules.gap / 3)
        state.label = labels(len(state.nodes), state.edges)
    return state


def _without(state: Joined, pair: tuple[int, int], rules: Rules,
             refused: frozenset[tuple[int, int]], dearest: float) -> Joined:
    """The state joined like ``state``, but without bridges between this ``pair`` of pieces. Rounds
    before the first in which such a bridge mattered stay the same."""
    at = _start(state, pair)
    past = state.rounds[at]
    start = past.before.copy(state.rounds[:at])
    return _joined(start, rules, refused | {pair}, dearest, past.alone)


def _start(state: Joined, pair: tuple[int, int]) -> int:
    """The first round in which bridges between a ``pair`` of pieces mattered."""
    return next(k for k, past in enumerate(state.rounds) if pair in past.decisive)


def _reconsidered(state: Joined, rules: Rules) -> Joined:
    """Return the bridges without one that forced others to be odd, if the total cost falls: a
    stem's end at the foot of a near twig leaves the stem's next patch only the twig's side. A
    failed attempt is repeated only after bridges of its pieces have changed."""
    refused: frozenset[tuple[int, int]] = frozenset()
    vain: set[tuple[int, int]] = set()
    done = 0
    while True:
        best, without = state, refused
        for pair in _doubted(state, rules.gap):
            # As many as there were with that bridge.
            work = sum(past.work for past in state.rounds[_start(state, pair):])
            if pair in vain or done + work > _MOST_WORK:
                continue
            done += work
            dearest = _CLEARLY * best.cost()
            other = _without(state, pair, rules, refused, dearest)
            parts = other.label.max() > state.label.max()
            if other.cost() < dearest and not parts:
                best, without = other, refused | {pair}
            elif parts if other.cost() < dearest else other.cost() >= _CLEARLY * state.cost():
                vain.add(pair)
        if without == refused:
            return state
        changed = {piece for pair in _bridged(state) ^ _bridged(best) for piece in pair}
        vain = {pair for pair in vain if not changed & set(pair)}
        state, refused = best, without


def _bridged(state: Joined) -> set[tuple[int, int]]:
    """The pairs of given pieces that bridges join."""
    return set(map(tuple, np.sort(state.piece[state.bridges], axis=1).tolist()))


def _doubted(state: Joined, gap: float) -> list[tuple[int, int]]:
    """Pairs of pieces whose bridge ends near an odd one, those near the most expensive first."""
    ends, length = state.nodes[state.bridges], state.lengths()
    doubted: dict[tuple[int, int], None] = {}
    odd = np.flatnonzero((state.prices > _ODD) & (length > gap))
    for index in odd[np.argsort(-(state.prices * length)[odd], kind="stable")]:
        separation = np.linalg.norm(ends[:, :, None] - ends[index], axis=3).min(axis=(1, 2))
        near = np.flatnonzero((separation <= _AROUND * length[index]) & (length > gap))
        pairs = np.sort(state.piece[state.bridges[near]], axis=1)
        doubted |= dict.fromkeys(map(tuple, pairs[pairs[:, 0] >= 0].tolist()))
    return list(doubted)


def _unrefused(found: Hypotheses, piece: np.ndarray, refused: frozenset[tuple[int, int]],
               ) -> Hypotheses:
    if not refused:
        return found
    count = int(piece.max()) + 2  # nodes along bridges are of piece -1
    low, high = np.sort(np.stack([piece[found.one], piece[found.other]]) + 1, axis=0)
    able = ~np.isin(low * count + high, [(a + 1) * count + b + 1 for a, b in refused])
    return Hypotheses(*(getattr(found, column.name)[able] for column in fields(Hypotheses)))
