"""Joint angles along a path of poses, and motions of an arm alone past cell and branch."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from limber.cell.arm import Arm
from limber.cell.cell_file import Cell
from limber.cell.reach_and_collision import ArmSurroundings
from limber.core.errors import InputError, NoPathError
from limber.core.numerics.rigid import inverted, matrices, pose_vectors
from limber.geometry.rigid_kernels import length, turn_between
from limber.robot.motion.trajectory import (
    ExpectedWrench,
    Trajectory,
    along,
    along_bounded,
    densely,
    speed_within,
)

# Between neighbouring poses of a path a joint rotates little; more is a jump to another solution.
_LARGEST_STEP = 0.35  # rad
_OUT_OF_REACH = "out of the arm's reach"


@dataclass(frozen=True)
class JointPath:
    """Continuous joint angles along a path [rad], shape [n, joints], of one configuration of the
    arm, with the least distance from a singularity (dimensionless) and from a joint limit [rad]."""

    branch: int
    joints: np.ndarray
    singularity: float
    limit_margin: float

    def speed_share(self, arm: Arm, times: np.ndarray) -> float:
        """Return the greatest joint speed as a fraction of the joint's speed limit."""
        speeds = np.abs(np.diff(self.joints, axis=0)) / np.diff(times)[:, None]
        return float((speeds / np.asarray(arm.joint_speed)).max(initial=0.0))


@dataclass(frozen=True)
class Refusal:
    """Why one branch does not follow a path: the pose, and the reason."""

    branch: int
    index: int
    reason: str


def follow(arm: Arm, frames: np.ndarray, *, singularity_margin: float = 0.05,
           joint_margin: float = 0.05, joint_limits: np.ndarray | None = None,
           ) -> tuple[list[JointPath], list[Refusal]]:
    """Return the joint paths along which the flange passes ``frames`` [n, 4, 4], base frame, close
    together: the one farthest from singularities first, full turns as far as possible from the
    limits; and why every other branch was rejected. Margins are of
    :meth:`.Arm.singularity_distance` and the limits [rad], [joints, 2], else the arm's."""
    frames = np.asarray(frames, float)
    if frames.ndim != 3 or frames.shape[1:] != (4, 4) or not np.isfinite(frames).all():
        raise InputError(f"The frames have shape {frames.shape} or are not finite.",
                         "A path consists of finite 4 x 4 transforms.", "Check the poses.")
    limits = arm.joint_limits if joint_limits is None else np.asarray(joint_limits, float)
    paths: list[JointPath] = []
    refusals: list[Refusal] = []
    for branch, joints in enumerate(arm.configurations(frames)):
        found = _one_branch(arm, branch, joints, limits, singularity_margin, joint_margin)
        if isinstance(found, JointPath):
            paths.append(found)
        else:
            refusals.append(found)
    return sorted(paths, key=lambda path: -path.singularity), refusals


def joint_path(arm: Arm, frames: np.ndarray, *, start: np.ndarray | None = None,
               joint_limits: np.ndarray | None = None, **margins: float) -> JointPath:
    """Return the joint path along ``frames`` [n, 4, 4] nearest to the angles ``start`` [rad], so
    that it begins without a turn of the arm, or farthest from singularities; margins as of
    :func:`follow`. NoPathError, where and why, if no configuration follows it all."""
    paths, refusals = follow(arm, frames, joint_limits=joint_limits, **margins)
    if not paths:
        raise no_branch(refusals, np.asarray(frames))
    if start is None:
        return paths[0]
    start = np.asarray(start, float)
    limits = arm.joint_limits if joint_limits is None else np.asarray(joint_limits, float)
    turned = [_turned_near(path, start, limits) for path in paths]
    return min(turned, key=lambda path: np.abs(path.joints[0] - start).max())


def _one_branch(arm: Arm, branch: int, joints: np.ndarray, limits: np.ndarray,
                singularity_margin: float, joint_margin: float) -> JointPath | Refusal:
    missing = np.isnan(joints).any(axis=1)
    if missing.any():
        return Refusal(branch, int(missing.argmax()), _OUT_OF_REACH)
    joints = np.unwrap(joints, axis=0)
    distance = arm.singularity_distance(joints)
    close = distance.min(axis=1) < singularity_margin
    if close.any():
        index = int(close.argmax())
        return Refusal(branch, index, f"at a distance of {distance[index].min():.3f} from the "
                       f"{arm.singularity_names[int(distance[index].argmin())]} singularity")
    steps = np.abs(np.diff(joints, axis=0)).max(axis=1, initial=0.0)
    if (steps > _LARGEST_STEP).any():
        index = int(steps.argmax())
        return Refusal(branch, index + 1, f"a joint jumps by {math.degrees(steps[index]):.0f} deg")
    joints = joints + _whole_turns(joints, limits)
    margin = _margins(joints, limits)
    if margin.min() < joint_margin:
        pose, joint = np.unravel_index(margin.argmin(), margin.shape)
        return Refusal(branch, int(pose), f"joint {joint + 1} at its limit")
    return JointPath(branch, joints, float(distance.min()), float(margin.min()))


def _whole_turns(joints: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Full turns [joints] that bring the middle of each range nearest to the middle of its limits.
    """
    middle = 0.5 * (joints.max(axis=0) + joints.min(axis=0))
    bounded = np.isfinite(limits).all(axis=1)
    target = np.where(bounded, 0.5 * np.where(bounded[:, None], limits, 0.0).sum(axis=1), 0.0)
    return 2 * np.pi * np.round((target - middle) / (2 * np.pi))


def _turned_near(path: JointPath, start: np.ndarray, limits: np.ndarray) -> JointPath:
    """The same path with the full turns nearest to ``start`` that keep the limits."""
    turns = 2 * np.pi * np.round((start - path.joints[0]) / (2 * np.pi))
    moved = path.joints + turns
    inside = _margins(moved, limits).min(axis=0) >= path.limit_margin
    # An arm a full turn away from the limits' middle may stay there if it fits.
    fits = inside | (_margins(moved, limits).min(axis=0) > 0.05)
    joints = path.joints + np.where(fits, turns, 0.0)
    return JointPath(path.branch, joints, path.singularity, float(_margins(joints, limits).min()))


def _margins(joints: np.ndarray, limits: np.ndarray) -> np.ndarray:
    return np.minimum(joints - limits[:, 0], limits[:, 1] - joints)


def no_branch(refusals: list[Refusal], frames: np.ndarray) -> NoPathError:
    """Return the error that states how far the best rejected configuration followed ``frames``
    [n, 4, 4]."""
    farthest = max(refusals, key=lambda refusal: refusal.index)
    position = ", ".join(f"{value:.3f}" for value in frames[farthest.index, :3, 3])
    reasons = sorted({refusal.reason for refusal in refusals if refusal.index == farthest.index})
    return NoPathError(
        "No configuration of the arm can follow the path. The best one ends at pose "
        f"{farthest.index + 1} of {len(frames)}, flange at ({position}) m in the robot's base "
        f"frame: {'; '.join(reasons)}.",
        "The arm does not reach it." if reasons == [_OUT_OF_REACH] else
        ("The arm would have to change its configuration on the path, which would swing the "
         "branch."),
        "Move the robot's base, choose a path nearer to it, or rotate the tool.")


# Path of an arm between joint angles that avoids obstacles (RRT-Connect).
#
# Kuffner and LaValle 2000, "RRT-Connect: an efficient approach to single-query path planning". The
# straight path is used if it is free. The path found is shortened, not optimal.

STEP_RAD = 0.05  # of the joint that turns most, between checked configurations
_GROWN_RAD = 0.4
_MOST = 1500  # nodes of the two trees
_SHORTCUTS = 80

Free = Callable[[np.ndarray], np.ndarray]
"""Whether an arm with joint angles [n, joints] is free of collisions, shape [n]."""


@dataclass
class _Tree:
    angles: list[np.ndarray]
    parents: list[int] = field(default_factory=lambda: [-1])

    def nearest(self, target: np.ndarray) -> int:
        return int(np.abs(np.array(self.angles) - target).max(axis=1).argmin())

    def path_to(self, index: int) -> list[np.ndarray]:
        """From the root to an entry."""
        path = []
        while index >= 0:
            path.append(self.angles[index])
            index = self.parents[index]
        return path[::-1]


def joint_space_path(start: np.ndarray, goal: np.ndarray, limits: np.ndarray, free: Free,
                     ) -> np.ndarray:
    """Return joint angles [rad] on a free path from ``start`` to ``goal`` within limits [n, 2],
    shape [k, n], neighbours at most :data:`STEP_RAD` apart. NoPathError if start or goal is not
    free, or no path was found."""
    for name, angles in (("start", start), ("goal", goal)):
        if not free(angles[None])[0]:
            raise NoPathError(f"The arm's {name} is in collision, or closer than allowed.",
                              "So no way begins or ends there.",
                              "Move the arm by hand, or correct the cell's obstacles.")
    if free(straight(start, goal)).all():
        return straight(start, goal)
    rng = np.random.default_rng(0)
    low = np.maximum(limits[:, 0], np.minimum(start, goal) - np.pi)
    high = np.minimum(limits[:, 1], np.maximum(start, goal) + np.pi)
    trees = [_Tree([start]), _Tree([goal])]
    for _ in range(_MOST):
        reached = _grown(trees[0], rng.uniform(low, high), free)
        if reached is not None and (met := _connected(trees[1], trees[0].angles[reached], free)):
            first, second = trees[0].path_to(reached), trees[1].path_to(met)
            corners = first + second[::-1][1:]
            if not np.array_equal(corners[0], start):
                corners.reverse()
            return densely_turned(_shortened(corners, free, rng))
        trees.reverse()
    raise NoPathError("No free way of the arm was found between its start and its goal.",
                      f"{_MOST} directions were tried.",
                      "Move the arm by hand, or check the cell's obstacles.")


def straight(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return angles from ``first`` [n] to ``second`` [n], all joints at once, shape [k, n]."""
    count = max(int(np.ceil(np.abs(second - first).max() / STEP_RAD)), 1)
    return first + np.linspace(0.0, 1.0, count + 1)[:, None] * (second - first)


def densely_turned(corners: list[np.ndarray]) -> np.ndarray:
    """Return angles close together through ``corners``, shape [k, n]."""
    parts = [straight(first, second)[1:] for first, second in pairwise(corners)]
    return np.vstack([corners[:1], *parts])


def _grown(tree: _Tree, sample: np.ndarray, free: Free) -> int | None:
    """Grow a tree one step towards ``sample``; returns the new entry, None if blocked."""
    near = tree.nearest(sample)
    step = sample - tree.angles[near]
    size = float(np.abs(step).max())
    target = tree.angles[near] + step * min(1.0, _GROWN_RAD / max(size, 1e-12))
    if size < 1e-9 or not free(straight(tree.angles[near], target)[1:]).all():
        return None
    tree.angles.append(target)
    tree.parents.append(near)
    return len(tree.angles) - 1


def _connected(tree: _Tree, target: np.ndarray, free: Free) -> int | None:
    """Grow a tree until it reaches ``target``; returns the entry there, None if blocked."""
    while (last := _grown(tree, target, free)) is not None:
        if np.array_equal(tree.angles[last], target) or (
                np.abs(tree.angles[last] - target).max() < 1e-9):
            return last
    return None


def _shortened(corners: list[np.ndarray], free: Free, rng: np.random.Generator) -> list[np.ndarray]:
    """Remove corners between two that are connected by a free path."""
    for _ in range(_SHORTCUTS):
        if len(corners) < 3:
            break
        first, last = sorted(rng.choice(len(corners), 2, replace=False))
        if last - first > 1 and free(straight(corners[first], corners[last])[1:-1]).all():
            corners = corners[:first + 1] + corners[last:]
    return corners


_NEAR_M = 0.15  # m from the branch: nearer, the arm is slower
_SLOWEST = 0.25
_AT_GOAL_RAD = 1e-3
_JOINT_SPEED = 0.4  # rad/s: an elbow is as fast as a gripper, and nobody watches it


def is_at(joints: np.ndarray, goal: np.ndarray) -> bool:
    """Whether joint angles [rad, n] are those of a goal."""
    return bool(np.abs(joints - goal).max() < _AT_GOAL_RAD)


def to_joints(cell: Cell, start: np.ndarray, goal: np.ndarray, around: ArmSurroundings,
              ) -> Trajectory:
    """Return the motion of the empty gripper between joint angles [n], clear of cell, branch and
    the arm itself, slow near the branch. NoPathError without such a path, or if start or goal
    collide, or the gripper would leave the workspace."""
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
    """Return the straight retreat of an open gripper from the branch, opposite to its approach, by
    joint angles [rad] and the controller's pose of its middle, base frame [m, rad]. NoPathError if
    the arm cannot reach so far."""
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
