"""A small move across a pull with the branch held: it shows a sensor whose axes are wrong.

A sensor turned about the force of a pull shows that force correctly. The force of a nudge across
it lies in another direction.
"""

import numpy as np

from limber.core.errors import LimberError, NoPathError, SafetyStop
from limber.core.numerics.rigid import matrices
from limber.core.progress import Progress
from limber.robot.cell.cell import Cell
from limber.robot.motion.execution import Blocked
from limber.robot.motion.trajectory import Trajectory
from limber.robot.pull_plausibility import (
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

_SHARE = 0.5  # of the pull's own travel, and of the force at which a motion pauses


def nudge_and_checks(branch: Branch, cell: Cell, point: np.ndarray, sample: np.ndarray,
                     pull: Trajectory, blocked: Blocked, progress: Progress,
                     ) -> tuple[Trajectory | None, list[PullPlausibility]]:
    """Return the nudge before a pull, if there is one; and the checks of the pull and of the nudge.

    Args:
        point: Position of the grasp, branch frame [m], shape [3].
        sample: As :func:`nudge` takes it.
    """
    across: Trajectory | None = None
    checks: list[PullPlausibility] = []
    try:
        model = PullModel(branch, cell, point, progress)
        checks.append(PullPlausibility(cell, model.predicted(pull)))
        across = nudge(cell, model.stiffness, sample, pull, blocked)
        if across is None:
            progress.warn("The arm cannot nudge the branch across the pull, so a sensor whose "
                          "axes are turned about the pull's force is not noticed.")
        else:
            checks.append(PullPlausibility(cell, model.predicted(across)))
    except LimberError as error:
        progress.warn(f"The force of this pull could not be predicted ({error}), so the sensor's "
                      "sign and axes are not checked by it.")
        return None, []
    return across, checks


def nudge(cell: Cell, stiffness: np.ndarray, sample: np.ndarray, pull: Trajectory,
          blocked: Blocked | None) -> Trajectory | None:
    """Return the nudge before a pull, out and back; None where the arm can make none.

    Args:
        stiffness: Of the held branch, branch frame [N/m], shape [3, 3].
        sample: Of the robot at the start, as :data:`limber.robot.driver.link.COLUMNS`.
    """
    away = np.linalg.norm(pull.poses[:, :3] - pull.poses[0, :3], axis=1)
    farthest = float(away.max())
    first = int(np.argmax(away >= min(LOOKED_M, farthest)))
    way = matrices(np.array(cell.base.pose))[:3, :3] @ (pull.poses[first] - pull.poses[0])[:3]
    side = nudge_direction(way, stiffness)
    # A stiff branch is nudged less far, so that the nudge itself stays below the limits.
    gentle = cell.limits.soft_force_n / float(np.linalg.norm(stiffness @ side))
    travel = min(NUDGE_M, _SHARE * farthest, _SHARE * gentle)
    frames = np.array([matrices(sample[1:7])] * 2)
    for sign in (1.0, -1.0):
        frames[1, :3, 3] = frames[0, :3, 3] + sign * travel * side
        try:
            return there_and_back(cell, frames, speed=min(NUDGE_M_S, cell.limits.speed_m_s),
                                  cycles=1, pause=NUDGE_SECONDS, start=sample[19:25],
                                  blocked=blocked)
        except (NoPathError, SafetyStop):
            continue
    return None
