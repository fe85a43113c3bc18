"""Kinematics against an independent library, finite differences and itself."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from limber.cell.known_arms import arm_named
from limber.cell.ur_arms import ARMS
from limber.core.errors import InputError, NoPathError
from limber.robot.motion.joint_path import follow, joint_path


def random_joints(count: int, seed: int = 11) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (count, 6))


def turns_apart(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.abs((first - second + np.pi) % (2 * np.pi) - np.pi).max(axis=-1)


def test_link_frames_are_products_of_the_table_s(name="ur10e"):
    """Denavit and Hartenberg's plain form: turn and shift along z, then along x."""
    arm, joints = ARMS[name], random_joints(5)
    expected = np.zeros((5, 6, 4, 4))
    for frames, row in zip(expected, joints, strict=True):
        frame = np.eye(4)
        for k, (angle, (d, a, twist)) in enumerate(zip(row, arm.table, strict=True)):
            along_z, along_x = np.eye(4), np.eye(4)
            along_z[:3, :3] = Rotation.from_rotvec([0, 0, angle]).as_matrix()
            along_x[:3, :3] = Rotation.from_rotvec([twist, 0, 0]).as_matrix()
            along_z[2, 3], along_x[0, 3] = d, a
            frame = frame @ along_z @ along_x
            frames[k] = frame
    np.testing.assert_allclose(arm.link_frames(joints), expected, atol=1e-15)


@pytest.mark.parametrize("name", sorted(ARMS))
def test_forward_and_every_inverse_branch_as_an_independent_library(name):
    """1,430 poses an arm, over 10,000 in all: to 1e-9 m, and no branch missing."""
    library = getattr(pytest.importorskip("ur_analytic_ik"), name)
    arm = ARMS[name]
    joints = random_joints(1430)
    frames = arm.forward(joints)
    theirs = np.array([library.forward_kinematics(*row) for row in joints])
    assert np.abs(frames - theirs).max() < 1e-12

    solutions = arm.inverse(frames)
    exist = np.isfinite(solutions).all(axis=-1)
    again = arm.forward(np.nan_to_num(solutions))
    assert np.abs(again - frames[:, None])[exist].max() < 1e-9
    assert np.nanmin(turns_apart(solutions, joints[:, None]), axis=1).max() < 1e-7
    for row in range(0, len(joints), 10):
        for other in library.inverse_kinematics(frames[row]):
            assert np.nanmin(turns_apart(solutions[row], np.asarray(other))) < 1e-6
        assert exist[row].sum() == len(library.inverse_kinematics(frames[row]))


@pytest.mark.parametrize("name", ["ur5", "ur10e"])
def test_jacobian_is_the_slope_of_forward(name):
    arm = ARMS[name]
    for joints in random_joints(20):
        slopes, step = arm.jacobian(joints), 1e-6
        for k in range(6):
            moved = np.tile(joints, (2, 1))
            moved[:, k] += (-step, step)
            low, high = arm.forward(moved)
            turn = Rotation.from_matrix(high[:3, :3] @ low[:3, :3].T).as_rotvec()
            by_difference = np.concatenate([high[:3, 3] - low[:3, 3], turn]) / (2 * step)
            assert slopes[:, k] == pytest.approx(by_difference, abs=1e-8)


@pytest.mark.parametrize("name", sorted(ARMS))
def test_singularity_factors_multiply_to_the_determinant(name):
    """det J is the product of the three distances, times a constant of the arm."""
    arm = ARMS[name]
    joints = random_joints(50)
    ratio = np.abs(np.linalg.det(arm.jacobian(joints))) / arm.singularity_distance(
        joints).prod(axis=-1)
    assert ratio == pytest.approx(np.full(50, abs(arm.a[1] * arm.a[2]) * arm.reach), rel=1e-9)


@given(st.floats(-1e-7, 1e-7), st.sampled_from([0.0, np.pi]), st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_inverse_keeps_its_digits_near_the_wrist_singularity(near, side, seed):
    """Where joints 4 and 6 are almost parallel the flange still comes to 1e-9 m."""
    arm = ARMS["ur5e"]
    joints = random_joints(1, seed)[0]
    joints[4] = side + near
    frame = arm.forward(joints)
    solutions = arm.inverse(frame, joints)
    exist = np.isfinite(solutions).all(axis=-1)
    assert exist.any()
    assert np.abs(arm.forward(solutions[exist]) - frame).max() < 1e-8
    assert np.abs(arm.forward(solutions[exist])[..., :3, 3] - frame[:3, 3]).max() < 1e-9


def test_out_of_reach_has_no_solution():
    frame = np.eye(4)
    frame[0, 3] = 3.0
    assert np.isnan(ARMS["ur5"].inverse(frame)).all()


def straight_path(arm, joints: np.ndarray, way: np.ndarray, count: int = 60) -> np.ndarray:
    frames = np.tile(arm.forward(joints), (count, 1, 1))
    frames[:, :3, 3] += np.linspace(0, 1, count)[:, None] * way
    return frames


def test_a_followed_branch_is_continuous_and_on_the_path():
    arm = ARMS["ur5e"]
    frames = straight_path(arm, np.array([3.1, -1.4, 1.6, -1.8, -1.5, 3.0]), np.array([0, 0.2, 0]))
    paths, refusals = follow(arm, frames)
    assert len(paths) + len(refusals) == 8 and paths
    for path in paths:
        assert np.abs(arm.forward(path.joints) - frames).max() < 1e-9
        assert np.abs(np.diff(path.joints, axis=0)).max() < 0.1
        assert path.limit_margin >= 0.05 and path.singularity >= 0.05
    assert paths[0].singularity == max(path.singularity for path in paths)


def test_a_path_starts_on_the_branch_where_the_robot_is():
    """Also where the robot stands a whole turn away: it does not turn back first."""
    arm = ARMS["ur5e"]
    start = np.array([0.6, -1.4, 1.6, -1.8, -1.5, 1.0])
    frames = straight_path(arm, start, np.array([0.1, 0.0, 0.05]))
    for turned in (start, start + [0, 0, 0, 0, 0, -2 * np.pi]):
        path = joint_path(arm, frames, start=turned)
        assert path.joints[0] == pytest.approx(turned, abs=1e-9)


def test_a_path_out_of_reach_says_where_it_ends():
    arm = ARMS["ur3"]
    frames = straight_path(arm, np.array([0.1, -1.4, 1.6, -1.8, -1.5, 1.0]), np.array([2.0, 0, 0]))
    with pytest.raises(NoPathError, match=r"ends at pose \d+ of 60.*(reach|singularity)"):
        joint_path(arm, frames)


def test_a_jump_between_poses_is_not_followed():
    arm = ARMS["ur5e"]
    joints = np.array([0.1, -1.4, 1.6, -1.8, -1.5, 1.0])
    frames = arm.forward(np.array([joints, joints + [1.0, 0, 0, 0, 0, 0]]))
    with pytest.raises(NoPathError, match="jumps"):
        joint_path(arm, frames)


def test_narrow_joint_limits_refuse():
    arm = ARMS["ur5e"]
    joints = np.array([0.1, -1.4, 1.6, -1.8, -1.5, 1.0])
    frames = straight_path(arm, joints, np.array([0.05, 0, 0]))
    narrow = np.tile([-0.1, 0.1], (6, 1))
    with pytest.raises(NoPathError, match="limit"):
        joint_path(arm, frames, joint_limits=narrow)


def test_unknown_arm_is_refused():
    with pytest.raises(InputError, match="known arms are ur3,"):
        arm_named("ur7")
    assert arm_named("UR-10e").name == "ur10e"
