"""Skeletons: trees, their files, and what is refused."""

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.io.skeletons import read_cylinders, read_swc, write_cylinders
from limber.geometry.skeleton.repair import attached
from limber.geometry.skeleton.skeleton import Skeleton, control_points


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
    ("1 0 0 0 0 1 -1\n2 0 0 0 1 1 -1", "2 trees"),
    ("1 0 0 0 0 1 -1\n2 0 0 0 1 -0.5 1", "negative"),
    ("1 0 0 0 0 1 -1\n2 0 0 0 x 1 1", "is not a node"),
    ("1 0 0 0 0 1 -1\n2 0 0 0 1 1 7", "not exist in the file"),
    ("1 0 0 0 0 1 -1\n2 0 nan 0 1 1 1", "not finite"),
    ("# nothing", "no nodes"),
])
def test_broken_skeleton_files_are_named(tmp_path, lines, complaint):
    """Cycles, two roots, negative radii and garbage are refused with the reason."""
    path = tmp_path / "bad.swc"
    path.write_text(lines)
    with pytest.raises(InputError, match=complaint):
        read_swc(path)


def test_a_twig_that_hangs_on_a_long_way_across_is_led_back_along_its_own_axis() -> None:
    """Where the scan lacks a twig's base, it does not start at a right angle far from its fork."""
    way = np.array([0.5, 0.0, np.sqrt(0.75)])
    carrier = np.stack([np.zeros(80), np.zeros(80), 0.005 * np.arange(80)], axis=1)
    begin = np.array([0.0, 0.0, 0.1]) + 0.07 * way
    across = np.stack([np.arange(1, 7) * begin[0] / 7, np.zeros(6), np.full(6, begin[2])], axis=1)
    own = begin + 0.005 * np.arange(30)[:, None] * way
    hangs = int(np.argmin(np.abs(carrier[:, 2] - begin[2])))
    parent = np.concatenate([np.arange(80) - 1, [hangs], 80 + np.arange(35)])
    skeleton = Skeleton.from_edges(np.vstack([carrier, across, own]), parent,
                                   np.concatenate([np.full(80, 0.007), np.full(36, 0.003)]))
    mended = attached(skeleton)
    fork = mended.nodes[mended.forks()]
    assert len(fork) == 1 and abs(fork[0, 2] - 0.1) < 0.01
    first = mended.nodes[mended.runs()[1][1]] - fork[0]
    assert first @ way > np.cos(np.deg2rad(15)) * np.linalg.norm(first)


def test_a_twig_hangs_where_its_line_leads_back_to_not_ahead() -> None:
    """Its first nodes are a hair's, a millimetre apart, and lean towards the stem: followed ahead,
    their line meets that farther out."""
    z = np.arange(0, 0.4, 0.005)
    hook = [[0.01, 0, 0.172], [0.02, 0, 0.17]]
    lean = hook[-1] + np.outer(np.arange(1, 7), [-0.0003, 0, 0.00095])
    out = lean[-1] + np.outer(np.arange(1, 80), [0.0003, 0, 0.00095])
    nodes = np.vstack([np.stack([0 * z, 0 * z, z], axis=1), hook, lean, out])
    parent = np.concatenate([np.arange(80) - 1, [34], np.arange(80, len(nodes) - 1)])
    skeleton = Skeleton.from_edges(nodes, parent, np.where(np.arange(len(nodes)) < 80, 0.008, 1e-3))
    mended = attached(skeleton)
    fork = mended.forks()
    assert len(fork) == 1 and 0.08 < mended.nodes[fork[0], 2] < 0.18
