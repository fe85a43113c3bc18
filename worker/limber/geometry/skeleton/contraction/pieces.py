"""Pieces of a scan: which belong to one plant and are bridged, and which are left away."""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from limber.geometry.skeleton.contraction.bridges import (
    Ends,
    Hypotheses,
    Known,
    filled,
    free_ends,
    hypotheses,
)
from limber.geometry.skeleton.skeleton import Skeleton

_SHORT = 0.5  # of the longest bridge allowed, up to which a piece may be of any size
# The longest bridge beyond, in what the smaller piece reaches; and where it goes straight on.
_REACH, _REACH_STRAIGHT, _STRAIGHT_ON = 5.0, 10.0, 1.5
# A turn up to which an end points at what it reaches, and within which its piece is straight behind
# it: an end that is so long reaches as far.
_AHEAD, _BEHIND = np.deg2rad(10.0), np.deg2rad(15.0)
# Length in thicknesses, under which a piece tells no direction; and if it has few points.
_SPECK, _SPECK_FEW, _FEW = 5.0, 10.0, 30
_SINGLE = 2  # nodes of a piece that tells no direction
_ODD = 1.9  # price of a bridge over its length, from which those around it are tried without
_AROUND = 2.0  # lengths of such a bridge
_CLEARLY = 0.98  # of what all bridges cost, under which others are better
_PLANT_SHARE = 0.2  # of all points, from which a piece may be a plant of its own
_BASE_SHARE = 0.12  # of a piece's reach, up to which a bridge starts at its base
_FAR_SHARE = 0.3  # from which it starts far from its base
_AT_ONCE = 1024  # hypotheses that are looked through together
_THICK = 0.45  # of a piece's thickest part, from which the base may be there
_GROUND = 0.2  # of the scan's height, up to which a base stands on the ground


@dataclass
class Joined:
    """What joining the pieces gave.

    Attributes:
        nodes: All nodes [m], those along bridges after the given ones, shape [n, 3].
        thickness: First radii [m], shape [n].
        support: Number of points of each node, none along bridges, shape [n].
        spread: How far its points reach from each node [m], 0 along bridges, shape [n].
        edges: All edges, the bridges included, shape [e, 2].
        bridges: Node pairs that were joined, shape [b, 2].
        prices: What each bridge cost over its length: 1 where an end goes straight on into
            another as thick, more the odder the bridge is, shape [b].
        plants: Node pairs between pieces that are plants of their own, shape [p, 2].
        label: Which piece each node belongs to now, shape [n].
        joints: Edges by which bridges joined the side of a piece, the bridge's node first, shape
            [j, 2].
        piece: Which of the given pieces each node is of, -1 along bridges, shape [n].
        known: What was found of ends and axes on the way here.
        rounds: How it came to this, see :class:`_Round`.
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
    rounds: list["_Round"] = field(default_factory=list)

    def copy(self, rounds: list["_Round"]) -> "Joined":
        """A state that goes on by itself, after these ``rounds``."""
        return replace(self, known=self.known.copy(), rounds=list(rounds))

    def ends(self) -> Ends:
        """The free ends of the pieces."""
        return free_ends(self.nodes, self.edges, self.thickness, self.joints, self.known)

    def lengths(self) -> np.ndarray:
        """Of each bridge [m], shape [b]."""
        return np.linalg.norm(self.nodes[self.bridges[:, 0]] - self.nodes[self.bridges[:, 1]],
                              axis=1)

    def cost(self) -> float:
        """What all bridges cost [m]."""
        return float(self.prices @ self.lengths())


@dataclass(frozen=True)
class _Round:
    """A round of bridges.

    Attributes:
        before: What there was before it.
        alone: Whether pieces that tell no direction had to wait.
        decisive: The pairs of given pieces between which a hypothesis mattered. Without those of
            any other pair the round is the same.
    """

    before: Joined
    alone: bool
    decisive: set[tuple[int, int]]


@dataclass(frozen=True)
class _Rules:
    """What bridges may be, as :func:`join_pieces` has it."""

    gap: float
    bridge_limit: float
    up: np.ndarray
    join_plants: bool


def join_pieces(nodes: np.ndarray, edges: np.ndarray, thickness: np.ndarray, support: np.ndarray,
                spread: np.ndarray, *, gap: float, bridge_limit: float, up: np.ndarray,
                join_plants: bool) -> Joined:
    """Join pieces over gaps by the bridges that their directions and radii speak for.

    The smaller piece of a long bridge must have some length itself: so a severed twig comes back to
    its branch, and a stray clump of pixels is joined to nothing far away.

    Two large pieces that each stand on the ground are two plants, and are not joined.

    Args:
        nodes: Positions [m], shape [n, 3].
        edges: Node pairs of a forest, shape [e, 2].
        thickness: First radii [m], shape [n].
        support: Number of points of each node, shape [n].
        spread: How far its points reach from each node [m], shape [n].
        gap: Steps up to this length [m] are no gap (the paper's gamma rule).
        bridge_limit: No bridge is longer [m], unless its end points straight at what it reaches.
        up: Which way is up, shape [3].
        join_plants: Join even what looks like two plants.
    """
    label = _labels(len(nodes), edges)
    first = Joined(nodes, thickness, support, spread, edges, np.empty((0, 2), np.int64),
                   np.empty(0), np.empty((0, 2), np.int64), label, np.empty((0, 2), np.int64),
                   label)
    rules = _Rules(gap, bridge_limit, up, join_plants)
    state = _reconsidered(_joined(first, rules), rules)
    plants = _apart(state.nodes, state.thickness, state.support, state.label, up)
    state.plants = np.array(plants, np.int64).reshape(-1, 2)
    return state


def _joined(first: Joined, rules: _Rules, refused: frozenset[tuple[int, int]] = frozenset(),
            dearest: float = np.inf, alone: bool = True) -> Joined:
    """Bridge after bridge from what was given; those between ``refused`` pieces are not made.

    It ends early once they cost ``dearest`` [m]. One node or two tell no direction: as long as
    ``alone`` holds, they are joined only to ends that go straight on to them.
    """
    state = first.copy(first.rounds)
    while True:
        weight = np.bincount(state.label, state.support)
        if len(weight) == 1 or state.cost() >= dearest:
            break
        ends = state.ends()
        found = _unrefused(hypotheses(state.nodes, state.edges, state.thickness, state.label,
                                      weight, rules.bridge_limit, ends, state.known),
                           state.piece, refused)
        chosen, decisive = _mutual(found, state, ends, weight, rules, alone)
        state.rounds.append(_Round(state.copy([]), alone, decisive))
        if not chosen and alone:
            alone = False
            continue
        if not chosen:
            break
        for place in chosen:
            _bridge(state, ends, found, place, rules.gap / 3)
        state.label = _labels(len(state.nodes), state.edges)
    return state


def _without(state: Joined, pair: tuple[int, int], rules: _Rules,
             refused: frozenset[tuple[int, int]], dearest: float) -> Joined:
    """As ``state`` was joined, but for bridges between a ``pair`` of pieces, ``refused`` as well.

    All is the same up to the first round that such a bridge mattered in.
    """
    at = next(k for k, past in enumerate(state.rounds) if pair in past.decisive)
    past = state.rounds[at]
    start = past.before.copy(state.rounds[:at])
    return _joined(start, rules, refused | {pair}, dearest, past.alone)


def _reconsidered(state: Joined, rules: _Rules) -> Joined:
    """The bridges without one that left an odd one to others, if all together then cost less.

    A stem's end takes the foot of a twig that happens to be nearer than the stem's next patch;
    that patch is then left to come to the twig from aside.
    """
    refused: frozenset[tuple[int, int]] = frozenset()
    while True:
        best, without = state, refused
        for pair in _doubted(state, rules.gap):
            dearest = _CLEARLY * best.cost()
            other = _without(state, pair, rules, refused, dearest)
            if other.label.max() <= best.label.max() and other.cost() < dearest:
                best, without = other, refused | {pair}
        if without == refused:
            return state
        state, refused = best, without


def _doubted(state: Joined, gap: float) -> list[tuple[int, int]]:
    """Pairs of pieces whose bridge ends near an odd one."""
    ends, length = state.nodes[state.bridges], state.lengths()
    doubted = set()
    for odd in np.flatnonzero((state.prices > _ODD) & (length > gap)):
        apart = np.linalg.norm(ends[:, :, None] - ends[odd], axis=3).min(axis=(1, 2))
        near = np.flatnonzero((apart <= _AROUND * length[odd]) & (length > gap))
        pairs = np.sort(state.piece[state.bridges[near]], axis=1)
        doubted |= set(map(tuple, pairs[pairs[:, 0] >= 0].tolist()))
    return sorted(doubted)


def _unrefused(found: Hypotheses, piece: np.ndarray, refused: frozenset[tuple[int, int]],
               ) -> Hypotheses:
    if not refused:
        return found
    pairs = np.sort(np.stack([piece[found.one], piece[found.other]], axis=1), axis=1)
    able = ~(pairs[:, None] == np.array(sorted(refused))).all(axis=2).any(axis=1)
    return Hypotheses(*(getattr(found, column.name)[able] for column in fields(Hypotheses)))


def _mutual(found: Hypotheses, state: Joined, ends: Ends, weight: np.ndarray, rules: _Rules,
            alone: bool) -> tuple[list[int], set[tuple[int, int]]]:
    """Hypotheses that are the cheapest one allowed for both of their pieces, cheapest first.

    Stems are joined before twigs; where two pieces belong together, a price counts more than how
    thick the end is that names it: a knob of the stem that points past a twig is no foot of it.

    Returns:
        Their places, and the pairs of given pieces whose hypotheses decided on them.
    """
    pairs = np.sort(state.label[np.stack([found.one, found.other])], axis=0)
    own_price = found.price / np.sqrt(found.thick)
    best: dict[int, int] = {}
    first: list[tuple[int, int, int]] = []
    decisive: set[tuple[int, int]] = set()
    single = np.bincount(state.label) <= _SINGLE
    reaches: dict[tuple[int, int], float] = {}

    def able(place: int, a: int, b: int) -> bool:
        odd = found.price[place] > _STRAIGHT_ON * found.length[place]
        return not (alone and odd and (single[a] or single[b])) and _allowed(
            found, place, state, ends, weight, rules, reaches)

    def decide(place: int) -> None:
        one, other = sorted(state.piece[[found.one[place], found.other[place]]].tolist())
        decisive.add((one, other))

    for place, a, b in _unsettled(pairs, best, len(weight)):
        if not able(place, a, b):
            continue
        decide(place)
        if a not in best and b not in best:
            same = np.flatnonzero((pairs[0] == a) & (pairs[1] == b))
            place = next(other for other in same[np.argsort(own_price[same], kind="stable")]
                         if able(other, a, b))
            decide(place)
            first.append((place, a, b))
        best.setdefault(a, place)
        best.setdefault(b, place)
    return [place for place, a, b in first if best[a] == best[b] == place], decisive


def _unsettled(pairs: np.ndarray, best: dict[int, int], count: int,
               ) -> Iterator[tuple[int, int, int]]:
    """Hypotheses, in their order, for pairs of pieces not both of which have a ``best`` by then.

    Args:
        pairs: The pieces of each, shape [2, h].
        best: Grows in between.
        count: Number of pieces.
    """
    has = np.zeros(count, bool)
    for start in range(0, pairs.shape[1], _AT_ONCE):
        if len(best) == count:
            return
        has[list(best)] = True
        part = pairs[:, start:start + _AT_ONCE]
        places = np.flatnonzero(~has[part].all(axis=0))
        for place, a, b in zip((start + places).tolist(), *part[:, places].tolist(), strict=True):
            if a not in best or b not in best:
                yield place, a, b


def _allowed(found: Hypotheses, place: int, state: Joined, ends: Ends, weight: np.ndarray,
             rules: _Rules, reaches: dict[tuple[int, int], float]) -> bool:
    """Whether the smaller piece is large enough for the bridge, and no plant of its own.

    ``reaches`` keeps how far a piece reaches from an end, for all hypotheses of a round.
    """
    pair = int(found.one[place]), int(found.other[place])
    length, price = float(found.length[place]), float(found.price[place])
    a, b = state.label[list(pair)]
    small, end = (a, pair[0]) if weight[a] <= weight[b] else (b, pair[1])
    if (small, end) not in reaches:
        own = state.label == small
        reaches[small, end] = float((
            np.linalg.norm(state.nodes[own] - state.nodes[end], axis=1)
            + np.maximum(state.spread, state.thickness)[own]).max())
    reach = reaches[small, end]
    # An end may go far straight on to what is left of its tip; that itself points anywhere.
    straight = price < _STRAIGHT_ON * length and a != small
    farthest = max((_REACH_STRAIGHT if straight else _REACH) * reach, _SHORT * rules.bridge_limit)
    if length > farthest and not (
            straight and found.turn[place] < _AHEAD
            and length <= min(_straight_behind(state, ends, pair[0]), rules.bridge_limit)):
        return False
    large = min(weight[a], weight[b]) > _PLANT_SHARE * state.support.sum()
    return not (large and length > rules.gap and not rules.join_plants
                and _are_plants(state.nodes, state.thickness, state.label, pair, rules.up))


def _straight_behind(state: Joined, ends: Ends, end: int) -> float:
    """How far an end's piece lies straight behind it [m]."""
    direction = ends.direction[int(np.flatnonzero(ends.node == end)[0])]
    offset = state.nodes[state.label == state.label[end]] - state.nodes[end]
    behind = -(offset @ direction)
    aside = np.linalg.norm(offset + behind[:, None] * direction, axis=1)
    return float(behind[aside <= np.tan(_BEHIND) * behind].max(initial=0.0))


def _bridge(state: Joined, ends: Ends, found: Hypotheses, place: int, step: float) -> None:
    """Add a bridge, with nodes along it that others may be joined to."""
    one, other = int(found.one[place]), int(found.other[place])
    curve, thick = filled(state.nodes, state.thickness, ends, one, other, step)
    chain = np.concatenate([[one], len(state.nodes) + np.arange(len(curve)), [other]])
    state.edges = np.vstack([state.edges, np.stack([chain[:-1], chain[1:]], axis=1)])
    if not found.meets[place]:
        own, met = (_pointing(ends, node) for node in (one, other))
        if met > 0:
            # Of two ends side by side the thicker one goes on.
            joint = chain[[1, 0]] if own > met else chain[[-2, -1]]
            state.joints = np.vstack([state.joints, joint])
    state.nodes = np.vstack([state.nodes, curve])
    state.thickness = np.concatenate([state.thickness, thick])
    state.support = np.concatenate([state.support, np.zeros(len(curve), state.support.dtype)])
    state.spread = np.concatenate([state.spread, np.zeros(len(curve))])
    state.bridges = np.vstack([state.bridges, [one, other]])
    state.piece = np.concatenate([state.piece, np.full(len(curve), -1)])
    state.prices = np.append(state.prices, found.price[place] / found.length[place])


def _pointing(ends: Ends, node: int) -> float:
    """Radius [m] of a node that is an end with a direction of its own, else 0."""
    own = (ends.node == node) & ends.direction.any(axis=1)
    return float(ends.radius[own].sum())


def specks(nodes: np.ndarray, edges: np.ndarray, thickness: np.ndarray, support: np.ndarray,
           ) -> np.ndarray:
    """A number for each node, shape [n]: its own, but one for all of a piece too short to point.

    Of a few points of a branch contraction makes a short line in any direction; whoever is joined
    to it in its middle finds no end to go on from.
    """
    label = _labels(len(nodes), edges)
    low, high = np.full((label.max() + 1, 3), np.inf), np.full((label.max() + 1, 3), -np.inf)
    np.minimum.at(low, label, nodes)
    np.maximum.at(high, label, nodes)
    thick = np.zeros(label.max() + 1)
    np.maximum.at(thick, label, thickness)
    few = np.bincount(label, support) < _FEW
    short = np.linalg.norm(high - low, axis=1) < np.where(few, _SPECK_FEW, _SPECK) * thick
    return np.where(short[label], len(nodes) + label, np.arange(len(nodes)))


def second_base(skeleton: Skeleton, up: np.ndarray) -> np.ndarray | None:
    """Where a tree stands on the ground a second time [m], shape [3]; None if it does not.

    A tip about as thick and as low as the root, that its branch comes down to, is the base of
    another plant, or of another stem.
    """
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


def _labels(count: int, edges: np.ndarray) -> np.ndarray:
    matrix = sparse.coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (count, count))
    return connected_components(matrix, directed=False)[1]


def _base(nodes: np.ndarray, thickness: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The lowest place where a piece is thick [m], shape [3]."""
    _, near = cKDTree(nodes).query(nodes, k=min(6, len(nodes)))
    thick = np.median(thickness[near.reshape(len(nodes), -1)], axis=1)
    able = np.flatnonzero(thick >= _THICK * np.quantile(thick, 0.9))
    return nodes[able[int(np.argmin(nodes[able] @ up))]]


def _are_plants(nodes: np.ndarray, thickness: np.ndarray, label: np.ndarray,
                bridge: tuple[int, int], up: np.ndarray) -> bool:
    """Whether two pieces each stand on the ground, not one of them on the other's end."""
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


def _apart(nodes: np.ndarray, thickness: np.ndarray, support: np.ndarray, label: np.ndarray,
           up: np.ndarray) -> list[tuple[int, int]]:
    """Nearest nodes between the largest piece and each large one that was not joined to it."""
    weight = np.bincount(label, support)
    main = np.flatnonzero(label == int(np.argmax(weight)))
    found = []
    large = np.flatnonzero(weight > _PLANT_SHARE * support.sum())
    for piece in np.setdiff1d(large, np.argmax(weight)):
        own = np.flatnonzero(label == piece)
        distance, near = cKDTree(nodes[main]).query(nodes[own])
        place = int(np.argmin(distance))
        bridge = (int(own[place]), int(main[near[place]]))
        if _are_plants(nodes, thickness, label, bridge, up):
            found.append(bridge)
    return found
