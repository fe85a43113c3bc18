"""The gripper's rotation beyond the branch's natural one, where an arm cannot follow otherwise.

A branch held at a point turns by itself, at no torque. A gripper that turns it by an offset d
(rotation vector, branch frame) beyond that needs the energy t d + d K d / 2 and the torque t + K d,
to second order: K is the rotational stiffness of the clamped branch, t the torque of a clamped
piece without an offset. Offsets begin at zero at the grasp, grow along the path up to where the arm
could not follow, and stay, or return to zero. Of those that the arm can follow the one of least
energy is taken; it is then made as small as possible.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import NoPathError
from limber.core.numerics.rigid import composed
from limber.robot.motion.execution import RobotMotion, across, robot_motion
from limber.robot.motion.expected_wrench import Predicted

_SIZES = (1 / 3, 2 / 3, 1.0)  # of the slack
_GRIPS = 3  # directions of the gripper about the branch, those that come farthest
_HALVINGS = 4  # of the size of the offset that is taken
_SHARES = (1.0, 0.75, 0.5, 0.25, 0.0)  # of the path that are tried at the natural rotations
_SOONEST = 0.15  # of the path, in which an offset grows
_AXES = np.array([axis for axis in product((-1.0, 0.0, 1.0), repeat=3) if any(axis)])
_AXES = _AXES / np.linalg.norm(_AXES, axis=1)[:, None]


@dataclass(frozen=True)
class TurnCost:
    """Wrenches of a clamped branch about its natural rotations along a path.

    Attributes:
        along: Length of the path up to each state [m], shape [k].
        wrenches: Without an offset [N, N m], shape [k, 6].
        slopes: Their derivative to the offset, shape [k, 6, 3].
    """

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
        torque = self.wrenches[:, 3:] + 0.5 * np.einsum(
            "kij,kj->ki", self.slopes[:, 3:], offsets)
        return np.einsum("ki,ki->k", torque, offsets)


@dataclass(frozen=True)
class Turned:
    """A robot's motion with the gripper turned beyond the branch's natural rotation.

    Attributes:
        motion: The motion.
        offsets: Offset at each pose of the path [rad], branch frame, shape [n, 3].
        energies, torques: What they cost, by the second-order function [J, N m], shape [n].
    """

    motion: RobotMotion
    offsets: np.ndarray
    energies: np.ndarray
    torques: np.ndarray


def turned(poses: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return ``poses`` [n, 6] turned by ``offsets`` [n, 3] [rad] about their positions."""
    return np.hstack([poses[:, :3], composed(offsets, poses[:, 3:])])


def turned_motion(cell: Cell, predicted: Predicted, axis: np.ndarray, cost: TurnCost, slack: float,
                  most: tuple[float, float], **asked: Any) -> Turned:
    """Return the motion whose offset from the natural rotations costs least energy.

    Args:
        predicted: At the natural rotations.
        cost: At the same poses.
        slack: Largest offset [rad].
        most: Largest force [N] and torque [N m] of the gripper on the branch.
        asked: As :func:`.robot_motion` takes it.

    Raises:
        NoPathError: as :func:`.robot_motion` without an offset, if none within the slack helps.
    """
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
    with the share of the path where it ends; and the error of the farthest.

    Raises:
        NoPathError: with none the arm even comes to the branch.
    """
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
