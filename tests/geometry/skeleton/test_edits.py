"""A user's edits: applied by place, in order, to whatever the next reconstruction found."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tests.subjects.grown import grown

from limber.core.alignment import Alignment
from limber.core.errors import InputError
from limber.core.json_values import validated
from limber.geometry.skeleton.edits import Edit, edited, edits_text, effects_of, read_edits
from limber.geometry.skeleton.skeleton import BRIDGED, Skeleton


def _tree(count: int = 41) -> Skeleton:
    """A stem of 0.4 m along z with a twig along x at 0.2 m; as finely divided as asked."""
    return grown((-1, (0, 0, 0), (0, 0, 0.4), count, 0.008),
                 (count // 2, (0, 0, 0.2), (0.15, 0, 0.2), 16, 0.004))


def _edits(*edits: dict):
    return validated(list[Edit], list(edits))


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


def test_an_edit_says_which_node_it_took_and_what_it_removed() -> None:
    tree = _tree()
    cut, moved = effects_of(tree, _edits({"do": "delete", "at": (0.084, 0, 0.2)},
                                         {"do": "move", "at": (0, 0, 0.4), "to": (0, 0, 0.42)}),
                            [])
    np.testing.assert_allclose(cut.node, [0.08, 0, 0.2], atol=1e-9)
    assert cut.distance == pytest.approx(4e-3) and cut.length_change == pytest.approx(-0.08)
    assert moved.distance == pytest.approx(0.0) and moved.length_change == pytest.approx(0.02)


def test_branches_are_merged_split_and_confirmed() -> None:
    """A strand beside its carrier goes and its rest stays; a cut off part hangs elsewhere."""
    tree = _tree()
    merged = edited(tree, _edits({"do": "merge", "at": (0.05, 0, 0.2), "to": (0, 0, 0.3)}))
    assert merged.branch_count == 2 and merged.node_count == tree.node_count - 5
    np.testing.assert_allclose(merged.nodes[merged.forks()[0]], [0, 0, 0.3], atol=1e-9)
    split = edited(tree, _edits({"do": "split", "at": (0, 0, 0.3), "to": (0.15, 0, 0.2)}))
    way = np.hypot(0.15, 0.1)
    assert split.length == pytest.approx(tree.length - 0.01 + way)
    bridged = split.radius_state == BRIDGED
    assert bridged.sum() == int(way / 0.016) and split.radius[bridged] == pytest.approx(0.008)
    doubted = replace(tree, probability=np.where(tree.branch == 1, 0.3, 0.9))
    sure = edited(doubted, _edits({"do": "confirm", "at": (0.1, 0, 0.2)}))
    assert (sure.probability[sure.branch == 1] == 1).all()
    assert sure.probability[0] == 1 and sure.probability[sure.nodes[:, 2] > 0.35].max() == 0.9


def test_a_radius_is_set_all_along_the_axes_between_two_places() -> None:
    """From the twig over the fork to the stem, and nowhere else."""
    tree = _tree()
    thick = edited(tree, _edits({"do": "radius", "at": (0.05, 0, 0.2), "to": (0, 0, 0.15),
                                 "radius": 0.007}))
    chosen = np.flatnonzero(thick.radius == 0.007)
    assert len(chosen) == 5 + 6 and thick.nodes[chosen, 2].min() == pytest.approx(0.15)


def test_a_misfit_leaves_the_other_edits() -> None:
    """Applied to a new reconstruction: what no longer fits is told by number and left out."""
    misfits: list[str] = []
    edits = _edits({"do": "delete", "at": (1.0, 0, 0)}, {"do": "delete", "at": (0.1, 0, 0.2)})
    assert edited(_tree(), edits, misfits).nodes[:, 0].max() < 0.1
    assert len(misfits) == 1 and misfits[0].startswith("Edit 1 (delete)")


def test_edits_are_in_the_files_coordinates() -> None:
    """Millimetres, map coordinates and a turn are taken from places and radii."""
    alignment = Alignment(scale=1e-3, origin=(500.0, 20.0, 1.0),
                          rotation=((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    at = alignment.undo(np.array([[0.01, 0.02, 0.3]]))[0]
    edit, = _edits({"do": "radius", "at": tuple(at), "to": tuple(at), "radius": 12.0})
    moved = edit.aligned(alignment)
    np.testing.assert_allclose([moved.at, moved.to], 2 * [[0.01, 0.02, 0.3]], atol=1e-9)
    assert moved.radius == pytest.approx(0.012)


def test_a_file_of_edits_is_read_or_its_fault_told(tmp_path) -> None:
    """Text and back; no JSON, an unknown word, a missing place: which edit and what."""
    path = tmp_path / "edits.json"
    edits = _edits({"do": "root", "at": (0, 0, 0.4)}, {"do": "delete", "at": (0.1, 0, 0.2)})
    path.write_text(edits_text(edits))
    assert read_edits(path) == edits
    for text, told in (("{", "JSON"), ('[{"do": "cut", "at": [0, 0, 0]}]',
                                       "edit 1: it must be add, .* or confirm, not 'cut'"),
                       ('[{"do": "move", "at": [0, 0, 0]}]', "edit 1: move.to: it is missing"),
                       ('[{"do": "root", "at": [0, 0, NaN]}]', "edit 1|JSON")):
        path.write_text(text)
        with pytest.raises(InputError, match=told):
            read_edits(path)


def test_edits_outlive_a_new_numbering() -> None:
    """The same list, through JSON, on a tree of other nodes cuts the same branch off."""
    text = edits_text(_edits({"do": "delete", "at": (0.1, 0, 0.2)}))
    for count in (41, 81):
        cut = edited(_tree(count), validated(list[Edit], json.loads(text)))
        assert cut.nodes[:, 0].max() < 0.1


def test_edits_that_make_no_tree_are_refused() -> None:
    """Places beside all branches, the root, and circles: which edit, and why."""
    for edit, why in (({"do": "delete", "at": (1.0, 0, 0)}, "not belong to any branch"),
                      ({"do": "delete", "at": (0, 0, 0)}, "root cannot"),
                      ({"do": "bridge", "at": (0, 0, 0.1), "to": (0.1, 0, 0.2)}, "cycle")):
        with pytest.raises(InputError, match=rf"Edit 1.*{why}"):
            edited(_tree(), _edits(edit))
