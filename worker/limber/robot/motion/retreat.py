"""An arm's measured path, kept on disk, for a retreat along it."""

import hashlib
import json
import os
import queue
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from limber.cell.cell_file import Cell
from limber.core.errors import Command, InputError, SafetyStop, Text
from limber.core.json_values import json_objects, plain
from limber.geometry.rigid_kernels import length, turn_between
from limber.robot.interface import Sample
from limber.robot.motion.trajectory import Trajectory, along

# Checks that an arm is at the start of a motion, in the configuration that was checked.
#
# Several joint poses bring the gripper to the same position, and each of them again with joints a
# full turn further. Reach, limits, singularities and obstacles were checked for one of them, so
# every motion compares position, rotation and joints. A full turn counts as a difference: the joint
# is nearer to its limit, and the cables are wound differently.

POSITION_M = 0.005
ROTATION_RAD = np.radians(2.0)
# Arms differ from their nominal dimensions by some milliradians. Half of the difference between two
# configurations at the usual distance from a singularity (limits.singularity).
JOINT_RAD = 0.05


def require_start(pose: np.ndarray, joints: np.ndarray, start: np.ndarray,
                  start_joints: np.ndarray | None, names: Sequence[str]) -> None:
    """Refuse a motion that starts away from the arm's measured pose [m, rad], shape [6], base
    frame, or in another configuration than ``start_joints`` [rad], for which it was checked (None:
    it was not); the SafetyStop states both values."""
    away = length(start[:3] - pose[:3])
    if away > POSITION_M:
        raise SafetyStop(f"The path starts {1000 * away:.1f} mm away from the robot.",
                         f"At most {1000 * POSITION_M:.0f} mm are allowed.",
                         "Move the robot to the start, or plan from its current pose.")
    problems = []
    turn = length(turn_between(start, pose))
    if turn > ROTATION_RAD:
        problems.append(f"the gripper is turned by {np.degrees(turn):.1f} degrees against the "
                        f"path's start: its rotation vector is {in_degrees(pose[3:])} degrees "
                        f"instead of {in_degrees(start[3:])}")
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


# An arm's path on disk: a retreat finds it even after the program has crashed.
#
# There is one file per controller, in this user's state folder (``LIMBER_STATE`` names another).
# Each line is a JSON object: the first identifies the arm and tool, the others hold the poses
# passed since, or that the gripper moved. The driver adds to it while the arm moves. After the
# driver is killed, all but the last lines are there.

_FORMAT = 1


@dataclass(frozen=True)
class FollowedPath:
    """A path read from disk: poses of the tool's centre, base frame [m, rad], [n, 6]; joints [rad];
    greatest speeds [m/s], [rad/s]; the last tare's bias, flange frame [N, N m], None if not with
    the cell's payload (`limber robot weigh` tares with another); whether the gripper was last
    closed; its start, seconds since 1970."""

    poses: np.ndarray
    joints: np.ndarray
    speeds: np.ndarray
    bias: np.ndarray | None
    gripper_closed: bool | None
    at: float


def followed_path_file(cell: Cell) -> Path:
    """Return the file of the path of a cell's robot."""
    key = hashlib.sha256(cell.robot.address.encode()).hexdigest()[:16]
    return _state_folder() / "robot-ways" / f"{key}.jsonl"


def log_path() -> Path:
    """Return the log of motions by `limber robot`, one JSON object a line."""
    return _state_folder() / "robot-moves.jsonl"


def read_followed_path(cell: Cell) -> FollowedPath | None:
    """Return the path that the cell's robot followed last, None if unknown; half-written lines are
    ignored, as is a path of another arm or tool."""
    try:
        with open(followed_path_file(cell), encoding="utf-8") as stream:
            lines = list(json_objects(stream))
    except FileNotFoundError:
        return None
    if not lines or lines[0].get("head") != plain(_head(cell)):
        return None
    try:
        pose_lines = [line for line in lines if "pose" in line]
        last = {name: line[name] for line in lines[1:] for name in line}
        if last.get("bias_with") != plain(_payload(cell)):
            last["bias"] = None
        followed = FollowedPath(
            _rows([line["pose"] for line in pose_lines], 6),
            _rows([line["joints"] for line in pose_lines], len(cell.arm.joint_names)),
            np.array(last.get("speeds", (0.0, 0.0)), float),
            None if last.get("bias") is None else np.array(last["bias"], float).reshape(6),
            last.get("gripper_closed"), float(lines[0]["at"]))
    except (KeyError, TypeError, ValueError):
        return None
    whole = all(np.isfinite(part).all() for part
                in (followed.poses, followed.joints, followed.speeds))
    return followed if whole and (followed.bias is None
                                  or np.isfinite(followed.bias).all()) else None


def followed_path(cell: Cell, otherwise: str) -> FollowedPath:
    """Return the path that the cell's robot followed last; the InputError, if none is known, says
    what to do ``otherwise``."""
    followed = read_followed_path(cell)
    if followed is None:
        raise InputError(f"No path that the robot at {cell.robot.address} followed with this arm "
                         "and tool is known.", "It followed none from this account, or the cell "
                         "has changed since.", otherwise)
    return followed


class FollowedPathFile:
    """Writes a path while it is followed, in its own thread: the loop waits for no disk."""

    def __init__(self, cell: Cell):
        self._lasting: dict[str, Any] = {}
        self._path, self._head = followed_path_file(cell), _head(cell)
        self._payload = _payload(cell)
        self._lines: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write, name="way", daemon=True)
        self._thread.start()

    def begin(self) -> None:
        """Begin a new path; the old one is discarded."""
        self._lines.put({"format": _FORMAT, "head": self._head, "at": time.time()})
        self.add(**self._lasting)

    def tared(self, bias: np.ndarray) -> None:
        """The force sensor's bias [6] is known; it holds for later paths."""
        self._lasting |= {"bias": bias.copy(), "bias_with": self._payload}
        self.add(**self._lasting)

    def gripped(self, closed: bool) -> None:
        """The gripper was closed or opened; it stays so for later paths."""
        self._lasting["gripper_closed"] = closed
        self.add(gripper_closed=closed)

    def add(self, **content: Any) -> None:
        """Add new data; returns at once."""
        self._lines.put(content)

    def close(self, seconds: float = 1.0) -> None:
        """Wait until all is written, at most this long."""
        self._lines.put(None)
        self._thread.join(seconds)

    def _write(self) -> None:
        """Write data as it arrives; a disk error ends this, and a retreat then finds less."""
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            while (line := self._lines.get()) is not None:
                with open(self._path, "w" if "head" in line else "a", encoding="utf-8") as stream:
                    stream.write(json.dumps(plain(line)) + "\n")
        except OSError:
            return


def _state_folder() -> Path:
    return Path(os.environ.get("LIMBER_STATE") or platformdirs.user_state_path("limber"))


def _rows(values: list[Any], count: int) -> np.ndarray:
    """Rows of ``count`` numbers; another count is a ValueError."""
    rows = np.array(values, float) if values else np.zeros((0, count))
    if rows.ndim != 2 or rows.shape[1] != count:
        raise ValueError(f"rows of shape {rows.shape}")
    return rows


def _payload(cell: Cell) -> dict[str, Any]:
    """What the controller subtracts from the force, and so what a tare is relative to."""
    return {"mass_kg": cell.tool.mass_kg, "centre_of_mass_m": cell.tool.centre_of_mass_m}


def _head(cell: Cell) -> dict[str, Any]:
    """Arm and tool to which the path belongs: poses are of this arm's tool."""
    return {"address": cell.robot.address, "arm": cell.arm.name, "tool": cell.tool.grasp_pose}


_APART_M, _APART_RAD = 1e-3, 0.005  # between the stored poses
_SAME = 0.3  # fraction of the distance bridged at a start below which two poses are the same
_STANDS = 1e-5  # m and rad, of an arm that does not move
_SLOWER = 0.5
_LEAST_SPEEDS = np.array([1e-3, 1e-2])  # m/s, rad/s


class RetreatPath:
    """Positions of an arm since the gripper closed, or since the motion began, after an earlier
    program's; ``kept`` is called with each, and with the data at the start of a path."""

    def __init__(self, names: Sequence[str], followed: FollowedPath | None = None,
                 kept: FollowedPathFile | None = None) -> None:
        self._names, self._kept = names, kept
        self._poses: list[np.ndarray] = [] if followed is None else list(followed.poses)
        self._joints: list[np.ndarray] = [] if followed is None else list(followed.joints)
        self._speeds = _LEAST_SPEEDS if followed is None else np.maximum(followed.speeds,
                                                                         _LEAST_SPEEDS)
        self._rest: np.ndarray | None = None

    def begin(self, sample: Sample, trajectory: Trajectory) -> None:
        """A trajectory is followed from ``sample`` on. Legs on which one branch is held, from one
        rest pose, are one path."""
        rest = None if trajectory.expected is None else trajectory.expected.rest_pose
        if rest is None or self._rest is None or np.abs(rest - self._rest).max() > 0:
            self._poses, self._joints, self._speeds = [], [], _LEAST_SPEEDS
            if self._kept is not None:
                self._kept.begin()
        self._rest = rest
        self._speeds = np.maximum(self._speeds, trajectory.greatest_speeds)
        if self._kept is not None:
            self._kept.add(speeds=self._speeds)
        self._keep(sample)

    def note(self, sample: Sample) -> None:
        """The arm was followed to ``sample``; it is kept if the arm moved."""
        last = self._poses[-1]
        if (length(sample.pose[:3] - last[:3]) > _APART_M
                or length(turn_between(last, sample.pose)) > _APART_RAD):
            self._keep(sample)

    def _keep(self, sample: Sample) -> None:
        self._poses.append(sample.pose.copy())
        self._joints.append(sample.joints.copy())
        if self._kept is not None:
            self._kept.add(pose=self._poses[-1], joints=self._joints[-1])

    def from_here(self, sample: Sample, acceleration: float) -> Trajectory:
        """Return the path from ``sample`` back to its start at half the first speed, braking with
        ``acceleration`` [m/s^2], without what lies between two visits: a pull stopped on its return
        is not pulled out again. SafetyStop without a path back, off it, or in another
        configuration."""
        if not self._poses:
            raise SafetyStop("There is no path to return along.", "The robot has not followed any "
                             "path yet.", "")
        poses = np.array(self._poses)
        off = np.linalg.norm(poses[:, :3] - sample.pose[:3], axis=1) / POSITION_M
        # Rotations of the near poses only: a long path has many, and the watchdog waits.
        for number in np.flatnonzero(off <= max(1.0, float(off.min()))):
            turn = length(turn_between(poses[number], sample.pose)) / ROTATION_RAD
            off[number] = max(off[number], turn)
        nearest = int(off.argmin())
        if off[nearest] > 1.0:
            away = length(sample.pose[:3] - poses[nearest, :3])
            turn = np.degrees(length(turn_between(poses[nearest], sample.pose)))
            raise SafetyStop(f"The arm is {1000 * away:.1f} mm and {turn:.1f} degrees away from "
                             "its path.", "Something has moved it.", "Free the branch by hand.")
        if difference := different_joints(sample.joints, self._joints[nearest], self._names):
            raise SafetyStop("The arm is not in the configuration in which it arrived: "
                             f"{'; '.join(difference)}.",
                             "Something has moved it.", "Free the branch by hand.")
        if length(sample.pose - poses[0]) < _STANDS:
            raise SafetyStop("There is no path to return "
                             "along.", "The arm is at its starting point.", "")
        # At least to the start: against a stiff object even a fraction of a millimetre is a path.
        first = max(_first_time(off), 1)
        back = np.vstack([sample.pose, poses[:first][::-1]])
        joints = np.vstack([sample.joints, np.array(self._joints[:first])[::-1]])
        speed, turn_speed = _SLOWER * self._speeds
        times = along(back, speed, acceleration, turn_speed=turn_speed)
        return Trajectory(times, back, joints=joints)


def _first_time(off: np.ndarray) -> int:
    """Return the nearest position of a path at its first pass here, from its distances [n]."""
    near = off <= off.min() + _SAME
    begin = int(near.argmax())
    gone = np.flatnonzero(~near[begin:])
    end = begin + int(gone[0]) if len(gone) else len(off)
    return begin + int(off[begin:end].argmin())
