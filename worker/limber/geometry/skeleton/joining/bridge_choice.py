"""Selection of the bridges that are made in a round."""

from collections.abc import Iterator

import numpy as np

from limber.geometry.skeleton.joining.bridge_kernels import far_sides
from limber.geometry.skeleton.joining.bridges import Hypotheses
from limber.geometry.skeleton.joining.free_ends import UNSURE, Ends
from limber.geometry.skeleton.joining.pieces import Joined, Rules
from limber.geometry.skeleton.joining.plants import PLANT_SHARE, are_plants

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
    """Hypotheses that are the cheapest one allowed for both of their pieces, cheapest first.

    A piece with a bridge takes another one in the same round if the newly joined part is so far
    from all bridges of the round that none of them can offer it a cheaper one. Otherwise a stem
    with many twigs would take as many rounds.

    Stems are joined before twigs. Where two pieces belong together, the price counts more than the
    thickness of the end that proposes the bridge: a knob of the stem that points past a twig is not
    its foot.

    Returns:
        Their indices, and the pairs of given pieces whose hypotheses were decisive.
    """
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
        """Whether all bridges are farther from a piece than its hypothesis costs.

        No path to their added nodes is cheaper then. Blind paths are compared with blind ones.
        """
        own = self._state.nodes[self._by_label[self._start[piece]:self._start[piece + 1]]]
        gap = np.linalg.norm(own[:, None] - np.array(self._middles), axis=2).min(axis=0)
        blind = found.turn[index] == np.pi
        cost = found.length[index] if blind else found.price[index]
        return bool((gap - np.array(self._halves) > cost).all())


def _unsettled(pairs: np.ndarray, likely: np.ndarray, best: dict[int, int], count: int,
               ) -> Iterator[tuple[int, int, int]]:
    """Hypotheses, in their order, for pairs of pieces not both of which have a ``best`` by then.

    Args:
        pairs: The pieces of each, shape [2, h].
        likely: Which of them are considered, shape [h].
        best: Updated by the caller during the iteration.
        count: Number of pieces.
    """
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
    """Whether the smaller piece of a bridge is large enough for it, and not a plant of its own.

    Attributes:
        likely: Hypotheses that may hold, judged by the lengths and prices of all, shape [h].
    """

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
