"""The number of control points of Young's modulus that the pulls support, by their evidence.

More control points always fit as well or better; whether the data ask for them is told by the
evidence, the probability of the data under all moduli that the prior allows. Here it is Laplace's
approximation at the end of each fit (MacKay, Information Theory, 2003, ch. 28): the fit less the
factor by which the data narrow the prior. The prior of the steps of log E is that of an
undetermined modulus, for each distance of the control points.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from limber.core.errors import InputError, WorkError
from limber.core.progress import SILENT, Progress
from limber.estimation.estimated_branch import Subject
from limber.estimation.fit import fit_pulls
from limber.estimation.fit_assessment import Estimate
from limber.estimation.fit_preparation import forwards_of, parameter_space
from limber.estimation.fitting.objective import Objective
from limber.estimation.parameters import LINK_DEVIATION, Values
from limber.estimation.settings import EstimateSettings
from limber.estimation.uncertainty.covariance import repeated, scaled_rows
from limber.recordings.recording import Pull

MOST = 6
"""Largest number of control points that is tried."""
LEVEL_DEVIATION = 3.0
"""Prior deviation of the mean log E: a factor of 20."""
LINK_DISTANCE = 0.2
"""Distance of control points, over the path's length, to which ``LINK_DEVIATION`` belongs."""
ALIKE = 1.0
"""Difference of log evidences below which the smaller number is taken."""
WORSE = 3.0
"""Difference of log evidences after which two further control points are not tried."""


def supported_fractions(pulls: Sequence[Pull], subject_with: Callable[[tuple[float, ...]], Subject],
                        settings: EstimateSettings, progress: Progress = SILENT,
                        ) -> tuple[tuple[float, ...], dict[int, float]]:
    """Return the positions of as many control points as the pulls support.

    Args:
        pulls: Each with the rest positions of its observed points.
        subject_with: Makes the branch with control points at these fractions.
        settings: Settings of the fits.

    Returns:
        Positions as fractions of the main path, and the log evidence by their number.

    Raises:
        InputError: the method is not Gauss-Newton.
        WorkError: no number gives a fit.
    """
    if settings.method != "gauss-newton":
        raise InputError("The evidence of control points needs the Gauss-Newton method.",
                         "Nelder-Mead gives no derivatives.",
                         "Omit --method, or give the control points (--fractions).")
    fits: dict[int, Estimate] = {}
    near: tuple[tuple[float, ...], np.ndarray] | None = None
    failure: WorkError | None = None
    for count in range(1, MOST + 1):
        progress((count - 1) / MOST, f"fitting {count} control points")
        fractions = equal_fractions(count)
        try:
            found = _fitted(list(pulls), subject_with(fractions), settings, near, fractions)
        except WorkError as error:
            failure = error
            continue
        fits[count], near = found, (fractions, found.values.young)
        known = evidences(fits)
        if max(list(known.values())[-2:]) < max(known.values()) - WORSE:
            break
    if not fits:
        assert failure is not None
        raise failure
    known = evidences(fits)
    alike = [count for count in known if known[count] > max(known.values()) - ALIKE]
    return equal_fractions(min(alike)), known


def equal_fractions(count: int) -> tuple[float, ...]:
    """Return control points at equal distances from each other and from base and tip."""
    return tuple((k + 1) / (count + 1) for k in range(count))


def evidences(fits: dict[int, Estimate]) -> dict[int, float]:
    """Return the log evidence of each fit by its number of control points.

    All are compared with one noise: that of the residuals of the fit that is closest.
    """
    closest = min(fits.values(), key=lambda found: found.fit.evaluation.mean_square)
    noise = closest.fit.evaluation.mean_square * repeated(
        closest.objective.standardised(closest.fit.evaluation))
    return {count: _log_evidence(found, noise) for count, found in fits.items()}


def _log_evidence(found: Estimate, noise: float) -> float:
    evaluation, space = found.fit.evaluation, found.objective.space
    count = len(space.groups)
    # Links are a prior of the steps as well.
    kept = len(evaluation.residual) - len(space.links)
    own = space.own_row_count - len(space.links)
    residual = scaled_rows(evaluation.residual[:kept, None], own, noise)[:, 0]
    slopes = scaled_rows(evaluation.slopes[:kept], own, noise)
    prior = np.vstack([np.full(count, 1 / (count * LEVEL_DEVIATION)),
                       np.diff(np.eye(count), axis=0) / (
                           LINK_DEVIATION * (1 / (count + 1) / LINK_DISTANCE)**0.5)])
    log_young = np.log(found.values.young)
    # The level of the prior is that of the fits, which agree about it.
    off = prior @ (log_young - log_young.mean())
    rows = np.hstack([prior @ space.membership, np.zeros((count, len(space.extra)))])
    information = slopes.T @ slopes + rows.T @ rows
    return float(-0.5 * residual @ residual - 0.5 * off @ off
                 + np.linalg.slogdet(prior)[1] - 0.5 * np.linalg.slogdet(information)[1])


def _fitted(pulls: list[Pull], subject: Subject, settings: EstimateSettings,
            near: tuple[tuple[float, ...], np.ndarray] | None,
            fractions: tuple[float, ...]) -> Estimate:
    quick = settings.model_copy(update={"fractions": fractions, "hold_out": False,
                                        "forward": "full"})
    forwards = forwards_of(pulls, subject, quick)
    objective = Objective(forwards, parameter_space(subject, forwards, quick),
                          force_sigma=[pull.entry.sensor.force_sigma_n for pull in pulls])
    start: Values | None = None
    if near is not None:
        start = replace(subject.start, young=np.exp(np.interp(fractions, near[0],
                                                              np.log(near[1]))))
    return fit_pulls(objective, subject.start, quick, near=start, quick=True)
