"""Rigid transforms of arrays."""

from functools import partial

import numpy as np
import pytest

from limber.core.numerics import rigid


def random_poses(count: int) -> np.ndarray:
    return np.random.default_rng(2).uniform(-1.8, 1.8, (count, 6))


def test_poses_and_frames_go_both_ways():
    poses = random_poses(50)
    frames = rigid.matrices(poses)
    assert rigid.pose_vectors(frames) == pytest.approx(poses)
    assert frames @ rigid.inverted(frames) == pytest.approx(np.tile(np.eye(4), (50, 1, 1)))


def test_rotations_follow_each_other_as_their_matrices_do():
    """``composed`` and ``turn_between`` undo each other; points turn as the matrices say."""
    first, second = np.split(random_poses(40)[:, 3:], 2)
    after = rigid.composed(second, first)
    assert rigid.rotation_matrix(after) == pytest.approx(
        rigid.rotation_matrix(second) @ rigid.rotation_matrix(first))
    assert rigid.rotation_matrix(rigid.turn_between(first, after)) == pytest.approx(
        rigid.rotation_matrix(second))
    assert rigid.angle_between(first, after) == pytest.approx(
        rigid.rotation_angle(rigid.rotation_matrix(second)))
    assert rigid.rotated(first, second) == pytest.approx(
        np.einsum("nij,nj->ni", rigid.rotation_matrix(first), second))


def test_rotations_take_the_short_way():
    """Halfway between turns of 0 and 170 degrees about an axis is 85 degrees about it."""
    poses = np.zeros((2, 6))
    poses[1, 3:] = np.radians(170) * np.array([0.6, 0.0, 0.8])
    for middle in (rigid.poses_at(np.array([0.0, 1.0]), poses, np.array([0.5]))[0],
                   rigid.pose_between(poses[0], poses[1], 0.5)):
        assert middle[3:] == pytest.approx(poses[1, 3:] / 2)


def test_one_part_and_many_give_the_same_pose():
    first, second = random_poses(2)
    parts = np.linspace(0, 1, 5)
    assert np.array_equal(rigid.pose_between(first, second, parts),
                          [rigid.pose_between(first, second, part) for part in parts])


def test_rigid_fit_of_a_turned_copy():
    """Kabsch: a turned and shifted cloud comes back, and a mirror image is never used."""
    rng = np.random.default_rng(0)
    points = rng.standard_normal((6, 3))
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    found, shift = rigid.rigid_fit(points, points @ turn.T + [1, 2, 3])
    assert np.allclose(found, turn) and np.allclose(shift, [1, 2, 3])
    mirrored, _ = rigid.rigid_fit(points, points * [1, 1, -1])
    assert np.linalg.det(mirrored) == pytest.approx(1)


def test_principal_axes_of_a_box():
    """Corners of a box: its edges, the longest first, and half their lengths."""
    corners = np.array(np.meshgrid([-1, 1], [-3, 3], [-2, 2])).reshape(3, -1).T + [5.0, 0, 1]
    assert np.abs(rigid.principal_axes(corners)) == pytest.approx(np.eye(3)[[1, 2, 0]])
    assert rigid.spreads(corners) == pytest.approx([3, 2, 1])


def test_a_curve_through_an_arc_has_no_chords():
    """Half-way between points 5 mm apart a straight line runs 6 um inside an arc of 0.5 m."""
    angle = np.arange(0.0, 0.2, 0.01)
    arc = 0.5 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    curve = partial(rigid.curve_through, 0.5 * angle, arc)
    middle = curve(0.5 * angle[4:-4] + 0.0025)
    assert np.abs(np.linalg.norm(middle, axis=1) - 0.5).max() < 1e-6
    np.testing.assert_allclose(curve(0.5 * angle), arc, atol=1e-15)
    between = rigid.curve_through(np.r_[0.0, 0.0, 1.0], arc[[0, 0, 1]], np.r_[0.5])
    np.testing.assert_allclose(between, [(arc[0] + arc[1]) / 2], atol=1e-15)
