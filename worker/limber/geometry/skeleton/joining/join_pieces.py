"""Pieces of a scan: those of one plant are bridged, the others discarded."""

from dataclasses import fields

import numpy as np

from limber.geometry.skeleton.joining.bridge_choice import mutual
from limber.geometry.skeleton.joining.bridges import Hypotheses, hypotheses
from limber.geometry.skeleton.joining.pieces import Joined, Round, Rules, labels
from limber.geometry.skeleton.joining.plants import plants_apart
from limber.geometry.skeleton.joining.rivals import rivals

_ODD = 1.9  # price of a bridge over its length above which its neighbours are tried without it
_AROUND = 2.0  # neighbourhood, in lengths of that bridge
_CLEARLY = 0.98  # fraction of the price of all bridges below which others are better
# Work of all trials, in paths between ends and nodes: some seconds; and what a node costs besides.
_MOST_WORK, _NODE_WORK = 150_000_000, 1500


def join_pieces(nodes: np.ndarray, edges: np.ndarray, thickness: np.ndarray, support: np.ndarray,
                spread: np.ndarray, *, gap: float, bridge_limit: float, up: np.ndarray,
                join_plants: bool) -> Joined:
    """Join pieces over gaps by the bridges that their directions and radii support.

    The smaller piece of a long bridge must itself have some length: so a severed twig is joined to
    its branch again, and a stray clump of pixels is not joined to anything far away.

    Two large pieces that are each on the ground are two plants and are not joined.

    Args:
        nodes: Positions [m], shape [n, 3].
        edges: Node pairs of a forest, shape [e, 2].
        thickness: First radii [m], shape [n].
        support: Number of points of each node, shape [n].
        spread: Largest distance of each node's points from it [m], shape [n].
        gap: Steps up to this length [m] are no gap (the paper's gamma rule).
        bridge_limit: Longest bridge [m], unless its end points straight at its target.
        up: The up direction, shape [3].
        join_plants: Join even what looks like two plants.
    """
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
    """Make bridge after bridge from the given state, but none between ``refused`` pieces.

    It ends early once they cost ``dearest`` [m]. One or two nodes have no direction: while
    ``alone`` holds, they are joined only to ends that continue straight to them.
    """
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
    """The state joined like ``state``, but without bridges between this ``pair`` of pieces.

    The rounds before the first one in which such a bridge mattered stay the same.
    """
    at = _start(state, pair)
    past = state.rounds[at]
    start = past.before.copy(state.rounds[:at])
    return _joined(start, rules, refused | {pair}, dearest, past.alone)


def _start(state: Joined, pair: tuple[int, int]) -> int:
    """The first round in which bridges between a ``pair`` of pieces mattered."""
    return next(k for k, past in enumerate(state.rounds) if pair in past.decisive)


def _reconsidered(state: Joined, rules: Rules) -> Joined:
    """Return the bridges without one that forced others to be odd, if the total cost falls.

    A stem's end may take the foot of a twig that is nearer than the stem's next patch. That patch
    can then only join the twig from the side. A failed attempt is repeated only after bridges of
    its pieces have changed.
    """
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
