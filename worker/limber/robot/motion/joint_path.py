"""Joint angles along a path of poses, on one continuous branch of the inverse kinematics."""

import math
from dataclasses import dataclass

import numpy as np

from limber.cell.arm import Arm
from limber.core.errors import InputError, NoPathError

# Between neighbouring poses of a path a joint rotates little; more is a jump to another solution.
_LARGEST_STEP = 0.35  # rad
_OUT_OF_REACH = "out of the arm's reach"


@dataclass(frozen=True)
class JointPath:
    """Joint angles along a path.

    Attributes:
        branch: Number of the arm's configuration.
        joints: Angles [rad], continuous, shape [n, joints].
        singularity: Least distance from a singularity along the path, dimensionless.
        limit_margin: Least distance of a joint from its limit [rad].
    """

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
    """Return the joint paths along which the flange passes ``frames``, the best first.

    Best is the one farthest from singularities. Full turns are chosen so that the joints stay
    farthest from their limits.

    Args:
        frames: Frames of the flange in the base's, in order and close together, shape [n, 4, 4].
        singularity_margin: Least allowed :meth:`.Arm.singularity_distance`.
        joint_margin: Least allowed distance from a joint limit [rad].
        joint_limits: Least and greatest angles [rad], shape [joints, 2]; else the arm's own.

    Returns:
        The paths, and for every other branch the reason of its rejection.
    """
    frames = np.asarray(frames, float)
    if frames.ndim != 3 or frames.shape[1:] != (4, 4) or not np.isfinite(frames).all():
        raise InputError(f"The frames have shape {frames.shape} or are not finite.",
                         "A path consists of finite 4 x 4 transforms.", "Check the poses.")
    limits = arm.joint_limits if joint_limits is None else np.asarray(joint_limits, float)
    paths, refusals = [], []
    for branch, joints in enumerate(arm.configurations(frames)):
        found = _one_branch(arm, branch, joints, limits, singularity_margin, joint_margin)
        (paths if isinstance(found, JointPath) else refusals).append(found)
    return sorted(paths, key=lambda path: -path.singularity), refusals


def joint_path(arm: Arm, frames: np.ndarray, *, start: np.ndarray | None = None,
               joint_limits: np.ndarray | None = None, **margins: float) -> JointPath:
    """Return the joint path along ``frames`` [n, 4, 4].

    Args:
        start: Joint angles [rad] where the robot is, shape [joints]: the branch nearest to them is
            taken, so that a path begins without a turn of the arm. Absent: the branch farthest
            from singularities.
        margins, joint_limits: As :func:`follow` takes them.

    Raises:
        NoPathError: no configuration follows the whole path; states where and why.
    """
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
        index, joint = np.unravel_index(margin.argmin(), margin.shape)
        return Refusal(branch, int(index), f"joint {joint + 1} at its limit")
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
    return JointPath(path.branch, joints, path.singularity,
                     float(_margins(joints, limits).min()))


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
