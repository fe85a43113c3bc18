"""The rival of each bridge: the cheapest other place at which the same end could be attached."""

from dataclasses import dataclass

import numpy as np

from limber.geometry.skeleton.joining.bridges import Hypotheses
from limber.geometry.skeleton.joining.pieces import Joined, Rules

_ELSEWHERE = 3.0  # thicknesses within which two places are the same fork
_MOST = 20.0  # largest ratio of prices that counts
# Logistic model of a bridge that joins what belongs together: a constant, and a slope for each
# column of `bridge_evidence`; fitted by benchmarks.scan_probabilities to 266 bridges of 70 scans of
# seven sources. With each left out, tenths agree with the outcome within their binomial error.
BRIDGE_ODDS = (7.64, 0.08, -3.39, -1.47)


@dataclass(frozen=True)
class Rival:
    """Another place for a piece.

    Attributes:
        end: The end of the smaller piece that the bridge attaches [m], shape [3].
        to: The other place [m], shape [3].
        price: Cost of the bridge to it [m].
    """

    end: np.ndarray
    to: np.ndarray
    price: float


def rivals(state: Joined, rules: Rules) -> list[Rival | None]:
    """The rival of each bridge over a gap, None where there is none.

    Each is sought among the hypotheses of the round in which the bridge was made, including those
    of pairs that were refused later.
    """
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
    """Evidence for a bridge, shape [3].

    ln of the rival's price over its own, ln of its price over its length, and
    ln(1 + length / thickness).

    Args:
        price: Its cost over its length.
        length: Its length [m].
        thickness: Of the thinner of its ends [m].
        rival_price: Cost of the rival [m]; None: there is none.
    """
    ratio = _MOST if rival_price is None else rival_price / max(price * length, 1e-300)
    return np.array([np.log(np.clip(ratio, 1 / _MOST, _MOST)), np.log(max(price, 1e-12)),
                     np.log1p(length / max(thickness, 1e-12))])


def bridge_probability(evidence: np.ndarray) -> float:
    """Probability that a bridge with this evidence joins what belongs together."""
    start, *slopes = BRIDGE_ODDS
    return float(1 / (1 + np.exp(-(start + evidence @ np.array(slopes)))))
