"""Which of the possible bridges are made in a round."""

from collections.abc import Iterator

import numpy as np

from limber.geometry.skeleton.joining.bridges import Hypotheses
from limber.geometry.skeleton.joining.free_ends import UNSURE, Ends
from limber.geometry.skeleton.joining.pieces import Joined, Rules
from limber.geometry.skeleton.joining.plants import PLANT_SHARE, are_plants

_SHORT = 0.5  # of the longest bridge allowed, up to which a piece may be of any size
# The longest bridge beyond, in what the smaller piece reaches; and where it goes straight on.
_REACH, _REACH_STRAIGHT, _STRAIGHT_ON = 5.0, 10.0, 1.5
# A turn up to which an end points at what it reaches, and within which its piece is straight behind
# it: an end that is so long reaches as far.
_AHEAD, _BEHIND = np.deg2rad(10.0), np.deg2rad(15.0)
_AT_ONCE = 1024  # hypotheses that are looked through together


def mutual(found: Hypotheses, state: Joined, ends: Ends, weight: np.ndarray, rules: Rules,
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
    single = np.bincount(state.label) <= UNSURE
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
             rules: Rules, reaches: dict[tuple[int, int], float]) -> bool:
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
    large = min(weight[a], weight[b]) > PLANT_SHARE * state.support.sum()
    return not (large and length > rules.gap and not rules.join_plants
                and are_plants(state.nodes, state.thickness, state.label, pair, rules.up))


def _straight_behind(state: Joined, ends: Ends, end: int) -> float:
    """How far an end's piece lies straight behind it [m]."""
    direction = ends.direction[int(np.flatnonzero(ends.node == end)[0])]
    offset = state.nodes[state.label == state.label[end]] - state.nodes[end]
    behind = -(offset @ direction)
    aside = np.linalg.norm(offset + behind[:, None] * direction, axis=1)
    return float(behind[aside <= np.tan(_BEHIND) * behind].max(initial=0.0))
