"""The legs of a robot's whole motion at a branch, in the order in which they are executed."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from limber.cell.cell_file import Cell
from limber.robot.motion.execution import RobotMotion
from limber.robot.motion.trajectory import Trajectory

HELD = ("path", "hold", "return")
"""Names of the legs during which the gripper holds the branch."""


@dataclass(frozen=True)
class Leg:
    """One part of the motion.

    Attributes:
        name: ``approach``, ``grasp``, ``path``, ``hold``, ``return``, ``release`` or ``leaving``.
        duration: [s].
        trajectory: The gripper's motion; None: it stands still, and opens, closes or holds.
    """

    name: str
    duration: float
    trajectory: Trajectory | None = None


def legs_of(cell: Cell, motion: RobotMotion, hold: float) -> list[Leg]:
    """Return the legs of a motion that waits ``hold`` [s] at the path's end."""
    grip = cell.tool.grip_seconds
    moves = {"approach": motion.approach, "path": motion.path, "return": motion.return_path,
             "leaving": motion.leaving}
    stands = {"grasp": grip, "hold": hold, "release": grip}
    names = ("approach", "grasp", "path", "hold", "return", "release", "leaving")
    return [Leg(name, moves[name].duration, moves[name]) if name in moves
            else Leg(name, stands[name]) for name in names]


def described(legs: Sequence[Leg], cell: Cell) -> list[dict[str, Any]]:
    """Return each leg's times, length, speeds and largest load on the branch, as plain data."""
    found, begin, last = [], 0.0, (0.0, 0.0)
    for leg in legs:
        moved = leg.trajectory
        loads = last if leg.name == "hold" else (0.0, 0.0)
        row: dict[str, Any] = {"name": leg.name, "start_s": begin, "duration_s": leg.duration,
                               "length_m": 0.0, "peak_speed_m_s": 0.0,
                               "peak_turn_speed_rad_s": 0.0, "joint_speed_share": 0.0}
        if moved is not None:
            speed, turning = moved.greatest_speeds
            row |= {"length_m": float(np.linalg.norm(
                        np.diff(moved.poses[:, :3], axis=0), axis=1).sum()),
                    "peak_speed_m_s": float(speed), "peak_turn_speed_rad_s": float(turning),
                    "joint_speed_share": _joint_speed_share(moved, cell)}
        if moved is not None and moved.expected is not None and leg.name in HELD:
            wrenches = moved.expected.wrenches
            force, torque = (np.linalg.norm(part, axis=1)
                             for part in (wrenches[:, :3], wrenches[:, 3:]))
            loads, last = (float(force.max()), float(torque.max())), (
                float(force[-1]), float(torque[-1]))
        found.append(row | {"peak_force_n": loads[0], "peak_torque_nm": loads[1]})
        begin += leg.duration
    return found


def _joint_speed_share(moved: Trajectory, cell: Cell) -> float | None:
    """Return the largest joint speed over the joint's limit; None without joint angles."""
    if moved.joints is None:
        return None
    speeds = np.abs(np.diff(moved.joints, axis=0)) / np.diff(moved.times)[:, None]
    return float((speeds / np.asarray(cell.arm.joint_speed)).max(initial=0.0))
