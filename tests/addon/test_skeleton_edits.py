"""What was done to a skeleton's nodes, as edits: each in its order, and what is none is refused."""


import numpy as np
import pytest
from tests.addon.conftest import part


@pytest.fixture()
def edits(addon):
    return part("skeleton.skeleton_edits")


@pytest.fixture()
def tree(edits):
    """A stem of five nodes; 5 and 6 hang on 2, 7 on 6."""
    nodes = np.array([[0, 0, k] for k in range(5)] + [[1, 0, 2], [2, 0, 2], [3, 0, 2]], float) / 10
    return edits.Skeleton(nodes, np.full(8, 0.01), np.array([-1, 0, 1, 2, 3, 2, 5, 6]))


def _nodes(edits, tree, keep=None, **changed):
    """The nodes as given, those of ``keep`` alone, with some arrays exchanged."""
    keep = np.arange(len(tree.nodes)) if keep is None else np.array(keep)
    place = {number: k for k, number in enumerate(keep.tolist())}
    edges = [[place[k], place[int(tree.parent[k])]] for k in keep.tolist()
             if int(tree.parent[k]) in place]
    zero = np.zeros(len(keep), int)
    values = {"number": keep, "places": tree.nodes[keep].astype(np.float32),
              "radius": tree.radius[keep].astype(np.float32), "is_root": tree.parent[keep] < 0,
              "marks": zero, "targets": zero - 1, "turns": zero,
              "edges": np.array(edges).reshape(-1, 2)}
    return edits.Nodes(**(values | changed))


def _with(values, at, value):
    values = np.array(values)
    values[at] = value
    return values


def test_nothing_done_is_no_edit(edits, tree):
    assert edits.edits_of(tree, _nodes(edits, tree)) == []
    order = np.random.default_rng(0).permutation(8)
    shuffled = _nodes(edits, tree, keep=order)
    assert edits.edits_of(tree, shuffled) == []


def test_moves_come_first_then_what_is_at_the_new_place(edits, tree):
    """A node is moved, thinned and hung over: each edit finds it where the one before left it."""
    now = _nodes(edits, tree)
    places = _with(now.places, (5, 1), 0.25)
    done = edits.edits_of(tree, _nodes(
        edits, tree, places=places, radius=_with(now.radius, 5, 0.02),
        marks=_with(now.marks, 5, edits.Mark.BRIDGE), targets=_with(now.targets, 5, 4),
        is_root=_with(_with(now.is_root, 0, False), 4, True)))
    assert [edit["do"] for edit in done] == ["move", "radius", "bridge", "root"]
    move, radius, bridge, root = done
    assert move["at"] == pytest.approx(tree.nodes[5]) and move["to"][1] == 0.25
    assert radius == {"do": "radius", "at": move["to"], "radius": pytest.approx(0.02)}
    assert bridge["at"] == move["to"] and bridge["to"] == pytest.approx(tree.nodes[4])
    assert root["at"] == pytest.approx(tree.nodes[4])


def test_marks_keep_their_order(edits, tree):
    now = _nodes(edits, tree)
    done = edits.edits_of(tree, _nodes(
        edits, tree, marks=np.array([0, 0, 0, 4, 0, 3, 0, 1]),
        targets=_with(_with(now.targets, 5, 4), 7, 3), turns=np.array([0, 0, 0, 2, 0, 3, 0, 1])))
    assert [edit["do"] for edit in done] == ["bridge", "confirm", "split"]


def test_deleted_nodes_are_one_branch_each(edits, tree):
    """Only the first of what is gone is named; the worker cuts from there outwards."""
    done = edits.edits_of(tree, _nodes(edits, tree, keep=[0, 1, 2, 3]))
    assert done == [{"do": "delete", "at": pytest.approx(tree.nodes[4])},
                    {"do": "delete", "at": pytest.approx(tree.nodes[5])}]


def test_what_is_hung_over_outlives_what_carried_it(edits, tree):
    keep = [0, 1, 2, 3, 4, 6, 7]
    with pytest.raises(edits.SkeletonEditError, match="2 nodes are detached"):
        edits.edits_of(tree, _nodes(edits, tree, keep=keep))
    done = edits.edits_of(tree, _nodes(
        edits, tree, keep=keep, marks=np.array([0, 0, 0, 0, 0, 3, 0]),
        targets=np.array([-1] * 5 + [4, -1])))
    assert [edit["do"] for edit in done] == ["split", "delete"]


@pytest.mark.parametrize(("change", "said"), [
    (lambda e, t: _nodes(e, t, number=np.array([0, 1, 2, 3, 4, 5, 6, 6])), "Nodes were added"),
    (lambda e, t: _nodes(e, t, edges=np.vstack([_nodes(e, t).edges, [[4, 7]]])), "edge was drawn"),
    (lambda e, t: _nodes(e, t, edges=_nodes(e, t).edges[:-1]), "edge was cut"),
    (lambda e, t: _nodes(e, t, keep=[5, 6, 7]), "root was deleted"),
    (lambda e, t: _nodes(e, t, radius=np.zeros(8, np.float32)), "not positive"),
    (lambda e, t: _nodes(e, t, is_root=np.ones(8, bool)), "Several nodes"),
    (lambda e, t: _nodes(e, t, keep=[0, 1, 2, 3, 5, 6, 7], marks=np.array([0] * 6 + [1]),
                         targets=np.array([-1] * 6 + [4])), r"target node of a .* was deleted"),
])
def test_what_is_no_edit_is_refused(edits, tree, change, said):
    with pytest.raises(edits.SkeletonEditError, match=said):
        edits.edits_of(tree, change(edits, tree))


@pytest.mark.parametrize("seed", range(20))
def test_the_worker_makes_of_the_edits_what_was_done(edits, tmp_path, seed):
    """Random moves, radii and deletions on a random tree: the edited tree has exactly the nodes
    that the user left, where they are."""
    from limber.core.json_values import validated
    from limber.geometry.skeleton.edits import Edit, edited
    from limber.geometry.skeleton.skeleton import Skeleton as Tree

    rng = np.random.default_rng(seed)
    parent = np.array([-1, *(rng.integers(0, k) for k in range(1, 30))])
    nodes = rng.random((30, 3))
    radius = rng.uniform(0.005, 0.02, 30)
    made = Tree.from_edges(nodes, parent, radius)
    before = edits.Skeleton(made.nodes, made.radius, made.parent)
    keep = []
    while len(keep) < 2:
        gone = set().union(*(before.outwards(int(k)) for k in rng.integers(1, 30, 3)))
        keep = [k for k in range(30) if k not in gone]
    now = _nodes(edits, before, keep=keep)
    shift = rng.random((len(keep), 3)) < 0.3
    places = (now.places + 0.05 * shift * rng.standard_normal(shift.shape)).astype(np.float32)
    resized = np.where(rng.random(len(keep)) < 0.3, 1.5 * now.radius, now.radius)
    done = edits.edits_of(before, _nodes(edits, before, keep=keep, places=places,
                                         radius=resized.astype(np.float32)))
    after = edited(made, validated(list[Edit], done))
    assert after.node_count == len(keep)
    order = [int(np.linalg.norm(after.nodes - place, axis=1).argmin()) for place in places]
    assert sorted(order) == list(range(len(keep)))
    np.testing.assert_allclose(after.nodes[order], places, atol=1e-6)
    np.testing.assert_allclose(after.radius[order], resized, rtol=1e-5)
