"""A small move across a pull with the branch held: it shows a sensor that is wrong.

A sensor turned about the force of a pull shows that force correctly. The force of a nudge across
it lies in another direction. A path is followed only after such a nudge as well.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import LimberError, NoPathError, SafetyStop
from limber.core.numerics.rigid import matrices
from limber.core.progress import Progress
from limber.robot.motion.execution import Blocked
from limber.robot.motion.trajectory import Trajectory
from limber.robot.recorder import (
    LOOKED_M,
    NUDGE_M,
    NUDGE_M_S,
    NUDGE_SECONDS,
    PullPlausibility,
    nudge_direction,
)
from limber.stages.pulls.record_path import there_and_back
from limber.stages.pulls.record_prediction import PullModel
from limber.store import Branch

if TYPE_CHECKING:
    from limber.robot.driver.link import LiveForce, RobotLink

_SETTLE_SECONDS = 0.5  # until the branch rests again
_SHARE = 0.5  # of the pull's own travel, and of the force at which a motion pauses


@dataclass(frozen=True)
class Nudge:
    """A nudge of the held branch, out and back, and the check of the forces that it shows."""

    motion: Trajectory
    check: PullPlausibility


def nudge_and_checks(branch: Branch, cell: Cell, point: np.ndarray, sample: np.ndarray,
                     pull: Trajectory, blocked: Blocked, progress: Progress,
                     ) -> tuple[Nudge | None, list[PullPlausibility]]:
    """Return the nudge before a pull, if there is one, and the check of the pull; ``point`` of the
    grasp, branch frame [m], ``sample`` at the start, as
    :data:`limber.robot.driver.link.COLUMNS`."""
    try:
        model = PullModel.of_branch(branch, cell, point, progress)
        checks = [PullPlausibility(cell, model.predicted(pull))]
        return checked_nudge(cell, model, sample[1:7], sample[19:25], pull, blocked,
                             progress), checks
    except LimberError as error:
        progress.warn(f"The force of this pull could not be predicted ({error}), so the sensor's "
                      "sign and axes are not checked by it.")
        return None, []


def checked_nudge(cell: Cell, model: PullModel, pose: np.ndarray, joints: np.ndarray,
                  pull: Trajectory, blocked: Blocked | None, progress: Progress) -> Nudge | None:
    """Return the nudge before a motion that holds the branch; None where the arm can make none.
    ``pose``, ``joints`` as of :func:`nudge`; ConvergenceError if its force cannot be predicted."""
    across = nudge(cell, model.stiffness, pose, joints, pull, blocked)
    if across is None:
        progress.warn("The arm cannot nudge the branch across the pull, so a sensor whose "
                      "axes are turned about the pull's force is not noticed.")
        return None
    return Nudge(across, PullPlausibility(cell, model.predicted(across)))


def nudged(link: RobotLink, live: LiveForce, across: Nudge, judging: list[PullPlausibility],
           ) -> dict[str, Any]:
    """Nudge the held branch and return how it ended, as :meth:`.RobotLink.follow`; ``judging`` gets
    the check meanwhile: whoever takes the samples lets the last judge them, and stops the arm for
    its reason."""
    live.at("nudging")
    judging.append(across.check)
    try:
        event = link.follow(across.motion)
        # Its last samples may come after its end, and the branch comes to rest.
        time.sleep(_SETTLE_SECONDS)
    finally:
        judging.remove(across.check)
    reason = across.check.reason
    return event if reason is None else {"event": "stopped", "reason": f"implausible: {reason}"}


def nudge(cell: Cell, stiffness: np.ndarray, pose: np.ndarray, joints: np.ndarray,
          pull: Trajectory, blocked: Blocked | None) -> Trajectory | None:
    """Return the nudge before a pull, out and back; None where the arm can make none. ``stiffness``
    of the held branch, branch frame [N/m], [3, 3]; ``pose`` of the gripper at the start, branch
    frame [m, rad], and ``joints`` of the arm there [rad]."""
    away = np.linalg.norm(pull.poses[:, :3] - pull.poses[0, :3], axis=1)
    farthest = float(away.max())
    first = int(np.argmax(away >= min(LOOKED_M, farthest)))
    way = matrices(np.array(cell.base.pose))[:3, :3] @ (pull.poses[first] - pull.poses[0])[:3]
    side = nudge_direction(way, stiffness)
    # A stiff branch is nudged less far, so that the nudge itself stays below the limits.
    gentle = cell.limits.soft_force_n / float(np.linalg.norm(stiffness @ side))
    travel = min(NUDGE_M, _SHARE * farthest, _SHARE * gentle)
    frames = np.array([matrices(pose)] * 2)
    for sign in (1.0, -1.0):
        frames[1, :3, 3] = frames[0, :3, 3] + sign * travel * side
        try:
            return there_and_back(cell, frames, speed=min(NUDGE_M_S, cell.limits.speed_m_s),
                                  cycles=1, pause=NUDGE_SECONDS, start=joints,
                                  blocked=blocked)
        except (NoPathError, SafetyStop):
            continue
    return None
