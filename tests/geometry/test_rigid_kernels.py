"""Rigid transforms of one pose at a time, against those of arrays."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from limber.core.constants import STANDARD_GRAVITY
from limber.core.numerics import rigid
from limber.geometry import rigid_kernels


def test_they_are_those_of_arrays():
    poses = np.random.default_rng(2).uniform(-1.8, 1.8, (600, 6))
    for pose, other in zip(*np.split(poses, 2), strict=True):
        frame = rigid_kernels.frame_of(pose)
        assert frame == pytest.approx(rigid.matrices(pose), abs=1e-14)
        assert rigid_kernels.pose_of(frame) == pytest.approx(pose, abs=1e-9)
        assert rigid_kernels.inverse_of(frame) @ frame == pytest.approx(np.eye(4), abs=1e-13)
        middle = rigid_kernels.frame_of(rigid_kernels.pose_between(pose, other, 0.3))
        assert middle == pytest.approx(
            rigid.matrices(rigid.pose_between(pose, other, 0.3)), abs=1e-12)
    for angle in (0.0, 1e-12, np.pi - 1e-9, np.pi):
        turn = Rotation.from_rotvec(angle * np.array([0.6, 0.0, 0.8])).as_matrix()
        back = rigid_kernels.rotation_vector(turn)
        assert rigid.rotation_matrix(back) == pytest.approx(turn, abs=1e-9)


def test_wrenches_are_those_of_the_formulas():
    rng = np.random.default_rng(3)
    turn, centre, force, moment, lever = Rotation.random(random_state=4).as_matrix(), *rng.normal(
        size=(4, 3))
    wrench = np.concatenate([force, moment])
    weight = turn.T @ [0.0, 0.0, -2.0 * STANDARD_GRAVITY]
    assert rigid_kernels.weight_wrench(2.0, centre, turn) == pytest.approx(
        np.concatenate([weight, np.cross(centre, weight)]))
    assert rigid_kernels.turned_wrench(turn, wrench, lever) == pytest.approx(np.concatenate(
        [turn @ force, turn @ moment + np.cross(lever, turn @ force)]))
    assert rigid_kernels.length(force) == pytest.approx(np.linalg.norm(force))


def test_arrays_of_any_strides_and_numbers_are_read():
    """Parts of others, of another order, lists, whole numbers, and what came from a process."""
    frame = rigid.matrices(np.arange(1.0, 7.0))
    wide = np.zeros((8, 8))
    wide[::2, ::2] = frame
    unpickled = frame.astype(np.dtype(float).newbyteorder().newbyteorder())
    for same in (wide[::2, ::2], np.asfortranarray(frame), frame.tolist(), unpickled,
                 frame.astype(">f8")):
        assert np.array_equal(rigid_kernels.inverse_of(same), rigid_kernels.inverse_of(frame))
    assert np.array_equal(rigid_kernels.crossed([1, 0, 0], np.array([0, 1, 0])), [0, 0, 1])
    for wrong in (frame[:3], np.eye(3), frame[0], 1.0, np.zeros((4, 4, 1))):
        with pytest.raises(TypeError, match="inverse_of wants frame"):
            rigid_kernels.inverse_of(wrong)
