"""The most likely graphs of a skeleton: exact probabilities, and edits that make them."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from limber.geometry.skeleton.alternatives import (
    SearchDoubts,
    alternatives,
    attachments,
    open_questions,
)
from limber.geometry.skeleton.confidence import PLACED
from limber.geometry.skeleton.edits import edited
from limber.geometry.skeleton.skeleton import BRIDGED, Skeleton
from limber.geometry.skeleton.totals import total_length


def _chain(start: list[float], stop: list[float], count: int) -> np.ndarray:
    return np.linspace(start, stop, count + 1)[1:]


def _tree(*chances: float) -> Skeleton:
    """A stem with a twig that carries another, and a second twig, with these probabilities."""
    stem = np.linspace([0, 0, 0], [0, 0, 1.0], 21)
    nodes = [stem, _chain([0, 0, 0.4], [0.3, 0, 0.4], 6),
             _chain([0.15, 0, 0.4], [0.15, 0.1, 0.4], 4), _chain([0, 0, 0.7], [-0.2, 0, 0.7], 4)]
    parent = [np.arange(-1, 20), [8, *range(21, 26)], [23, *range(27, 30)], [14, *range(31, 34)]]
    one, upper, other = chances
    chance = np.repeat([1.0, PLACED * one, PLACED**2 * one * upper, PLACED * other], [21, 6, 4, 4])
    return Skeleton.from_edges(np.vstack(nodes), np.concatenate(parent), np.full(35, 0.01),
                               probability=chance)


def _bridge(chance: float) -> dict:
    """The second twig hangs on a bridge; its rival place is the first twig's tip."""
    return {"from": np.array([0, 0, 0.7]), "to": np.array([-0.1, 0, 0.7]), "length": 0.1,
            "price": 1.5, "thickness": 0.01, "probability": chance,
            "rival_from": np.array([-0.1, 0, 0.7]), "rival_to": np.array([0.0, 0, 0.95]),
            "rival_price": 0.4}


def test_the_best_graphs_are_those_of_all_combinations() -> None:
    one, upper, other = 0.8, 0.6, 0.7
    tree = _tree(one, upper, other)
    found = alternatives(tree, SearchDoubts(), 6)
    expected = sorted((
        (one * (upper if b else 1 - upper) if a else 1 - one) * (other if c else 1 - other)
        for a, b, c in itertools.product([1, 0], repeat=3) if a or b), reverse=True)
    assert found[0].edits == () and found[0].probability == pytest.approx(one * upper * other)
    assert [graph.probability for graph in found] == pytest.approx(expected)
    assert sum(graph.probability for graph in found) == pytest.approx(1.0)
    for graph in found:
        assert edited(tree, graph.edits).length == pytest.approx(graph.length)


def test_a_deleted_branch_asks_nothing_of_those_that_it_carried() -> None:
    graph = next(one for one in alternatives(_tree(0.3, 0.6, 1.0), SearchDoubts(), 5)
                 if one.probability == pytest.approx(0.7))
    assert [edit.do for edit in graph.edits] == ["delete"]
    assert edited(_tree(0.3, 0.6, 1.0), graph.edits).branch_count == 2


def test_a_bridged_piece_may_be_attached_at_its_rival() -> None:
    tree = _tree(0.99, 0.99, 0.98)
    state = tree.radius_state.copy()
    state[np.isclose(tree.nodes[:, 0], -0.05)] = BRIDGED
    tree = replace(tree, radius_state=state)
    doubts = SearchDoubts([_bridge(0.55)])
    second = alternatives(tree, doubts)[1]
    assert [edit.do for edit in second.edits] == ["split"]
    assert second.probability == pytest.approx(0.99 * 0.99 * 0.98 * 0.45)
    moved = edited(tree, second.edits)
    # The old path through the gap is gone with it.
    assert moved.length == pytest.approx(tree.length - 0.1 + np.hypot(0.1, 0.25))
    assert [part.kind for part in open_questions(tree, doubts)] == ["attachment"]
    assert not attachments(moved, doubts.bridges)


def test_confirming_a_branch_settles_its_attachment() -> None:
    assert attachments(_tree(1.0, 1.0, 0.9), [_bridge(0.55)])
    assert not attachments(replace(_tree(1, 1, 1), probability=np.ones(35)), [_bridge(0.55)])


def test_the_length_counts_the_other_attachment() -> None:
    tree = _tree(1.0, 1.0, 0.999999)
    plain, open_one = (total_length(tree, SearchDoubts(bridges))
                       for bridges in ([], [_bridge(0.5)]))
    longer = np.hypot(0.1, 0.25) - 0.1
    assert open_one.expected - plain.expected == pytest.approx(longer / 2, rel=1e-3)
    low, high = open_one.interval
    assert low < tree.length < high and low < tree.length + longer < high


def test_a_dropped_twig_can_be_added_and_the_root_changed() -> None:
    tree = _tree(1.0, 1.0, 1.0)
    twig = {"length": 0.2, "from": np.array([0, 0, 0.2]), "at": np.array([0, 0.2, 0.2]),
            "radius": 0.004, "probability": 0.4}
    doubts = SearchDoubts(unlikely=[twig], root_ends=[
        {"at": np.zeros(3), "probability": 0.6}, {"at": np.array([0, 0, 1.0]), "probability": 0.4}])
    used, *others = alternatives(tree, doubts)
    assert used.probability == pytest.approx(0.36)
    assert [sorted(edit.do for edit in graph.edits) for graph in others][2] == ["add", "root"]
    both = edited(tree, others[2].edits)
    assert both.length == pytest.approx(tree.length + 0.2)
    assert both.nodes[0] == pytest.approx([0, 0, 1.0])
    assert [part.kind for part in open_questions(tree, doubts)] == ["root"]
    # Once added, it is not asked for again.
    assert all("add" not in [edit.do for edit in graph.edits]
               for graph in alternatives(both, SearchDoubts(unlikely=[twig])))
