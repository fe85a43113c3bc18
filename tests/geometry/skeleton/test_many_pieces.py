"""A crown in very many pieces: joined in few rounds, and as if nothing had been remembered."""

import numpy as np
import pytest

from limber.geometry.skeleton import bridge_kernels, joining
from limber.geometry.skeleton.bridge_kernels import boxes
from limber.geometry.skeleton.free_ends import free_ends
from limber.geometry.skeleton.joining import join_pieces

Z = np.array([0.0, 0.0, 1.0])


def _crown(twigs, seed=0):
    """Chains of a stem and its twigs with gaps, some askew: nodes, edges and radii."""
    rng = np.random.default_rng(seed)
    nodes, edges, radii = [], [], []

    def chain(line, radius):
        begin, count = sum(map(len, nodes)), len(line)
        nodes.append(line)
        radii.append(np.full(count, radius))
        edges.append(begin + np.stack([np.arange(count - 1), np.arange(1, count)], axis=1))

    height = np.arange(0, 2, 0.01)
    stem = np.stack([0.03 * np.sin(3 * height), 0.02 * height, height], axis=1)
    for part in np.array_split(stem, 4):
        chain(part[:-6], 0.02)
    for k in range(twigs):
        way = rng.normal(size=3) * [1, 1, 0.3] + [0, 0, 0.6]
        way /= np.linalg.norm(way)
        start = stem[int(len(stem) * (0.15 + 0.8 * k / twigs))]
        along = np.arange(0.05, 0.4, 0.01)[:, None]
        line = start + along * way + 0.1 * along**2 * rng.normal(size=3)
        for part in np.array_split(line, 2):
            chain(part[:-5] + rng.normal(size=3) * 0.012, 0.006)
    return np.vstack(nodes), np.vstack(edges), np.concatenate(radii)


def _joined(twigs, seed=0):
    nodes, edges, radius = _crown(twigs, seed)
    return join_pieces(nodes, edges, radius, np.full(len(nodes), 20), radius, gap=0.03,
                       bridge_limit=0.3, up=Z, join_plants=True)


@pytest.fixture
def priced_bridges(monkeypatch) -> list[int]:
    """The number of bridges that each round of joining prices."""
    counts, price = [], joining.hypotheses

    def counted(*arguments):
        found = price(*arguments)
        counts.append(len(found.one))
        return found

    monkeypatch.setattr(joining, "hypotheses", counted)
    return counts


def test_a_crown_of_many_pieces_is_joined_in_few_rounds(priced_bridges):
    """Every trial without a bridge once joined all pieces again, pricing all of them each time."""
    state = _joined(22)
    assert state.label.max() == 0 and len(state.bridges) == 47
    assert len(priced_bridges) < 60 and sum(priced_bridges) < 500_000


def _sticks(count, seed=5):
    """Short sticks in all directions, each of three nodes: nodes and edges."""
    rng = np.random.default_rng(seed)
    way = rng.normal(size=(count, 1, 3))
    way /= np.linalg.norm(way, axis=2, keepdims=True)
    nodes = rng.uniform(0, 1, (count, 1, 3)) + np.linspace(0, 0.01, 3)[:, None] * way
    first = 3 * np.arange(count)
    return nodes.reshape(-1, 3), np.stack(
        [np.r_[first, first + 1], np.r_[first + 1, first + 2]], axis=1)


@pytest.mark.campaign
def test_strewn_sticks_take_no_more_rounds_than_a_crown(priced_bridges) -> None:
    """A bridge for each of 300 short sticks, and few trials without one."""
    nodes, edges = _sticks(300)
    radius = np.full(len(nodes), 0.002)
    state = join_pieces(nodes, edges, radius, np.full(len(nodes), 20), radius, gap=0.03,
                        bridge_limit=0.5, up=Z, join_plants=False)
    assert state.label.max() == 0
    assert len(priced_bridges) < 60 and sum(priced_bridges) < 3_000_000


def test_boxes_leave_out_no_path() -> None:
    """The search over boxes keeps the paths that one over all nodes keeps."""
    nodes, edges = _sticks(60)
    radius, label = np.full(len(nodes), 0.002), np.repeat(np.arange(60), 3)
    ends = free_ends(nodes, edges, radius)
    end_of = np.full(len(nodes), -1)
    end_of[ends.node] = np.arange(len(ends.node))
    given = (nodes, radius, np.zeros_like(nodes), np.zeros(len(nodes), bool), label, ends.node,
             ends.direction, ends.radius, end_of, 0.4)
    whole = (np.arange(len(nodes)), np.array([[0, len(nodes)]]), nodes.min(axis=0)[None],
             nodes.max(axis=0)[None], np.array([-1]))
    kept = bridge_kernels.priced(*given, boxes(nodes, label))
    for one, other in zip(kept, bridge_kernels.priced(*given, whole), strict=True):
        np.testing.assert_array_equal(one, other)
    assert len(kept[0]) < len(ends.node) * 177
    for one, other in zip(*(bridge_kernels.nearest_others(
            nodes, label, np.arange(len(nodes)), 0.4, 3, tree) for tree in (
                boxes(nodes, label), whole)), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_stem_takes_many_twigs_in_a_round():
    """One twig a round once made rounds as many as twigs, each as dear as all pieces."""
    state = _joined(8)
    assert state.label.max() == 0 and len(state.bridges) == 19
    assert len(state.rounds) < 10


def test_trials_without_a_bridge_end(monkeypatch):
    """However many pieces there are, they do no more work than allowed."""
    tried = []
    without = joining._without

    def counted(state, pair, *further):
        tried.append(sum(past.work for past in state.rounds[joining._start(state, pair):]))
        return without(state, pair, *further)

    monkeypatch.setattr(joining, "_without", counted)
    _joined(8)
    all_tried = sum(tried)
    assert all_tried
    tried.clear()
    monkeypatch.setattr(joining, "_MOST_WORK", all_tried - 1)
    _joined(8)
    assert sum(tried) < all_tried


@pytest.mark.slow
def test_what_is_remembered_changes_nothing(monkeypatch):
    """Rounds taken over and ends known from before give what joining all anew gives."""
    states = [_joined(8, seed) for seed in range(4)]
    tried = []

    def anew(state, pair, rules, refused, dearest):
        tried.append(pair)
        return joining._joined(state.rounds[0].before.copy([]), rules, refused | {pair}, dearest)

    monkeypatch.setattr(joining, "_without", anew)
    monkeypatch.setattr(joining.Joined, "ends", lambda state: joining.free_ends(
        state.nodes, state.edges, state.thickness, state.joints))
    for seed, state in enumerate(states):
        again = _joined(8, seed)
        for name in ("nodes", "edges", "bridges", "prices", "joints", "label"):
            np.testing.assert_array_equal(getattr(again, name), getattr(state, name))
    assert tried
