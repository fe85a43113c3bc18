"""Poses over time, for the robot to follow, with the wrench that the model expects at each."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from limber.core.errors import InputError
from limber.core.numerics.rigid import angle_between, matrices
from limber.core.numerics.rigid_kernels import length, pose_between, turn_between
from limber.robot.motion.expected_wrench import ExpectedWrench


@dataclass(frozen=True)
class Trajectory:
    """Poses of the tool over time.

    Attributes:
        times: [s], from 0, ascending, shape [n].
        poses: Poses of the tool's centre, the robot's base frame [m, rad], shape [n, 6].
        expected: Expected wrench of the branch at each pose, or None without a prediction.
        joints: Joint angles for which reach, limits and obstacles were checked at each pose [rad],
            shape [n, joints]; None if nothing was checked.
        by_joints: The motion is interpolated in joint space, and the poses follow from it: a path
            of the arm alone, which may pass singularities.
    """

    times: np.ndarray
    poses: np.ndarray
    expected: ExpectedWrench | None = None
    joints: np.ndarray | None = None
    by_joints: bool = False

    def __post_init__(self) -> None:
        shaped = (self.times.ndim == 1 and len(self.times) >= 2
                  and self.poses.shape == (len(self.times), 6))
        if not shaped or not np.isfinite(self.poses).all() or np.any(np.diff(self.times) <= 0):
            raise InputError(f"The trajectory has times of shape {self.times.shape} and poses of "
                             f"shape {self.poses.shape}.",
                             "It needs increasing times, each with one finite pose.",
                             "Check the path.")
        if self.expected is not None and (
                self.expected.wrenches.shape != self.poses.shape
                or not all(np.isfinite(part).all() for part in (
                    self.expected.wrenches, self.expected.slopes, self.expected.covariance))):
            raise InputError("The expected wrenches do not match the poses.",
                             "Each pose needs a wrench of six numbers.", "Check the plan.")
        if self.by_joints and self.joints is None:
            raise InputError("A motion by joint angles has none.", "", "Give the angles.")
        if self.joints is not None and (self.joints.shape[:-1] != self.times.shape
                                        or not np.isfinite(self.joints).all()):
            raise InputError(f"The joint angles have shape {self.joints.shape} for "
                             f"{len(self.poses)} poses, or are not "
                             "finite.", "Each pose needs one angle per joint.",
                             "Check the path.")

    @property
    def duration(self) -> float:
        return float(self.times[-1])

    @property
    def greatest_speeds(self) -> np.ndarray:
        """Greatest speeds of the tool's centre [m/s] and of its rotation [rad/s], shape [2]."""
        steps = np.diff(self.times)
        lengths = np.linalg.norm(np.diff(self.poses[:, :3], axis=0), axis=1)
        turns = np.array([length(turn_between(first, second))
                          for first, second in pairwise(self.poses)])
        return np.array([(lengths / steps).max(), (turns / steps).max()])

    def pose(self, time: float) -> np.ndarray:
        """Return the pose at a time [s]; the last one afterwards, shape [6]."""
        k, part = self._segment_at(time)
        return pose_between(self.poses[k], self.poses[k + 1], part)

    def angles(self, time: float) -> np.ndarray:
        """Return the joint angles at a time [s]; the last ones afterwards, shape [joints]."""
        assert self.joints is not None
        k, part = self._segment_at(time)
        return (1.0 - part) * self.joints[k] + part * self.joints[k + 1]

    def felt(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Return expected wrench [6], its slopes [6, 6] and covariance [6, 6] at a time [s]."""
        return None if self.expected is None else self.expected.at(*self._segment_at(time))

    def backwards(self) -> "Trajectory":
        """Return it from its end to its start, at the same speed, with its expected wrench."""
        return Trajectory(self.duration - self.times[::-1], self.poses[::-1],
                          None if self.expected is None else self.expected.reversed(),
                          None if self.joints is None else self.joints[::-1], self.by_joints)

    def _segment_at(self, time: float) -> tuple[int, float]:
        time = min(max(time, 0.0), self.duration)
        k = min(int(np.searchsorted(self.times, time, side="right")) - 1, len(self.times) - 2)
        return k, (time - self.times[k]) / (self.times[k + 1] - self.times[k])


def along(poses: np.ndarray, speed: float, acceleration: float, *, turn_speed: float = 0.5,
          pause: float = 0.0) -> np.ndarray:
    """Return times [s] at which ``poses`` [n, 6] are passed, from rest to rest, shape [n].

    Args:
        speed, acceleration: Limits of the tool's centre [m/s], [m/s^2].
        turn_speed: Greatest angular speed [rad/s].
        pause: Time added before the start [s].
    """
    turns = matrices(poses)[:, :3, :3]
    angles = np.arccos(np.clip((np.einsum("nij,nij->n", turns[1:], turns[:-1]) - 1) / 2, -1, 1))
    steps = np.maximum(np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1),
                       angles * speed / turn_speed)
    steps = np.maximum(steps, 1e-9)
    arc = np.r_[0.0, np.cumsum(steps)]
    bound = np.minimum(speed, np.sqrt(2 * acceleration * np.minimum(arc, arc[-1] - arc)))
    if len(steps) == 1:
        # It begins and ends at rest, so it must not be passed at zero speed.
        durations = np.maximum(2 * np.sqrt(steps / acceleration), 2 * steps / speed)
    else:
        durations = 2 * steps / np.maximum(bound[1:] + bound[:-1], 1e-6)
    return pause + np.r_[0.0, np.cumsum(durations)]


def along_bounded(steps: np.ndarray, speeds: np.ndarray, acceleration: float) -> np.ndarray:
    """Return times [s] at which the positions of a path are passed, from rest to rest, shape [n].

    Args:
        steps: Distances between the positions [m], shape [n - 1].
        speeds: Greatest speeds at the positions [m/s], shape [n].
        acceleration: [m/s^2].
    """
    steps = np.maximum(steps, 1e-9)
    bound = np.r_[0.0, speeds[1:-1], 0.0]
    for k in range(len(steps)):
        bound[k + 1] = min(bound[k + 1], np.sqrt(bound[k]**2 + 2 * acceleration * steps[k]))
    for k in range(len(steps))[::-1]:
        bound[k] = min(bound[k], np.sqrt(bound[k + 1]**2 + 2 * acceleration * steps[k]))
    # A single step begins and ends at rest, so it must not be passed at zero speed.
    durations = np.where(bound[1:] + bound[:-1] > 0, 2 * steps / np.maximum(
        bound[1:] + bound[:-1], 1e-9), 2 * np.sqrt(steps / acceleration))
    return np.r_[0.0, np.cumsum(durations)]


def densely(poses: np.ndarray, spacing: float = 0.002, angle: float = 0.02) -> np.ndarray:
    """Return poses close together along straight lines and turns between ``poses`` [n, 6]."""
    result = [poses[0]]
    for first, second in pairwise(poses):
        distance = float(np.linalg.norm(second[:3] - first[:3]))
        turn = float(angle_between(first[3:], second[3:]))
        count = max(int(np.ceil(max(distance / spacing, turn / angle))), 1)
        result += [pose_between(first, second, part) for part in np.linspace(0, 1, count + 1)[1:]]
    return np.array(result)
