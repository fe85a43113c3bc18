"""A user's edits: applied by place, in order, to whatever the next reconstruction found."""

import numpy as np
import pytest

from limber.errors import InputError
from limber.geometry.skeleton.edits import EDITS, edited
from limber.geometry.skeleton.skeleton import Skeleton


def _tree(count: int = 41) -> Skeleton:
    """A stem of 0.4 m along z with a twig along x at 0.2 m; as finely divided as asked."""
    z, x = np.linspace(0, 0.4, count), np.linspace(0, 0.15, 16)[1:]
    nodes = np.vstack([np.stack([0 * z, 0 * z, z], axis=1),
                       np.stack([x, 0 * x, 0 * x + 0.2], axis=1)])
    parent = np.concatenate([np.arange(count) - 1, [count // 2], count + np.arange(14)])
    return Skeleton.from_edges(nodes, parent, np.repeat([0.008, 0.004], [count, 15]))


def _edits(*edits: dict):
    return EDITS.validate_python(list(edits))


def test_edits_do_what_they_say() -> None:
    """Delete, bridge, root, move and radius, on their own."""
    tree = _tree()
    cut = edited(tree, _edits({"do": "delete", "at": (0.08, 0, 0.2)}))
    assert cut.length == pytest.approx(tree.length - 0.08, abs=0.011)
    lower = edited(tree, _edits({"do": "bridge", "at": (0.1, 0, 0.2), "to": (0, 0, 0.1)}))
    np.testing.assert_allclose(lower.nodes[lower.forks()[0]], [0, 0, 0.1], atol=1e-9)
    turned = edited(tree, _edits({"do": "root", "at": (0, 0, 0.4)}))
    np.testing.assert_allclose(turned.nodes[0], [0, 0, 0.4], atol=1e-9)
    assert turned.length == pytest.approx(tree.length)
    moved = edited(tree, _edits({"do": "move", "at": (0, 0, 0.3), "to": (0.01, 0, 0.3)}))
    assert moved.nodes[:, 0].max() == tree.nodes[:, 0].max() and (
        np.abs(moved.nodes - [0.01, 0, 0.3]).sum(axis=1).min() < 1e-9)
    thick = edited(tree, _edits({"do": "radius", "at": (0, 0, 0.3), "radius": 0.01}))
    assert thick.radius.max() == 0.01 and thick.radius_sigma.max() == pytest.approx(2e-4)


def test_edits_outlive_a_new_numbering() -> None:
    """The same list, through JSON, on a tree of other nodes cuts the same branch off."""
    text = EDITS.dump_json(_edits({"do": "delete", "at": (0.1, 0, 0.2)}))
    for count in (41, 81):
        assert edited(_tree(count), EDITS.validate_json(text)).nodes[:, 0].max() < 0.1


def test_edits_that_make_no_tree_are_refused() -> None:
    """Places beside all branches, the root, and circles: which edit, and why."""
    for edit, why in (({"do": "delete", "at": (1.0, 0, 0)}, "on no branch"),
                      ({"do": "delete", "at": (0, 0, 0)}, "root cannot"),
                      ({"do": "bridge", "at": (0, 0, 0.1), "to": (0.1, 0, 0.2)}, "circle")):
        with pytest.raises(InputError, match=rf"Edit 1.*{why}"):
            edited(_tree(), _edits(edit))
