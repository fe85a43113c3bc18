"""Effect of the held length on Young's modulus."""

import numpy as np

from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.uncertainty.path_error import WIDEST
from limber.estimation.uncertainty.shape_sensitivity import grip_slopes, taken_up
from limber.recordings.cell_errors import calibration_of


def grip_error(evaluation: Evaluation, objective: Objective) -> np.ndarray | None:
    """Relative standard deviation of E from the length in a clamping gripper, shape [K].

    Because of soft pads and the position where the branch leaves the jaws, that length is never
    known to a millimetre (``held_length_sigma_m`` of the calibration). Its error is the same in all
    pulls.

    Args:
        evaluation: At the end of the fit.
        objective: The minimised objective.

    Returns:
        None if no gripper clamps or its length is known, or as for
        :func:`limber.estimation.uncertainty.shape_sensitivity.taken_up`.
    """
    if not any(forward.entry.grasp.mode == "clamped"
               and calibration_of(forward.entry).held_length_sigma_m > 0
               for forward in objective.forwards):
        return None
    steps = taken_up(evaluation, objective, grip_slopes)
    return None if steps is None else np.minimum(np.abs(steps[:, 0]), WIDEST)
