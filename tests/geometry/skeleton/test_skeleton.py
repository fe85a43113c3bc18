"""Skeletons: trees, their files, and what is refused."""

import numpy as np
import pytest

from limber.errors import InputError
from limber.geometry.skeleton.control_points import control_points
from limber.geometry.skeleton.files import read_cylinders, read_swc, write_cylinders


def test_runs_orders_and_main_path(y_skeleton):
    """The stem is run 0, the twig run 1 of order 1; the main path ends at the farthest tip."""
    assert y_skeleton.branch_count == 2
    assert y_skeleton.order.max() == 1
    assert len(y_skeleton.forks()) == 1 and len(y_skeleton.tips()) == 2
    np.testing.assert_allclose(y_skeleton.nodes[y_skeleton.main_path()[-1]], [0, 0, 0.5])
    assert (y_skeleton.parent < np.arange(y_skeleton.node_count)).all()


def test_control_points_lie_at_fractions_of_the_main_path(y_skeleton):
    """On a straight stem a fifth of the path is a fifth of its length."""
    stem = y_skeleton.subset(y_skeleton.nodes[:, 0] == 0)
    np.testing.assert_allclose(control_points(stem)[:, 2], [0.1, 0.2, 0.3, 0.4])


def test_swc_round_trip(y_skeleton, tmp_path):
    """What is written is read again, radii and topology too."""
    path = tmp_path / "s.swc"
    y_skeleton.write_swc(path)
    again = read_swc(path)
    np.testing.assert_allclose(again.nodes, y_skeleton.nodes, atol=1e-9)
    np.testing.assert_allclose(again.radius, y_skeleton.radius, rtol=1e-5)
    np.testing.assert_array_equal(again.parent, y_skeleton.parent)


def test_cylinder_csv_round_trip(y_skeleton, tmp_path):
    """A cylinder model keeps the tree; a node's cylinder ends there."""
    path = tmp_path / "s.csv"
    write_cylinders(y_skeleton, path)
    again = read_cylinders(path)
    assert again.branch_count == 2
    assert again.length == pytest.approx(y_skeleton.length, rel=1e-6)


@pytest.mark.parametrize(("lines", "complaint"), [
    ("1 0 0 0 0 1 2\n2 0 0 0 1 1 3\n3 0 0 0 2 1 2\n4 0 0 0 3 1 -1", "cycle"),
    ("1 0 0 0 0 1 -1\n2 0 0 0 1 1 -1", "2 roots"),
    ("1 0 0 0 0 1 -1\n2 0 0 0 1 -0.5 1", "negative"),
    ("1 0 0 0 0 1 -1\n2 0 0 0 x 1 1", "is not a node"),
    ("1 0 0 0 0 1 -1\n2 0 0 0 1 1 7", "not in the file"),
    ("1 0 0 0 0 1 -1\n2 0 nan 0 1 1 1", "not finite"),
    ("# nothing", "no nodes"),
])
def test_broken_skeleton_files_are_named(tmp_path, lines, complaint):
    """Cycles, two roots, negative radii and garbage are refused with the reason."""
    path = tmp_path / "bad.swc"
    path.write_text(lines)
    with pytest.raises(InputError, match=complaint):
        read_swc(path)
