"""A planned path as motion of a robot: joints, times, expected wrenches, approach and return."""

from dataclasses import dataclass, replace

import numpy as np

from limber.cell.cell_file import Cell
from limber.cell.reach_and_collision import Blocked
from limber.core.errors import InputError, NoPathError, Option
from limber.core.numerics.rigid import inverted, matrices, pose_vectors, rotated, rotation_vector
from limber.robot.motion.contact_speed import speed_within
from limber.robot.motion.expected_wrench import ExpectedWrench, Predicted, interpolated
from limber.robot.motion.joint_path import JointPath, follow, no_branch
from limber.robot.motion.trajectory import Trajectory, along, densely

_WITHIN = 7.815  # chi-squared: 95 % of a vector's draws
_TURNS = 12  # directions around the branch from which the gripper may come
_MOST_TRIED = 24  # variants of the path checked against obstacles


@dataclass(frozen=True)
class RobotMotion:
    """A robot's motion that takes a branch along a path.

    Poses are of the gripper's middle in the robot's base frame.

    Attributes:
        approach: Motion from a start before the branch to the grasp.
        path: Motion with the branch held.
        joints: Joint angles of approach and path together, one continuous branch.
        rotation: Rotation of the gripper at the grasp, branch frame, as a rotation vector [rad].
    """

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
    """Turn a path of the grasped piece of branch into motion of the robot.

    Of all directions of approach across the branch and all branches of the inverse kinematics, the
    unblocked one that stays farthest from singularities is chosen.

    Args:
        predicted: Poses of the grasped piece from its rest pose on, and their predicted wrenches.
        axis: Direction of the branch at the grasp, branch frame, shape [3].
        speed: Speed of the gripper [m/s].
        rotation: Rotation of the gripper at the grasp, branch frame [rad], shape [3], if it is
        given.

    Raises:
        InputError: the speed exceeds the cell's limit.
        NoPathError: no branch of the inverse kinematics follows the motion, or all are blocked;
            states where and why.
    """
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
    """Return rotations [rad] of a gripper that approaches across a branch along ``axis`` [3].

    The gripper's z is its direction of approach; its y is along the branch.
    """
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
    tool = inverted(matrices(np.array(cell.tool.grasp_pose)))
    flange = matrices(np.vstack([approach, path[1:]])) @ tool
    found, refusals = follow(cell.arm, flange, joint_limits=cell.joint_limits,
                             singularity_margin=cell.limits.singularity,
                             joint_margin=cell.limits.joint_margin_rad)
    if not found:
        return no_branch(refusals, flange)
    return [_PathSegment(rotation, approach, steps, path, flange, joints) for joints in found]


def _timed(cell: Cell, predicted: Predicted, segment: _PathSegment, speed: float) -> RobotMotion:
    """Return the motion on a path, with the expected wrench along it."""
    limits, steps, path = cell.limits, segment.steps, segment.path
    times = along(path, speed, limits.acceleration_m_s2, turn_speed=0.8 * limits.turn_speed_rad_s)
    # Predictions are at the plan's poses; they are interpolated to the dense poses along the path.
    arc = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(steps[:, :3], axis=0), axis=1))]
    dense = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1))]
    expected = interpolated(predicted, arc, dense).felt(cell, path[0])
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
    """Accuracy of a robot in following a path, from its samples.

    Attributes:
        peak_force: Greatest force on the branch [N].
        path_error: Greatest distance of the grasp from the path [m].
        force_error: 95th percentile of the difference between the smoothed and the expected force,
            as a fraction of the peak force; NaN without expected forces.
        force_within: Fraction of the samples whose force differs from the expected one by less than
            5 % of the peak, or is within the 95 % interval of the two together; NaN likewise.
    """

    peak_force: float
    path_error: float
    force_error: float
    force_within: float


def followed(samples: np.ndarray, path: np.ndarray, force_sigma: float = 0.0) -> Followed:
    """Compare a robot's motion with the planned and expected one.

    Args:
        samples: As in :data:`limber.robot.driver.link.COLUMNS`.
        path: [m], branch frame, shape [n, 3].
        force_sigma: Standard deviation of the smoothed force: noise, tare and drift of the sensor
        [N].
    """
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
