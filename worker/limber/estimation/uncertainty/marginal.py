"""The most likely moduli over all forms of their field, not for the most likely form alone.

A fit ends at the most likely combination of moduli and form. But the effect of the form increases
with the difference of neighbouring moduli: with steeper moduli a pull leaves a smaller fraction of
the prior forms possible, which the most likely form does not show. With the form integrated out by
Laplace's approximation, the density of the moduli is that along the fit's valley over the root of
the determinant of the information on all other unknowns. Its mode is at smaller steps: by one or
two hundredths of a modulus, if the form matters.
"""

import numpy as np

from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.fitting.optimise import Fit
from limber.estimation.forward.dynamic_pull import DynamicForward
from limber.estimation.forward.quasi_static import QuasiStaticForward
from limber.estimation.interpolation_prior import YoungField
from limber.estimation.parameters import ParameterSpace

LONGEST_STEP = 0.5
"""In standard deviations; beyond it the approximation is invalid, and the fit is kept."""


def averaged(fit: Fit, objective: Objective) -> Fit:
    """Return the fit moved to the mode of the moduli's marginal density; unchanged if the form of
    the field is not an unknown.
    """
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
    """Step from the joint mode to the marginal one in the free vector, shape [p].

    Args:
        evaluation: At the end of the fit, with derivatives.
        field: Its further unknowns are among the free ones.
    """
    count = space.group_count
    information = evaluation.slopes.T @ evaluation.slopes
    left_open = np.diag(np.linalg.inv(information[count:, count:]))
    informed = 1 - left_open[[space.extra.index(name) for name in field.names]]
    slope = np.zeros(space.size)
    slope[:count] = -(informed @ field.growth(space.unpack(evaluation.free))) @ space.membership
    return np.linalg.solve(information, slope)
