"""An arm's measured path, for a retreat along it."""

from collections.abc import Sequence

import numpy as np

from limber.core.errors import SafetyStop
from limber.core.numerics.rigid_kernels import length, turn_between
from limber.robot.interface import Sample
from limber.robot.motion.followed_path import FollowedPath, FollowedPathFile
from limber.robot.motion.start_check import POSITION_M, ROTATION_RAD, different_joints
from limber.robot.motion.trajectory import Trajectory, along

_APART_M, _APART_RAD = 1e-3, 0.005  # between the stored poses
_SAME = 0.3  # fraction of the distance bridged at a start below which two poses are the same
_STANDS = 1e-5  # m and rad, of an arm that does not move
_SLOWER = 0.5
_LEAST_SPEEDS = np.array([1e-3, 1e-2])  # m/s, rad/s


class RetreatPath:
    """Positions of an arm since the gripper closed, or since the motion began.

    Args:
        names: Names of the arm's joints.
        followed: The path of an earlier program, to begin with.
        kept: Called with each position that is kept, and with the data at the start of a path.
    """

    def __init__(self, names: Sequence[str], followed: FollowedPath | None = None,
                 kept: FollowedPathFile | None = None) -> None:
        self._names, self._kept = names, kept
        self._poses: list[np.ndarray] = [] if followed is None else list(followed.poses)
        self._joints: list[np.ndarray] = [] if followed is None else list(followed.joints)
        self._speeds = _LEAST_SPEEDS if followed is None else np.maximum(followed.speeds,
                                                                         _LEAST_SPEEDS)
        self._rest: np.ndarray | None = None

    def begin(self, sample: Sample, trajectory: Trajectory, *, goes_on: bool = False) -> None:
        """A trajectory is followed from ``sample`` on.

        Legs on which the same branch is held, from the same rest pose, are one path.

        Args:
            goes_on: So is this leg with the path of an earlier program.
        """
        rest = None if trajectory.expected is None else trajectory.expected.rest_pose
        goes_on = goes_on and bool(self._poses)
        if not goes_on and (
                rest is None or self._rest is None or np.abs(rest - self._rest).max() > 0):
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
        """Return the path from ``sample`` back to its start, at half the speed of the first pass.

        The part between the first and the last time that the arm was here is omitted: a pull that
        was stopped on its own return is not pulled out again.

        Args:
            acceleration: [m/s^2].

        Raises:
            SafetyStop: there is no path back, the arm left it, or is in another configuration.
        """
        if not self._poses:
            raise SafetyStop("There is no path to return along.", "The robot has not followed any "
                                                                  "path yet.",
                             "")
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
                             "its path.", "Something has moved it.",
                             "Free the branch by hand.")
        if difference := different_joints(sample.joints, self._joints[nearest],
                                         self._names):
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
