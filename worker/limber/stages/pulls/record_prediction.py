"""Predicted force at the beginning of a recorded pull, by the branch's model."""

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

_PLACES = (0.35, 0.7, 1.0)  # of the way that is looked at
_DEVIATIONS, _LEAST_FACTOR = 3.0, 2.0


def predicted_pull(branch: Branch, cell: Cell, point: np.ndarray, trajectory: Trajectory,
                   progress: Progress) -> PredictedPull | None:
    """Return the forces of the first :data:`.LOOKED_M` of a pull; None without a usable model.

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
        away = np.linalg.norm(frames[:, :3, 3] - frames[0, :3, 3], axis=1)
        out = int(np.argmax(away >= min(LOOKED_M, 0.999 * away.max())))
        chosen = np.unique([int(np.argmax(away[:out + 1] >= part * away[out]))
                            for part in _PLACES])
        rest = np.eye(4)
        rest[:3, 3] = point
        poses = pose_vectors(frames[chosen] @ inverted(frames[0]) @ rest)
        results = follow_poses(model.gripped(grasp), grasp, poses)
        forces = np.array([result.require().reaction_force for result in results])
    except LimberError as error:
        progress.warn(f"The force of this pull could not be predicted ({error}), so the sensor's "
                      "sign and axes are not checked by it.")
        return None
    factor = None if deviation is None else max(float(np.exp(_DEVIATIONS * deviation)),
                                                _LEAST_FACTOR)
    return PredictedPull(np.r_[0.0, away[chosen]], np.vstack([np.zeros(3), forces]), factor)
