"""A motion begins where the arm stands, in the configuration it was checked for, and goes back."""

import numpy as np
import pytest

from limber.cell.cell_file import Cell
from limber.cell.ur_arms import ARMS
from limber.core.errors import SafetyStop
from limber.core.numerics.rigid import matrices, pose_vectors
from limber.geometry.rigid_kernels import pose_of
from limber.robot.interface import Sample
from limber.robot.motion.retreat import RetreatPath, require_start
from limber.robot.motion.trajectory import ExpectedWrench, Trajectory, along, densely
from limber.stages.pulls.record_path import there_and_back

ARM = ARMS["ur5e"]
JOINTS = np.array(ARM.home)
POSE = pose_of(ARM.forward(JOINTS))


def sample_at(pose: np.ndarray, joints: np.ndarray = JOINTS) -> Sample:
    nothing = np.zeros(6)
    return Sample(1.0, 1.0, joints, nothing, pose, nothing, nothing, 7, 1, 2, 1.0)


def test_where_it_stands_is_where_it_begins():
    require_start(POSE, JOINTS + 0.02, POSE + [0.004, 0, 0, 0.01, 0, 0], JOINTS, ARM.joint_names)
    require_start(POSE, JOINTS, POSE, None, ARM.joint_names)
    with pytest.raises(SafetyStop, match=r"starts 20\.0 mm"):
        require_start(POSE, JOINTS, POSE + [0, 0, 0.02, 0, 0, 0], JOINTS, ARM.joint_names)


def other_branches() -> list[np.ndarray]:
    found = ARM.inverse(ARM.forward(JOINTS))
    return [joints for joints in found if np.isfinite(joints).all()
            and np.abs(np.angle(np.exp(1j * (joints - JOINTS)))).max() > 0.1]


def test_every_other_branch_at_the_same_pose_is_refused_with_both_values():
    branches = other_branches()
    assert len(branches) == 7
    for joints in branches:
        worst = int(np.abs(joints - JOINTS).argmax())
        with pytest.raises(SafetyStop) as stop:
            require_start(POSE, joints, POSE, JOINTS, ARM.joint_names)
        told = str(stop.value)
        assert f"joint {worst + 1} (" in told
        assert f"is at {np.degrees(joints[worst]):.1f} degrees" in told
        assert f"instead of {np.degrees(JOINTS[worst]):.1f}" in told


@pytest.mark.parametrize("joint, name", list(enumerate(
    ("base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3"))))
def test_a_whole_turn_is_another_configuration(joint, name):
    joints = JOINTS.copy()
    joints[joint] += 2 * np.pi
    with pytest.raises(SafetyStop, match=rf"\({name}\).*whole turns apart"):
        require_start(POSE, joints, POSE, JOINTS, ARM.joint_names)


@pytest.mark.parametrize("start_joints", [JOINTS, None])
def test_a_turned_wrist_is_refused_with_both_values(start_joints):
    joints = JOINTS + np.r_[np.zeros(5), np.radians(50)]
    pose = pose_of(ARM.forward(joints))
    with pytest.raises(SafetyStop, match=r"turned by 50\.0 degrees.*rotation vector is \("):
        require_start(pose, joints, POSE, start_joints, ARM.joint_names)


def test_a_recorded_pull_is_checked_for_the_joints_it_begins_with():
    """All its joints, out and back; a way that only another branch carries is refused at once."""
    cell = Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6})
    frames = np.array([matrices(POSE), matrices(POSE + [0, 0.03, 0, 0, 0, 0])])
    pull = there_and_back(cell, frames, speed=0.02, cycles=2, pause=0.1, start=JOINTS)
    assert pull.joints[0] == pytest.approx(JOINTS) and pull.joints[-1] == pytest.approx(JOINTS)
    assert ARM.forward(pull.joints) == pytest.approx(matrices(pull.poses), abs=1e-9)
    own = cell.model_copy(update={"robot": cell.robot.model_copy(update={
        "joint_limits_rad": tuple(zip(JOINTS - 1.0, JOINTS + 1.0, strict=True))})})
    wound = JOINTS + np.r_[2 * np.pi, np.zeros(5)]
    with pytest.raises(SafetyStop, match=r"\(base\).*whole turns apart"):
        there_and_back(own, frames, speed=0.02, cycles=1, pause=0.1, start=wound)
    with pytest.raises(SafetyStop, match=r"\(elbow\) is at"):
        there_and_back(own, frames, speed=0.02, cycles=1, pause=0.1, start=other_branches()[0])


def led(way: RetreatPath, poses: np.ndarray) -> Sample:
    for pose in poses:
        way.note(sample_at(pose))
    return sample_at(poses[-1])


def line(length: float, count: int = 60) -> np.ndarray:
    return POSE + np.linspace(0, 1, count)[:, None] * [0, length, 0, 0, 0, 0]


def test_the_way_back_leads_straight_to_where_it_began():
    """Half as fast as it came; what was pulled out and let back before is not pulled again."""
    out = line(0.05)
    for poses in (out, np.vstack([out, out[::-1], out]), np.vstack([out, out[:20:-1]])):
        way = RetreatPath(ARM.joint_names)
        way.begin(sample_at(POSE), Trajectory(along(poses, 0.03, 0.3), poses))
        here = led(way, poses)
        back = way.from_here(here, 0.3)
        assert back.poses[0] == pytest.approx(here.pose) and back.poses[-1] == pytest.approx(POSE)
        moved = np.diff(back.poses[:, 1])
        assert np.all(moved <= 0)
        assert back.greatest_speeds[0] <= 0.015 * (1 + 1e-6)


def test_a_way_of_a_fraction_of_a_millimetre_is_gone_back():
    """Against something stiff it is tens of newtons; where nothing moved there is no way."""
    for length in (0.0003, 0.0015, 0.003):
        out = line(length)
        way = RetreatPath(ARM.joint_names)
        way.begin(sample_at(POSE), Trajectory(along(out, 0.005, 0.3), out))
        back = way.from_here(led(way, out), 0.3)
        assert back.poses[0] == pytest.approx(out[-1]) and back.poses[-1] == pytest.approx(POSE)
        assert np.all(np.diff(back.poses[:, 1]) < 0)
    with pytest.raises(SafetyStop, match="is at its starting point"):
        way.from_here(sample_at(POSE), 0.3)


def test_legs_with_the_same_branch_held_are_one_way():
    """Stopped while the branch is let back, it goes on back; not out again."""
    out = line(0.05)
    path = Trajectory(along(out, 0.03, 0.3), out, ExpectedWrench.nothing(out))
    way = RetreatPath(ARM.joint_names)
    way.begin(sample_at(POSE), path)
    here = led(way, out)
    way.begin(here, path.backwards())
    back = way.from_here(led(way, out[:20:-1]), 0.3)
    assert np.all(np.diff(back.poses[:, 1]) <= 0) and back.poses[-1] == pytest.approx(POSE)


def test_an_arm_that_left_its_way_does_not_go_back():
    way = RetreatPath(ARM.joint_names)
    with pytest.raises(SafetyStop, match="not followed any path yet"):
        way.from_here(sample_at(POSE), 0.3)
    out = line(0.05)
    way.begin(sample_at(POSE), Trajectory(along(out, 0.03, 0.3), out))
    here = led(way, out)
    with pytest.raises(SafetyStop, match=r"20\.0 mm and 0\.0 degrees away from its path"):
        way.from_here(sample_at(here.pose + [0.02, 0, 0, 0, 0, 0]), 0.3)
    turned = pose_vectors(matrices(here.pose) @ matrices(np.r_[0, 0, 0, 0, 0, 0.5]))
    with pytest.raises(SafetyStop, match=r"28\.6 degrees away from its path"):
        way.from_here(sample_at(turned), 0.3)
    with pytest.raises(SafetyStop, match=r"joint 3 \(elbow\)"):
        way.from_here(sample_at(here.pose, JOINTS - np.r_[0, 0, 1, 0, 0, 0]), 0.3)


def test_a_trajectory_keeps_its_joints_backwards():
    poses = densely(np.array([POSE, POSE + [0, 0.01, 0, 0, 0, 0]]))
    joints = np.linspace(JOINTS, JOINTS + 0.1, len(poses))
    path = Trajectory(along(poses, 0.03, 0.3), poses, joints=joints)
    assert path.backwards().joints == pytest.approx(joints[::-1])
