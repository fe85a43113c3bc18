"""Uncertainty of an estimate: covariance and intervals, and measurements that do not fit."""

from dataclasses import dataclass
from typing import TypedDict

import numpy as np
import scipy

from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.uncertainty.drift import scale_steps
from limber.recordings.cell_errors import calibration_of

OUTLIER = 4.5
"""Standardised residual (RMS over axes) above which a measurement is reported as an outlier.
Chosen, not measured: far beyond normal noise.
"""
OUTLIER_SHARE = 0.15
"""Fraction of distant residuals above which the others do not give the true noise. Chosen."""


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of the free vector and of the moduli.

    Attributes:
        covariance: Covariance of the free vector, shape [p, p].
        young_interval: 95 % intervals at the control points [Pa], shape [K, 2].
        variance_factor: Mean squared residual over the expected one; 1 if the noise is as stated.
        correlation: Correlation of the free vector, shape [p, p].
        repetition: Number of successive frames with the same error: 1 if their errors are
            independent.
        recording_spread: Standard deviation of log E between recordings, common to all moduli.
        quantile: Number of deviations in the half width of a 95 % interval (Student's t).
    """

    covariance: np.ndarray
    young_interval: np.ndarray
    variance_factor: float
    correlation: np.ndarray
    repetition: float = 1.0
    recording_spread: float = 0.0
    quantile: float = 1.96


def uncertainty(evaluation: Evaluation, objective: Objective, level: float = 0.95) -> Uncertainty:
    """Gauss' approximation at the end of the fit.

    The stated noise is scaled according to the residuals, each kind of residual weighted as in the
    fit; a robust fraction of the residuals is used, so that outliers do not widen the interval.
    Errors that persist from frame to frame, such as those of points found in depth images, do not
    average out: the covariance is multiplied by the number of frames with the same error. The error
    of the mesh is not included (:mod:`limber.estimation.uncertainty.model_error`).
    """
    # Priors and links are not measurements: they do not determine the noise, and its scale does not
    # apply to them.
    count = len(evaluation.residual) - objective.space.own_row_count
    jacobian, residual = evaluation.slopes[:count], evaluation.residual[:count]
    freedom = max(len(residual) - jacobian.shape[1] - evaluation.unknown_count, 1)
    # Huber's proposal: residuals beyond 3 deviations count as 3. If there are many, they are not
    # outliers, but the model does not fit.
    limit = 3 * _scale(residual)
    stray = float(np.mean(np.abs(residual) > 1.5 * limit))
    clipped = np.clip(residual, -limit, limit) if stray < OUTLIER_SHARE else residual
    factor = float(clipped @ clipped / freedom)
    if _from_images(objective):
        # Their stated error persists from frame to frame: a smaller scatter of the residuals does
        # not show that it is smaller.
        factor = max(factor, 1.0)
    repetition = repeated(objective.standardised(evaluation))
    covariance = inverse_information(scaled_rows(evaluation.slopes, objective.space.own_row_count,
                                                 factor * repetition))
    from_recording = recording_spread(evaluation, objective, factor * repetition)
    together = np.zeros(len(covariance))
    together[:objective.space.group_count] = 1.0
    covariance += np.outer(together, together) * from_recording**2 / len(objective.forwards)
    deviation = np.sqrt(np.diag(covariance))
    quantile = float(scipy.special.stdtrit(freedom, 0.5 + level / 2))
    width = quantile * deviation
    space = objective.space
    # Wider than 30 orders of magnitude means unknown.
    width = np.minimum(width, 70.0)
    centre = evaluation.free
    low, high = space.unpack(centre - width), space.unpack(centre + width)
    bounds = np.exp(space.bounds()[0][0]), np.exp(space.bounds()[1][0])
    interval = np.clip(np.column_stack([low.young, high.young]), *bounds)
    return Uncertainty(covariance, interval, factor,
                       covariance / np.maximum(np.outer(deviation, deviation), 1e-300), repetition,
                       from_recording, quantile)


def scaled_rows(rows: np.ndarray, own_row_count: int, scale: float) -> np.ndarray:
    """Standardised residuals, or their slopes, scaled by the noise of the residuals.

    Args:
        rows: As of an evaluation; the last are priors and links, which are not scaled.
        own_row_count: Number of these.
        scale: Variance of the measurements over the stated one.
    """
    scaled, count = rows.copy(), len(rows) - own_row_count
    scaled[:count] /= np.sqrt(max(scale, 1e-300))
    return scaled


def inverse_information(slopes: np.ndarray) -> np.ndarray:
    """Covariance of the free vector from slopes [r, p] of residuals of unit variance, [p, p]."""
    _, values, rows = np.linalg.svd(slopes, full_matrices=False)
    spread = rows.T / np.maximum(values, 1e-9 * max(values[0], 1e-300))
    return spread @ spread.T


def recording_spread(evaluation: Evaluation, objective: Objective, scale: float) -> float:
    """Standard deviation of log E between recordings, common to all moduli.

    Each pull alone gives a step of the common scale, known to within its own noise; the excess
    scatter of these steps is the spread (DerSimonian and Laird's random effect). Few pulls
    determine it badly, so the calibration's value counts as one further recording.

    Args:
        scale: Variance of the measurements over the stated one.
    """
    stated = float(np.mean([calibration_of(forward.entry).repeat_sigma
                            for forward in objective.forwards]))
    count = len(objective.forwards)
    if count < 2 or stated == 0.0:
        return stated
    found = scale_steps(evaluation, objective, scale)
    steps, variances = [each.step for each in found], [each.variance for each in found]
    if len(steps) < 2:
        return stated
    weights = 1 / np.array(variances)
    mean = np.average(steps, weights=weights)
    excess = float(weights @ (np.array(steps) - mean)**2) - (len(steps) - 1)
    between = max(excess, 0.0) / (weights.sum() - (weights**2).sum() / weights.sum())
    return float(np.sqrt((stated**2 + (len(steps) - 1) * between) / len(steps)))


def repeated(series: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Integrated autocorrelation of residuals over the frames, all points and axes together.

    1 + 2 sum of the correlations at increasing lags, up to the first that is below its own noise,
    or well beyond the current result (Sokal's estimate of the number of samples of a sequence per
    independent sample).

    Args:
        series: Per pull, residuals of points [f, m, 3] and of force [f, 3], NaN if there are none.
    """
    product, count = np.zeros(0), np.zeros(0)
    for points, forces in series:
        columns = np.hstack([points.reshape(len(points), -1), forces])
        # An outlier would hide the correlation of all others.
        columns = np.clip(columns, -4.0, 4.0)
        known = np.isfinite(columns)
        values = np.where(known, columns, 0.0)
        lags = len(columns) // 2
        product, count = (np.pad(a, (0, max(lags - len(a), 0))) for a in (product, count))
        for lag in range(lags):
            product[lag] += np.sum(values[:len(values) - lag] * values[lag:])
            count[lag] += np.sum(known[:len(known) - lag] & known[lag:])
    if len(product) < 3 or product[0] <= 0:
        return 1.0
    correlation = product / product[0]
    total = 1.0
    for lag in range(1, len(correlation)):
        if correlation[lag] < 2.0 / np.sqrt(count[lag]) or lag > 2.5 * total:
            break
        total += 2.0 * correlation[lag]
    return float(total)


class Outlier(TypedDict):
    """A measurement that does not fit: its pull, time [s], kind, and number of deviations."""

    pull: str
    time_s: float
    what: str
    deviations: float


def outliers(evaluation: Evaluation, objective: Objective, limit: int = 10) -> list[Outlier]:
    """Name the measurements that do not fit, worst first: pull, time, point or force, deviations.
    """
    found: list[Outlier] = []
    for forward, (points, forces) in zip(objective.forwards, objective.scored(evaluation),
                                         strict=True):
        for frame, point in np.argwhere(points > OUTLIER):
            found.append({"pull": forward.name, "time_s": float(forward.frames.times[frame]),
                          "what": f"point {point + 1}",
                          "deviations": float(points[frame, point])})
        if forward.uses_force:
            for frame in np.flatnonzero(forces > OUTLIER):
                found.append({"pull": forward.name, "time_s": float(forward.frames.times[frame]),
                              "what": "force", "deviations": float(forces[frame])})
    return sorted(found, key=lambda entry: -entry["deviations"])[:limit]


def _from_images(objective: Objective) -> bool:
    return any(forward.entry.observation in ("depth", "clouds") for forward in objective.forwards)


def _scale(residual: np.ndarray) -> float:
    return max(1.4826 * float(np.median(np.abs(residual))), 1e-12)
