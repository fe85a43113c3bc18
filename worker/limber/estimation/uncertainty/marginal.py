"""The moduli that are likeliest when every form of their field counts, not its likeliest alone.

A fit ends at the moduli and the form that are likeliest together. But the form acts the more the
more neighbouring moduli differ: under steeper moduli a pull leaves a smaller part of the forms that
were thought possible, which the likeliest form does not show. With the form integrated out by
Laplace's approximation, the density of the moduli is that along the fit's valley over the root of
the determinant of what is known of all else, and its mode lies towards smaller steps: by a
hundredth or two of a modulus, where the form matters.
"""

import numpy as np

from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.fitting.optimise import Fit
from limber.estimation.forward.dynamic_pull import DynamicForward
from limber.estimation.forward.quasi_static import QuasiStaticForward
from limber.estimation.interpolation_prior import YoungField
from limber.estimation.parameters import ParameterSpace

LONGEST_STEP = 0.5
"""In standard deviations; beyond it the approximation says nothing, and the fit is left alone."""


def averaged(fit: Fit, objective: Objective) -> Fit:
    """Return the fit moved to the mode of the moduli's marginal density; itself where the form of
    the field is no unknown."""
    full = objective.forwards[0].full
    if not isinstance(full, QuasiStaticForward | DynamicForward):
        return fit
    field = full.field
    if not field.names or not set(field.names) <= set(objective.space.extra):
        return fit
    step = marginal_step(fit.evaluation, objective.space, field)
    if not np.linalg.norm(fit.evaluation.slopes @ step) < LONGEST_STEP:
        return fit
    lower, upper = objective.space.bounds()
    found = objective.evaluate(np.clip(fit.evaluation.free + step, lower, upper), jacobian=True)
    return fit if found is None else Fit(found, fit.status, fit.reason)


def marginal_step(evaluation: Evaluation, space: ParameterSpace, field: YoungField) -> np.ndarray:
    """Way from the joint mode to the marginal one in the free vector, shape [p].

    Args:
        evaluation: At the fit's end, with derivatives.
        field: Its further unknowns are among the free ones.
    """
    count = space.group_count
    information = evaluation.slopes.T @ evaluation.slopes
    left_open = np.diag(np.linalg.inv(information[count:, count:]))
    told = 1 - left_open[[space.extra.index(name) for name in field.names]]
    slope = np.zeros(space.size)
    slope[:count] = -(told @ field.growth(space.unpack(evaluation.free))) @ space.membership
    return np.linalg.solve(information, slope)
