"""How long a piece the gripper holds, carried to Young's modulus."""

import numpy as np

from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.uncertainty.path_error import WIDEST
from limber.estimation.uncertainty.shape_sensitivity import grip_slopes, taken_up
from limber.recordings.cell_errors import calibration_of


def grip_error(evaluation: Evaluation, objective: Objective) -> np.ndarray | None:
    """Relative standard deviation of E from the length in a clamping gripper, shape [K].

    By pads that give way, and by where the branch leaves its jaws, that length is never known to
    the millimetre (``held_length_sigma_m`` of the calibration); it is alike in all pulls.

    Args:
        evaluation: At the fit's end.
        objective: What was minimised.

    Returns:
        None where no gripper clamps or its length is known, or as
        :func:`limber.estimation.uncertainty.shape_sensitivity.taken_up`.
    """
    if not any(forward.entry.grasp.mode == "clamped"
               and calibration_of(forward.entry).held_length_sigma_m > 0
               for forward in objective.forwards):
        return None
    steps = taken_up(evaluation, objective, grip_slopes)
    return None if steps is None else np.minimum(np.abs(steps[:, 0]), WIDEST)
