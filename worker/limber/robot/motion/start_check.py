"""Checks that an arm is at the start of a motion, in the configuration that was checked.

Several joint poses bring the gripper to the same position, and each of them again with joints a
full turn further. Reach, limits, singularities and obstacles were checked for one of them, so every
motion compares position, rotation and joints. A full turn counts as a difference: the joint is
nearer to its limit, and the cables are wound differently.
"""

from collections.abc import Sequence

import numpy as np

from limber.core.errors import Command, SafetyStop, Text
from limber.core.numerics.rigid_kernels import length, turn_between

POSITION_M = 0.005
ROTATION_RAD = np.radians(2.0)
# Arms differ from their nominal dimensions by some milliradians. Half of the difference between two
# configurations at the usual distance from a singularity (limits.singularity).
JOINT_RAD = 0.05


def require_start(pose: np.ndarray, joints: np.ndarray, start: np.ndarray,
                  start_joints: np.ndarray | None, names: Sequence[str]) -> None:
    """Refuse a motion that starts away from the arm's pose, or in another configuration.

    Args:
        pose: Measured, base frame [m, rad], shape [6].
        joints: Measured [rad], shape [n].
        start: Pose with which the motion begins, shape [6].
        start_joints: Joint angles for which it was checked [rad], shape [n]; None: it was not.
        names: Names of the joints.

    Raises:
        SafetyStop: states the differences, with both values.
    """
    away = length(start[:3] - pose[:3])
    if away > POSITION_M:
        raise SafetyStop(f"The path starts {1000 * away:.1f} mm away from the robot.",
                         f"At most {1000 * POSITION_M:.0f} mm are allowed.",
                         "Move the robot to the start, or plan from its current pose.")
    problems = []
    turn = length(turn_between(start, pose))
    if turn > ROTATION_RAD:
        problems.append(f"the gripper is turned by {np.degrees(turn):.1f} degrees against the "
                        "path's "
                        f"start: its rotation vector is {in_degrees(pose[3:])} degrees instead of "
                        f"{in_degrees(start[3:])}")
    problems += [] if start_joints is None else different_joints(joints, start_joints, names)
    if problems:
        raise SafetyStop(
            "The arm is not in the configuration that the path was checked for: "
            f"{'; '.join(problems)}.",
            "Its links, joints and cables would move where nothing was checked.",
            "Rotate the gripper to the path's start." if start_joints is None else
            Text(f"Move the joints to {in_degrees(start_joints)} degrees. A dry run of ",
                 Command("execute"), " states them as start_joints_rad."))


def different_joints(joints: np.ndarray, expected: np.ndarray, names: Sequence[str]) -> list[str]:
    """Return which joints [rad, n] differ from ``expected``, with both angles in degrees."""
    differences = []
    for number in np.flatnonzero(~(np.abs(joints - expected) <= JOINT_RAD)):
        turns = (joints[number] - expected[number]) / (2 * np.pi)
        whole = round(turns) != 0 and abs(turns - round(turns)) * 2 * np.pi <= JOINT_RAD
        differences.append(f"joint {number + 1} ({names[number]}) is at "
                           f"{np.degrees(joints[number]):.1f} degrees instead of "
                           f"{np.degrees(expected[number]):.1f}"
                           + (" (whole turns apart)" if whole else ""))
    return differences


def in_degrees(angles: np.ndarray) -> str:
    """Return angles [rad] as text, without their unit."""
    return "(" + ", ".join(f"{value:.1f}" for value in np.degrees(angles)) + ")"
