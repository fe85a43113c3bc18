"""Predicted force along the first outward motion of a recorded pull, by the branch's model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from limber.core.errors import LimberError
from limber.core.numerics.rigid import inverted, matrices, pose_vectors
from limber.core.progress import Progress
from limber.robot.pull_plausibility import LOOKED_M, PredictedPull
from limber.stages.pulls.record_path import GRASP_RADIUS_M
from limber.store import Branch

if TYPE_CHECKING:
    from limber.robot.cell.cell import Cell
    from limber.robot.motion.trajectory import Trajectory

_SHARES = (0.35, 0.7, 1.0)  # of the travel within which a wrong sensor is noticed
_STEP_M = 0.02  # between positions beyond it
_BENT = 1.1  # times the distance from the start: a longer path is no longer one direction
_DEVIATIONS, _LEAST_FACTOR = 3.0, 2.0


def predicted_pull(branch: Branch, cell: Cell, point: np.ndarray, trajectory: Trajectory,
                   progress: Progress) -> PredictedPull | None:
    """Return the forces on the first outward motion of a pull; None without a usable model.

    Beyond the first :data:`.LOOKED_M` they end where the model does not converge any more.

    Args:
        point: Position of the grasp, branch frame [m], shape [3].
        trajectory: Trajectory of the gripper, base frame.
    """
    from limber.mechanics import Grasp, follow_poses
    from limber.store.loading import load_branch, young_deviation

    try:
        model = load_branch(branch, progress=progress).model
        deviation = young_deviation(branch)
        grasp = Grasp.gripping(model.mesh, point, GRASP_RADIUS_M)
        frames = matrices(np.array(cell.base.pose)) @ matrices(trajectory.poses)
        chosen, away = _prediction_rows(frames[:, :3, 3])
        rest = np.eye(4)
        rest[:3, 3] = point
        poses = pose_vectors(frames[chosen] @ inverted(frames[0]) @ rest)
        results = follow_poses(model.gripped(grasp), grasp, poses)
        forces = [result.require().reaction_force for result in results[:len(_SHARES)]]
        for result in results[len(_SHARES):]:
            if not result.converged:
                break
            forces.append(result.reaction_force)
    except LimberError as error:
        progress.warn(f"The force of this pull could not be predicted ({error}), so the sensor's "
                      "sign and axes are not checked by it.")
        return None
    factor = None if deviation is None else max(float(np.exp(_DEVIATIONS * deviation)),
                                                _LEAST_FACTOR)
    return PredictedPull(np.r_[0.0, away[:len(forces)]],
                         np.vstack([np.zeros(3), *forces]), factor)


def _prediction_rows(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of ``positions`` [n, 3] at which the force is predicted, and their travels [m]."""
    away = np.linalg.norm(positions - positions[0], axis=1)
    passed = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))]
    # Beyond a corner, or on the return, the distance no longer determines the position.
    straight = away[:int(np.argmin(np.r_[passed <= _BENT * away + 1e-6, False]))]
    end = int(np.argmax(straight >= 0.999 * straight.max()))
    looked = min(LOOKED_M, away[end])
    travels = [part * looked for part in _SHARES]
    beyond = away[end] - looked
    if beyond > 0.0:
        count = int(np.ceil(beyond / _STEP_M))
        travels += (looked + beyond * np.arange(1, count + 1) / count).tolist()
    chosen = np.array([int(np.argmax(away[:end + 1] >= min(travel, away[end])))
                       for travel in travels])
    return chosen, away[chosen]
