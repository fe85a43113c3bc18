"""Motions of an arm alone: to joint angles past cell and branch, and back from the branch."""

from itertools import pairwise

import numpy as np

from limber.cell.cell_file import Cell
from limber.cell.reach_and_collision import ArmSurroundings
from limber.core.errors import NoPathError
from limber.core.numerics.rigid import inverted, matrices, pose_vectors
from limber.core.numerics.rigid_kernels import length, turn_between
from limber.robot.motion.contact_speed import speed_within
from limber.robot.motion.expected_wrench import ExpectedWrench
from limber.robot.motion.joint_path import joint_path
from limber.robot.motion.joint_planner import joint_space_path
from limber.robot.motion.trajectory import Trajectory, along, along_bounded, densely

_NEAR_M = 0.15  # m from the branch: nearer, the arm is slower
_SLOWEST = 0.25
_AT_GOAL_RAD = 1e-3
_JOINT_SPEED = 0.4  # rad/s: an elbow is as fast as a gripper, and nobody watches it


def is_at(joints: np.ndarray, goal: np.ndarray) -> bool:
    """Whether joint angles [rad, n] are those of a goal."""
    return bool(np.abs(joints - goal).max() < _AT_GOAL_RAD)


def to_joints(cell: Cell, start: np.ndarray, goal: np.ndarray, around: ArmSurroundings,
              ) -> Trajectory:
    """Return the motion from joint angles ``start`` [n] to ``goal`` [n], the gripper empty.

    It keeps clear of cell, branch and the arm itself, and is slow near the branch.

    Raises:
        NoPathError: there is no such path, start or goal collide, or the gripper would leave the
        workspace.
    """
    _require_limits(cell, goal)
    if is_at(start, goal):
        raise NoPathError("The arm is there already.", "", "")
    joints = joint_space_path(start, goal, cell.joint_limits, around.free)
    poses = pose_vectors(cell.arm.forward(joints) @ matrices(np.array(cell.tool.grasp_pose)))
    _require_workspace(cell, poses)
    limits, fastest = cell.limits, speed_within(cell, cell.limits.speed_m_s)
    lengths = np.array([max(length(second[:3] - first[:3]), fastest * max(
        length(turn_between(first, second)) / (0.8 * limits.turn_speed_rad_s),
        float(np.abs(turned).max()) / _JOINT_SPEED))
        for (first, second), turned in zip(pairwise(poses), np.diff(joints, axis=0), strict=True)])
    share = np.clip(around.from_branch(joints) / _NEAR_M, _SLOWEST, 1.0)
    times = along_bounded(lengths, share * fastest, limits.acceleration_m_s2)
    return Trajectory(times, poses, ExpectedWrench.nothing(poses), joints, by_joints=True)


def away_from_branch(cell: Cell, joints: np.ndarray, pose: np.ndarray) -> Trajectory:
    """Return the straight retreat of an open gripper from the branch, opposite to its approach.

    Args:
        joints: Current joint angles [rad], shape [n].
        pose: Pose of the gripper's middle from the controller, base frame [m, rad], shape [6].

    Raises:
        NoPathError: the arm cannot reach so far.
    """
    here = matrices(pose)
    back = here.copy()
    back[:3, 3] -= cell.approach.distance_m * here[:3, :3] @ np.array(cell.approach.direction)
    poses = densely(pose_vectors(np.array([here, back])))
    flange = matrices(poses) @ inverted(matrices(np.array(cell.tool.grasp_pose)))
    taken = joint_path(cell.arm, flange, start=joints, joint_limits=cell.joint_limits,
                       singularity_margin=cell.limits.singularity,
                       joint_margin=cell.limits.joint_margin_rad)
    speed = speed_within(cell, _SLOWEST * cell.limits.speed_m_s)
    times = along(poses, speed, cell.limits.acceleration_m_s2)
    return Trajectory(times, poses, ExpectedWrench.nothing(poses), taken.joints)


def _require_workspace(cell: Cell, poses: np.ndarray) -> None:
    """Refuse poses [n, 6] of the gripper, base frame, at which the guard would stop the arm."""
    if cell.workspace is None:
        return
    grasp = (matrices(np.array(cell.base.pose)) @ matrices(poses))[:, :3, 3]
    outside = np.maximum(np.array(cell.workspace.low_m) - grasp,
                         grasp - np.array(cell.workspace.high_m)).max(axis=1)
    if outside.max() > 1e-3:
        position = ", ".join(f"{value:.3f}" for value in grasp[int(outside.argmax())])
        raise NoPathError(
            f"The gripper would be at ({position}) m in the branch's frame, "
            f"{1e3 * outside.max():.0f} mm outside the workspace.", "The guard would stop it.",
            "Widen [workspace] in the cell file, correct base.pose, or jog the arm inside first.")


def _require_limits(cell: Cell, goal: np.ndarray) -> None:
    """Refuse joint angles [n] beyond the limits."""
    limits = cell.joint_limits
    outside = (goal < limits[:, 0]) | (goal > limits[:, 1])
    if outside.any():
        joint = int(outside.argmax())
        raise NoPathError(f"Joint {joint + 1} ({cell.arm.joint_names[joint]}) would be at "
                          f"{np.degrees(goal[joint]):.0f} degrees, beyond its limit.", "",
                          "Widen robot.joint_limits_rad in the cell file, or choose another goal.")
