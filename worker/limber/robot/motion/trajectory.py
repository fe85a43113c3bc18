"""Poses over time, for the robot to follow, with the wrench that the model expects at each."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import InputError
from limber.core.numerics.rigid import angle_between, matrices, rotations_at
from limber.core.numerics.rigid import turn_between as turns_between
from limber.geometry.rigid_kernels import length, pose_between, turn_between

OVER_HARD = 1.1
"""Largest contact force as a multiple of the hard limit."""

# Time from a force to the brake: half of the sensor's own smoothing, the loop's time, and two steps
# of the controller. Measured with the virtual one: 4 ms at 500 Hz, 14 ms at 125 Hz.
_LOOP_SECONDS = 0.002
_STEPS = 2.0
# Between two readings of an FT300, at most. By USB 62.5 a second were seen, and up to 32 ms between
# two (ros-industrial-attic/robotiq, issue 124): a reading may come a period late. Of the URCap's
# stream of 100 a second no measurement is known; it is taken to be no better.
_FT300_SECONDS = {"ft300": 0.020, "ft300_usb": 0.032}
# The joints brake at 8 rad/s^2; the joint that moves a gripper is rarely nearer than this.
_BRAKING_M_S2 = 8.0 * 0.3
_SLOWEST_M_S = 1e-3


def reaction_seconds(cell: Cell) -> float:
    """Return the longest time from a force to the brake [s]."""
    sensor = _FT300_SECONDS.get(cell.sensor.kind, 0.0)
    return _LOOP_SECONDS + _STEPS / cell.arm.rate + sensor


def contact_speed(cell: Cell) -> float:
    """Return the greatest speed v [m/s] at which a contact of ``limits.contact_n_per_m`` stays
    below the hard limit plus a tenth: braking from the soft limit takes v t + v^2 / 2a. InputError
    if not even a millimetre a second is slow enough."""
    limits = cell.limits
    distance = (OVER_HARD * limits.hard_force_n - limits.soft_force_n) / limits.contact_n_per_m
    lost = _BRAKING_M_S2 * reaction_seconds(cell)
    speed = float(np.sqrt(lost**2 + 2 * _BRAKING_M_S2 * distance) - lost)
    if speed < _SLOWEST_M_S:
        raise InputError(f"A contact of {limits.contact_n_per_m:g} N/m (limits.contact_n_per_m) "
                         "adds more than the force between limits.soft_force_n "
                         f"({limits.soft_force_n:g} N) and limits.hard_force_n "
                         f"({limits.hard_force_n:g} N) even at {1e3 * _SLOWEST_M_S:g} mm/s.",
                         f"The arm needs {1e3 * reaction_seconds(cell):.0f} ms to brake.", "Lower "
                         "limits.soft_force_n, or state in limits.contact_n_per_m how stiff the "
                         "stiffest thing is that the gripper can run into.")
    return speed


def speed_within(cell: Cell, speed: float, warn: Callable[[str], None] | None = None) -> float:
    """Return ``speed`` [m/s], or less, which ``warn`` is told, where a contact requires it;
    InputError as :func:`contact_speed`."""
    most = contact_speed(cell)
    if speed > most and warn is not None:
        limits = cell.limits
        warn(f"The arm moves at {1e3 * most:.1f} mm/s instead of {1e3 * speed:.1f} mm/s, so that "
             f"running into something of {limits.contact_n_per_m:g} N/m stays below "
             f"{OVER_HARD * limits.hard_force_n:.3g} N (limits.hard_force_n plus a tenth). Where "
             "nothing is so stiff, state limits.contact_n_per_m in the cell file to go faster.")
    return min(speed, most)


# The wrench that a model expects along a path: its value, slope and uncertainty. A branch is stiff
# along its axis: a tenth of a millimetre of the gripper's position is newtons there. So the
# expected wrench is that at the gripper's *actual* position: the wrench at the planned pose plus
# the tangent stiffness times the displacement from there. Errors of that displacement (the arm's
# own repeatability, a base that is rotated against its calibration) times the stiffness are errors
# of the wrench. The covariance states them, and the guard and the report allow for it. What is off
# by the same all along the path (the base, how the branch lies in the jaws) stands by itself: it is
# one unknown, not one at each place.

LAID_M = 2e-4
"""Deviation of where a branch lies in the jaws: bark gives way, and readings are a little old."""

@dataclass(frozen=True)
class ExpectedWrench:
    """Wrenches expected of the gripper on the branch along a path, about its middle, branch frame
    [N, N m], [n, 6]; their derivative to position [m] and rotation [rad], [n, 6, 6], and
    covariance; ``rest_pose``: where it closes on the resting branch, base frame [m, rad];
    ``places``: change of the force by one deviation of the base's rotation and of where the branch
    lies in the jaws, [n, 3, 6]; the covariance includes the former."""

    wrenches: np.ndarray
    slopes: np.ndarray
    covariance: np.ndarray
    rest_pose: np.ndarray
    places: np.ndarray

    @classmethod
    def nothing(cls, poses: np.ndarray) -> "ExpectedWrench":
        """Return the wrenches of an empty gripper that passes through ``poses`` [n, 6]."""
        count = len(poses)
        return cls(np.zeros((count, 6)), np.zeros((count, 6, 6)), np.zeros((count, 6, 6)),
                   poses[0], np.zeros((count, 3, 6)))

    def rows(self, chosen: slice) -> "ExpectedWrench":
        """Return the same at some rows."""
        return ExpectedWrench(self.wrenches[chosen], self.slopes[chosen], self.covariance[chosen],
                              self.rest_pose, self.places[chosen])

    def at(self, k: int, part: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return wrench [6], slopes [6, 6], covariance [6, 6] and places [3, 6] between rows k and
        k + 1."""
        return ((1 - part) * self.wrenches[k] + part * self.wrenches[k + 1],
                (1 - part) * self.slopes[k] + part * self.slopes[k + 1],
                (1 - part) * self.covariance[k] + part * self.covariance[k + 1],
                (1 - part) * self.places[k] + part * self.places[k + 1])


@dataclass(frozen=True)
class Predicted:
    """A clamped grasp along a path by the model: poses of the piece from rest on, branch frame [m,
    rad], and wrenches of a rigid gripper [N, N m], [n, 6]; their derivative to the pose, [n, 6, 6],
    and the forces' covariance from Young's modulus, [n, 3, 3]."""

    poses: np.ndarray
    wrenches: np.ndarray
    stiffness: np.ndarray
    young_covariance: np.ndarray

    @classmethod
    def of_forces(cls, poses: np.ndarray, forces: np.ndarray, torques: np.ndarray | None = None,
                  ) -> "Predicted":
        """Return a prediction from forces and torques [n, 3] at poses [n, 6] alone."""
        torques = np.zeros((len(poses), 3)) if torques is None else torques
        return cls(poses, np.hstack([forces, torques]), np.zeros((len(poses), 6, 6)),
                   np.zeros((len(poses), 3, 3)))

    def first(self, count: int) -> "Predicted":
        """Return the prediction at the first ``count`` poses alone."""
        return Predicted(self.poses[:count], self.wrenches[:count], self.stiffness[:count],
                         self.young_covariance[:count])

    def felt(self, cell: Cell, rest_pose: np.ndarray) -> ExpectedWrench:
        """Return the wrench expected at a cell's gripper, which yields a little itself;
        ``rest_pose``: where it closes, base frame [m, rad], shape [6]."""
        count = len(self.poses)
        yielding = np.tile(np.eye(6), (count, 1, 1))
        yielding[:, :, :3] += cell.tool.compliance_m_per_n * self.stiffness[:, :, :3]
        slopes = np.linalg.solve(yielding, self.stiffness)
        wrenches = np.linalg.solve(yielding, self.wrenches[..., None])[..., 0]
        own = np.r_[np.full(3, cell.robot.pose_sigma_m), np.full(3, cell.robot.pose_sigma_rad)]
        base = cell.base.rotation_sigma_rad * slopes @ self._by_base
        covariance = sum(each @ each.transpose(0, 2, 1) for each in (slopes * own, base))
        young = np.zeros((count, 6, 6))
        young[:, :3, :3] = self.young_covariance
        inverse = np.linalg.inv(yielding)
        covariance += inverse @ young @ inverse.transpose(0, 2, 1)
        return ExpectedWrench(wrenches, slopes, covariance, rest_pose,
                              np.concatenate([base, LAID_M * slopes[:, :, :3]], axis=2)[:, :3])

    @property
    def _by_base(self) -> np.ndarray:
        """The gripper's displacement since it closed by the base's rotation, shape [n, 6, 3]."""
        offsets = self.poses[:, :3] - self.poses[0, :3]
        turns = turns_between(self.poses[0, 3:], self.poses[:, 3:])
        return np.concatenate([_crossing(offsets), _crossing(turns)], axis=1)


def interpolated(predicted: Predicted, positions: np.ndarray, query: np.ndarray) -> Predicted:
    """Return a prediction interpolated from ``positions`` [n] along its path to others [m]."""
    def carried(values: np.ndarray) -> np.ndarray:
        flat = values.reshape(len(values), -1)
        return np.column_stack([np.interp(query, positions, column) for column in flat.T]
                               ).reshape(len(query), *values.shape[1:])

    poses = carried(predicted.poses)
    kept = np.r_[True, np.diff(positions) > 0]
    if kept.sum() > 1:
        poses[:, 3:] = rotations_at(positions[kept], predicted.poses[kept, 3:],
                                    np.clip(query, positions[0], positions[-1]))
    return Predicted(poses, carried(predicted.wrenches), carried(predicted.stiffness),
                     carried(predicted.young_covariance))


def _crossing(vectors: np.ndarray) -> np.ndarray:
    """Matrices from a small rotation to the displacement of ``vectors`` [n, 3], [n, 3, 3]."""
    x, y, z = vectors.T
    nothing = np.zeros_like(x)
    return np.stack([np.stack([nothing, z, -y], axis=-1), np.stack([-z, nothing, x], axis=-1),
                     np.stack([y, -x, nothing], axis=-1)], axis=1)


@dataclass(frozen=True)
class Trajectory:
    """Poses of the tool's centre, base frame [m, rad], [n, 6], over ascending times from 0 [s]; the
    branch's expected wrenches, if predicted; joint angles for which each pose was checked [rad].
    ``by_joints``: interpolated in joint space, a path of the arm alone, which may pass
    singularities."""

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
                             f"shape {self.poses.shape}.", "It needs increasing times, each with "
                             "one finite pose.", "Check the path.")
        if self.expected is not None and (
                self.expected.wrenches.shape != self.poses.shape
                or not all(np.isfinite(part).all() for part in (
                    self.expected.wrenches, self.expected.slopes, self.expected.covariance,
                    self.expected.places))):
            raise InputError("The expected wrenches do not match the poses.",
                             "Each pose needs a wrench of six numbers.", "Check the plan.")
        if self.by_joints and self.joints is None:
            raise InputError("A motion by joint angles has none.", "", "Give the angles.")
        if self.joints is not None and (self.joints.shape[:-1] != self.times.shape
                                        or not np.isfinite(self.joints).all()):
            raise InputError(f"The joint angles have shape {self.joints.shape} for "
                             f"{len(self.poses)} poses, or are not finite.", "Each pose needs one "
                             "angle per joint.", "Check the path.")

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

    def felt(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
        """Return expected wrench [6] at a time [s], and more, as :meth:`ExpectedWrench.at`."""
        return None if self.expected is None else self.expected.at(*self._segment_at(time))

    def backwards(self) -> "Trajectory":
        """Return it from its end to its start, at the same speed, with its expected wrench."""
        return self._rows(slice(None, None, -1), self.duration - self.times[::-1])

    def since(self, row: int, times: np.ndarray) -> "Trajectory":
        """Return it from a ``row`` on at ``times`` [n - row] [s]."""
        return self._rows(slice(row, None), times)

    def _rows(self, chosen: slice, times: np.ndarray) -> "Trajectory":
        return Trajectory(times, self.poses[chosen],
                          None if self.expected is None else self.expected.rows(chosen),
                          None if self.joints is None else self.joints[chosen], self.by_joints)

    def _segment_at(self, time: float) -> tuple[int, float]:
        time = min(max(time, 0.0), self.duration)
        k = min(int(np.searchsorted(self.times, time, side="right")) - 1, len(self.times) - 2)
        return k, (time - self.times[k]) / (self.times[k + 1] - self.times[k])


def along(poses: np.ndarray, speed: float, acceleration: float, *, turn_speed: float = 0.5,
          ) -> np.ndarray:
    """Return times [s] at which ``poses`` [n, 6] are passed, from rest to rest, within limits of
    speed [m/s], acceleration [m/s^2] and turn [rad/s]."""
    turns = matrices(poses)[:, :3, :3]
    angles = np.arccos(np.clip((np.einsum("nij,nij->n", turns[1:], turns[:-1]) - 1) / 2, -1, 1))
    steps = np.maximum(np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1),
                       angles * speed / turn_speed)
    return along_bounded(steps, np.full(len(poses), speed), acceleration)


def along_bounded(steps: np.ndarray, speeds: np.ndarray, acceleration: float) -> np.ndarray:
    """Return times [s], shape [n], from rest to rest, of positions ``steps`` [m] apart, [n - 1],
    with greatest speeds [m/s] at them, [n], and acceleration [m/s^2]."""
    steps = np.maximum(steps, 1e-9)
    bound = np.r_[0.0, speeds[1:-1], 0.0]
    for k in range(len(steps)):
        bound[k + 1] = min(bound[k + 1], np.sqrt(bound[k]**2 + 2 * acceleration * steps[k]))
    for k in range(len(steps))[::-1]:
        bound[k] = min(bound[k], np.sqrt(bound[k + 1]**2 + 2 * acceleration * steps[k]))
    # A single step begins and ends at rest, so it must not be passed at zero speed.
    durations = np.where(bound[1:] + bound[:-1] > 0, 2 * steps / np.maximum(
        bound[1:] + bound[:-1], 1e-9), np.maximum(2 * np.sqrt(steps / acceleration),
                                                  2 * steps / np.max(speeds)))
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
