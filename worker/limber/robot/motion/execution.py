"""A planned path as motion of a robot: joints, times, expected wrenches, approach and return."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from limber.cell.cell_file import Cell
from limber.cell.reach_and_collision import Blocked
from limber.core.errors import InputError, NoPathError, Option
from limber.core.numerics.rigid import (
    composed,
    curve_through,
    inverted,
    matrices,
    pose_vectors,
    rotated,
    rotation_vector,
)
from limber.robot.motion.joint_path import JointPath, follow, no_branch
from limber.robot.motion.trajectory import (
    ExpectedWrench,
    Predicted,
    Trajectory,
    along,
    densely,
    interpolated,
    speed_within,
)

_WITHIN = 7.815  # chi-squared: 95 % of a vector's draws
_TURNS = 12  # directions around the branch from which the gripper may come
_MOST_TRIED = 24  # variants of the path checked against obstacles


@dataclass(frozen=True)
class RobotMotion:
    """A robot's motion that takes a branch along a path, as poses of the gripper's middle in the
    base's frame: approach from a start before the branch, path with the branch held, joint angles
    of both on one continuous branch, and the gripper's rotation at the grasp, branch frame
    [rad]."""

    approach: Trajectory
    path: Trajectory
    joints: JointPath
    rotation: np.ndarray

    @property
    def return_path(self) -> Trajectory:
        """The path reversed, with the expected wrench along it."""
        return self.path.backwards()

    @property
    def leaving(self) -> Trajectory:
        """The approach reversed."""
        return replace(self.approach.backwards(), expected=None)


@dataclass(frozen=True)
class _PathSegment:
    """One option for the path: approach and steps of the gripper's middle, base frame."""

    rotation: np.ndarray
    approach: np.ndarray
    steps: np.ndarray
    path: np.ndarray
    flange: np.ndarray
    joints: JointPath


def robot_motion(cell: Cell, predicted: Predicted, axis: np.ndarray, *,
                 speed: float, rotation: np.ndarray | None = None,
                 blocked: Blocked | None = None) -> RobotMotion:
    """Turn a path of the grasped piece, its predicted poses from rest on and wrenches, into motion:
    of all approaches across the branch's ``axis`` [3] and branches of the inverse kinematics, the
    unblocked one farthest from singularities, at ``speed`` [m/s], with the gripper's ``rotation``
    [rad] if given. InputError if the speed exceeds the cell's limit; NoPathError, where and why, if
    no branch follows it, or all are blocked."""
    if speed > cell.limits.speed_m_s:
        raise InputError(f"{speed:g} m/s exceeds the cell's {cell.limits.speed_m_s:g} m/s.", "The "
                         "guard would slow the motion down, and the predicted forces would not "
                         "match.", "Reduce ", Option("speed"), ", or raise limits.speed_m_s in the "
                         "cell file.")
    speed = speed_within(cell, speed)
    rotations = across(axis) if rotation is None else [np.asarray(rotation, float)]
    segments: list[_PathSegment] = []
    refusal: NoPathError | None = None
    for turn in rotations:
        found = _path_segments(cell, predicted.poses, turn)
        if isinstance(found, NoPathError):
            refusal = refusal or found
        else:
            segments += found
    segments.sort(key=lambda segment: -segment.joints.singularity)
    for segment in segments[:_MOST_TRIED]:
        met = None if blocked is None else blocked(segment.flange, segment.joints.joints)
        if met is None:
            return _timed(cell, predicted, segment, speed)
        refusal = met if segment is segments[0] else refusal
    assert refusal is not None
    raise refusal


def across(axis: np.ndarray) -> list[np.ndarray]:
    """Return rotations [rad] of a gripper that approaches across a branch along ``axis`` [3]: its z
    is the direction of approach, its y along the branch."""
    y = np.asarray(axis, float) / np.linalg.norm(axis)
    side = np.cross(y, [0.0, 0.0, 1.0])
    if np.linalg.norm(side) < 0.1:
        side = np.cross(y, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    found = []
    for angle in np.arange(_TURNS) * 2 * np.pi / _TURNS:
        z = rotated(angle * y, side)
        for sign in (1.0, -1.0):
            frame = np.column_stack([np.cross(sign * y, z), sign * y, z])
            found.append(rotation_vector(frame))
    return found


def _path_segments(cell: Cell, poses: np.ndarray,
                   rotation: np.ndarray) -> list[_PathSegment] | NoPathError:
    """Return the options for the grasp along ``poses`` [n, 6], or why there is none."""
    grip = inverted(matrices(poses[0])) @ matrices(np.r_[poses[0, :3], rotation])
    held = matrices(poses) @ grip
    back = held[0].copy()
    direction = held[0, :3, :3] @ np.array(cell.approach.direction)
    back[:3, 3] -= cell.approach.distance_m * direction
    base = inverted(matrices(np.array(cell.base.pose)))
    approach = densely(pose_vectors(base @ np.array([back, held[0]])))
    steps = pose_vectors(base @ held)
    path = densely(steps)
    # As the branch was solved in motion; straight between the plan's poses, its force was up to 7 %
    # greater.
    path[:, :3] = curve_through(_arc(steps), steps[:, :3], _arc(path))
    tool = inverted(matrices(np.array(cell.tool.grasp_pose)))
    flange = matrices(np.vstack([approach, path[1:]])) @ tool
    found, refusals = follow(cell.arm, flange, joint_limits=cell.joint_limits,
                             singularity_margin=cell.limits.singularity,
                             joint_margin=cell.limits.joint_margin_rad)
    if not found:
        return no_branch(refusals, flange)
    return [_PathSegment(rotation, approach, steps, path, flange, joints) for joints in found]


def _arc(poses: np.ndarray) -> np.ndarray:
    return np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1))]


def _timed(cell: Cell, predicted: Predicted, segment: _PathSegment, speed: float) -> RobotMotion:
    """Return the motion on a path, with the expected wrench along it."""
    limits, steps, path = cell.limits, segment.steps, segment.path
    times = along(path, speed, limits.acceleration_m_s2, turn_speed=0.8 * limits.turn_speed_rad_s)
    # Predictions are at the plan's poses; they are interpolated to the dense poses along the path.
    expected = interpolated(predicted, _arc(steps), _arc(path)).felt(cell, path[0])
    coming = along(segment.approach, speed, limits.acceleration_m_s2)
    first = len(segment.approach)
    # The last pose of the approach is the first of the path.
    coming_joints, joints = segment.joints.joints[:first], segment.joints.joints[first - 1:]
    return RobotMotion(Trajectory(coming, segment.approach,
                                  ExpectedWrench.nothing(segment.approach),
                                  coming_joints),
                       Trajectory(times, path, expected, joints), segment.joints, segment.rotation)


@dataclass(frozen=True)
class Followed:
    """Accuracy of a robot in following a path: greatest force on the branch [N], greatest distance
    from the path [m], 95th percentile of the smoothed force's difference to the expected one over
    the peak, and the share of samples within 5 % of the peak or the 95 % interval of the two
    together; NaN without expected forces."""

    peak_force: float
    path_error: float
    force_error: float
    force_within: float


def followed(samples: np.ndarray, path: np.ndarray, force_sigma: float = 0.0) -> Followed:
    """Compare samples, as in :data:`limber.robot.driver.link.COLUMNS`, with the planned path [m],
    branch frame, shape [n, 3]; ``force_sigma``: the smoothed force's, of noise, tare and drift
    [N]."""
    force = samples[:, 13:16]
    # Distance from segments, not from points.
    start, vectors = path[:-1], np.diff(path, axis=0)
    length = np.maximum((vectors**2).sum(axis=1), 1e-18)
    nearest = np.full(len(samples), np.inf)
    for a, step, square in zip(start, vectors, length, strict=True):
        part = np.clip((samples[:, 1:4] - a) @ step / square, 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(
            samples[:, 1:4] - a - part[:, None] * step, axis=1))
    expected = samples[:, 25:28]
    known = np.isfinite(expected).all(axis=1)
    peak = float(np.linalg.norm(force, axis=1).max())
    error = within = float("nan")
    if known.any():
        largest = max(float(np.linalg.norm(expected[known], axis=1).max()), 1e-9)
        off = force[known] - expected[known]
        size = np.linalg.norm(off, axis=1)
        error = float(np.quantile(size, 0.95) / largest)
        covariance = np.nan_to_num(samples[known, 31:37])[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]]
        covariance = covariance.reshape(-1, 3, 3) + max(force_sigma, 1e-6) ** 2 * np.eye(3)
        distance = np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[..., None])[..., 0])
        within = float(np.mean((size <= 0.05 * largest) | (distance <= _WITHIN)))
    return Followed(peak, float(nearest.max()), error, within)


# The gripper's rotation beyond the branch's natural one, where an arm cannot follow otherwise.
#
# A branch held at a point turns by itself, at no torque. A gripper that turns it by an offset d
# (rotation vector, branch frame) beyond that needs the energy t d + d K d / 2 and the torque t + K
# d, to second order: K is the rotational stiffness of the clamped branch, t the torque of a clamped
# piece without an offset. Offsets begin at zero at the grasp, grow along the path up to where the
# arm could not follow, and stay, or return to zero. Of those that the arm can follow the one of
# least energy is taken; it is then made as small as possible.

_SIZES = (1 / 3, 2 / 3, 1.0)  # of the slack
_GRIPS = 3  # directions of the gripper about the branch, those that come farthest
_HALVINGS = 4  # of the size of the offset that is taken
_SHARES = (1.0, 0.75, 0.5, 0.25, 0.0)  # of the path that are tried at the natural rotations
_SOONEST = 0.15  # of the path, in which an offset grows
_AXES = np.array([axis for axis in product((-1.0, 0.0, 1.0), repeat=3) if any(axis)])
_AXES = _AXES / np.linalg.norm(_AXES, axis=1)[:, None]


@dataclass(frozen=True)
class TurnCost:
    """Wrenches [N, N m], shape [k, 6], of a clamped branch at its natural rotations along a path of
    length [m], shape [k], and their derivative to an offset, [k, 6, 3]."""

    along: np.ndarray
    wrenches: np.ndarray
    slopes: np.ndarray

    def at(self, along: np.ndarray) -> "TurnCost":
        """Return it interpolated to other lengths [n] of the path [m]."""
        def carried(values: np.ndarray) -> np.ndarray:
            columns = values.reshape(len(values), -1).T
            return np.column_stack([np.interp(along, self.along, column) for column in columns]
                                   ).reshape(len(along), *values.shape[1:])
        return TurnCost(along, carried(self.wrenches), carried(self.slopes))

    def wrench(self, offsets: np.ndarray) -> np.ndarray:
        """Return the wrenches [k, 6] with ``offsets`` [k, 3] [rad]."""
        return self.wrenches + np.einsum("kij,kj->ki", self.slopes, offsets)

    def energy(self, offsets: np.ndarray) -> np.ndarray:
        """Return the energy of ``offsets`` [k, 3] [J], shape [k]."""
        torque = self.wrenches[:, 3:] + 0.5 * np.einsum("kij,kj->ki", self.slopes[:, 3:], offsets)
        return np.einsum("ki,ki->k", torque, offsets)


@dataclass(frozen=True)
class Turned:
    """A motion with the gripper turned beyond the branch's natural rotation: offsets at each pose
    [rad], branch frame, shape [n, 3], and what they cost by the second-order function [J, N m],
    shape [n]."""

    motion: RobotMotion
    offsets: np.ndarray
    energies: np.ndarray
    torques: np.ndarray


def turned(poses: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return ``poses`` [n, 6] turned by ``offsets`` [n, 3] [rad] about their positions."""
    return np.hstack([poses[:, :3], composed(offsets, poses[:, 3:])])


def turned_motion(cell: Cell, predicted: Predicted, axis: np.ndarray, cost: TurnCost, slack: float,
                  most: tuple[float, float], **asked: Any) -> Turned:
    """Return the motion whose offset of at most ``slack`` [rad] from the natural rotations costs
    least energy; ``most``: largest force [N] and torque [N m] on the branch, ``asked`` as of
    :func:`.robot_motion`. NoPathError, as without an offset, if none helps."""
    grips, refusal = _farthest(cell, predicted, axis, asked)

    def tried(grip: np.ndarray, offsets: np.ndarray) -> RobotMotion | None:
        wrenches = cost.wrench(offsets)
        if any(np.linalg.norm(part, axis=1).max() > limit for part, limit in zip(
                (wrenches[:, :3], wrenches[:, 3:]), most, strict=True)):
            return None
        path = replace(predicted, poses=turned(predicted.poses, offsets),
                       wrenches=predicted.wrenches + wrenches - cost.wrenches)
        try:
            return robot_motion(cell, path, axis, **asked | {"rotation": grip})
        except NoPathError:
            return None

    choices = [(grip, offsets) for grip, share in grips
               for offsets in _offsets(cost.along, slack, share)]
    choices.sort(key=lambda one: float(np.abs(cost.energy(one[1])).max()))
    for grip, offsets in choices:
        if (motion := tried(grip, offsets)) is None:
            continue
        low, high = 0.0, 1.0
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            if (smaller := tried(grip, middle * offsets)) is None:
                low = middle
            else:
                high, motion = middle, smaller
        offsets = high * offsets
        return Turned(motion, offsets, cost.energy(offsets),
                      np.linalg.norm(cost.wrench(offsets)[:, 3:], axis=1))
    raise NoPathError(refusal.seen, f"{refusal.why} No rotation of the gripper within "
                      f"{np.degrees(slack):.1f} degrees of the branch's own helps either.",
                      refusal.fix)


def _farthest(cell: Cell, predicted: Predicted, axis: np.ndarray, asked: dict[str, Any],
              ) -> tuple[list[tuple[np.ndarray, float]], NoPathError]:
    """Return the gripper's rotations with which the arm follows the natural path farthest, each
    with the share where it ends, and that error; NoPathError if with none it even comes to the
    branch."""
    given = asked.get("rotation")
    ends: list[tuple[np.ndarray, float, NoPathError]] = []
    for grip in across(axis) if given is None else [np.asarray(given, float)]:
        refusals = []
        for share in _SHARES:
            count = max(int(np.ceil(share * len(predicted.poses))), 2)
            try:
                robot_motion(cell, predicted.first(count), axis, **asked | {"rotation": grip})
                break
            except NoPathError as error:
                refusals.append(error)
        if 0 < len(refusals) < len(_SHARES):
            ends.append((grip, _SHARES[len(refusals)], refusals[-1]))
    if not ends:
        raise refusals[-1]  # no gripper even comes to the branch: turning it later is no help
    ends.sort(key=lambda one: -one[1])
    return [(grip, share) for grip, share, _ in ends[:_GRIPS]], ends[0][2]


def _offsets(along: np.ndarray, slack: float, share: float) -> Iterator[np.ndarray]:
    """Yield offsets [n, 3] that are whole from a ``share`` of the path on, or about it."""
    part = along / max(float(along[-1]), 1e-12)
    up = _smooth(part / max(share, _SOONEST))
    shapes = [up]
    if share < 1.0 - _SOONEST:
        shapes.append(np.minimum(up, _smooth((1.0 - part) / _SOONEST)))
    for size, shape, axis in product(_SIZES, shapes, _AXES):
        yield size * slack * shape[:, None] * axis


def _smooth(part: np.ndarray) -> np.ndarray:
    """Return a step from 0 at 0 to 1 at 1 that begins and ends flat."""
    part = np.clip(part, 0.0, 1.0)
    return part * part * (3.0 - 2.0 * part)


HELD = ("path", "hold", "return")
"""Names of the legs during which the gripper holds the branch."""


@dataclass(frozen=True)
class Leg:
    """One part of the motion: ``approach``, ``grasp``, ``path``, ``hold``, ``return``, ``release``
    or ``leaving``; without trajectory the gripper stands still for ``duration`` [s], and opens,
    closes or holds."""

    name: str
    duration: float
    trajectory: Trajectory | None = None


def legs_of(cell: Cell, motion: RobotMotion, hold: float, begun: Trajectory | None = None,
            ) -> list[Leg]:
    """Return the legs of a motion that waits ``hold`` [s] at the path's end; ``begun``: the rest of
    its path where the branch is held already."""
    grip = cell.tool.grip_seconds
    moves = {"approach": motion.approach, "path": begun or motion.path,
             "return": motion.return_path, "leaving": motion.leaving}
    stands = {"grasp": grip, "hold": hold, "release": grip}
    names = ("approach", "grasp", "path", "hold", "return", "release", "leaving")
    return [Leg(name, moves[name].duration, moves[name]) if name in moves
            else Leg(name, stands[name]) for name in names[0 if begun is None else 2:]]


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
