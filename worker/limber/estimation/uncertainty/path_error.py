"""Uncertainty of Young's modulus from the gripper's frame if its path is prescribed.

If the force drives the pull, the gripper's frame is an unknown of the fit
(:mod:`limber.estimation.fitting.nuisances`). If the recorded path drives it (no force, or no torque
for a clamped grasp; on request; a fast pull; a reduced model), the branch is held at the recorded
path. The fit would have attributed the effect of a small displacement of the frame on the pull to
the moduli.
"""

from collections.abc import Sequence

import numpy as np

from limber.core.numerics.rigid import composed, rotated
from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.forward.forward_model import Forward
from limber.recordings.cell_errors import CalibrationEntry, calibration_of

STEP = 0.1
"""Fraction of its deviation by which the frame is moved: a slender branch, stretched by the whole
deviation, would respond far from linearly.
"""
WIDEST = 35.0
"""Standard deviation of log E that means unknown."""


def path_prescribed(forwards: Sequence[Forward]) -> list[Forward]:
    """Return the pulls with a prescribed path and an uncertain gripper frame."""
    return [forward for forward in forwards if forward.drive == "pose" and (
        calibration_of(forward.entry).pose_sigma_m > 0
        or calibration_of(forward.entry).pose_sigma_rad > 0)]


def path_error(evaluation: Evaluation, objective: Objective) -> np.ndarray | None:
    """Relative standard deviation of E at the control points from the gripper's frame, shape [K].

    Linear in the change of the residuals r: d log E = -(J^T J)^-1 J^T dr for each of the frame's
    six errors, of its deviation in the calibration.

    Args:
        evaluation: At the end of the fit.
        objective: The minimised objective.

    Returns:
        None if a simulation finds no equilibrium.
    """
    slopes = path_slopes(evaluation, objective)
    if slopes is None:
        return None
    steps = np.linalg.lstsq(*slopes, rcond=1e-9)[0]
    groups = list(objective.space.groups)
    return np.minimum(np.linalg.norm(steps[groups], axis=1), WIDEST)


def path_slopes(evaluation: Evaluation, objective: Objective,
                ) -> tuple[np.ndarray, np.ndarray] | None:
    """Slopes of the residuals to the free vector, [r, p], and to the errors of the gripper's frame
    in their deviations, [r, S]; None if a simulation finds no equilibrium. Arguments as for
    :func:`path_error`.
    """
    known = {calibration_of(forward.entry): np.array(forward.entry.grasp.point_m)
             for forward in reversed(path_prescribed(objective.forwards))}
    base = _evaluated(evaluation, objective, [forward.with_prescribed_poses(forward.frames.poses)
                                              for forward in objective.forwards], jacobian=True)
    if base is None:
        return None
    changes = []
    for calibration, pivot in known.items():
        for error in range(6):
            if (calibration.pose_sigma_m, calibration.pose_sigma_rad)[error // 3] == 0:
                continue
            moved = [forward.with_prescribed_poses(
                _aside(forward.frames.poses, calibration, pivot, error)
                if forward.drive == "pose" and calibration_of(forward.entry) == calibration
                else forward.frames.poses) for forward in objective.forwards]
            found = _evaluated(evaluation, objective, moved)
            if found is None:
                return None
            changes.append((found.residual - base.residual) / STEP)
    return base.slopes, np.reshape(changes, (-1, len(base.residual))).T


def _aside(poses: np.ndarray, calibration: CalibrationEntry, pivot: np.ndarray,
           error: int) -> np.ndarray:
    """Poses [m, rad], shape [f, 6], with the frame moved or rotated about the grasp at rest."""
    moved = poses.copy()
    if error < 3:
        moved[:, error] += STEP * calibration.pose_sigma_m
        return moved
    turn = STEP * calibration.pose_sigma_rad * np.eye(3)[error - 3]
    moved[:, :3] = pivot + rotated(turn, poses[:, :3] - pivot)
    moved[:, 3:] = composed(turn, poses[:, 3:])
    return moved


def _evaluated(evaluation: Evaluation, objective: Objective, forwards: list[Forward], *,
               jacobian: bool = False) -> Evaluation | None:
    alone = Objective(forwards, objective.space, force_sigma=objective.force_sigma)
    # A force with errors of its own is eliminated by its response, which is computed with the
    # derivatives.
    linearised = any(forward.has_force_unknowns and not forward.watches_pose
                     for forward in forwards)
    return alone.evaluate(evaluation.free, jacobian=jacobian or linearised)
