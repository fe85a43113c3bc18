"""Uncertainty of an estimate: covariance and intervals, and measurements that do not fit."""

from dataclasses import dataclass, replace

import numpy as np
import scipy
from typing_extensions import TypedDict

from limber.core.progress import SILENT, Progress
from limber.estimation.fitting import optimise
from limber.estimation.fitting.nuisances import OTHER_CAUSES, advice_on
from limber.estimation.fitting.objective import Evaluation, Objective, Work, inverse_information
from limber.estimation.parameters import LINK_DEVIATION, ParameterSpace, YoungField
from limber.estimation.uncertainty.drift import scale_steps
from limber.recordings.recording import calibration_of

OUTLIER = 4.5
"""Standardised residual (RMS over axes) above which a measurement is reported as an outlier.
Chosen, not measured: far beyond normal noise.
"""
OUTLIER_SHARE = 0.15
"""Fraction of distant residuals above which the others do not give the true noise. Chosen."""


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of the free vector [p, p] and 95 % of the moduli [K, 2] [Pa]. ``variance_factor``
    is squared residual over expected (1: as stated), ``repetition`` the frames in a row that err
    alike, ``quantile`` the half width of 95 % in deviations (Student's t)."""

    covariance: np.ndarray
    young_interval: np.ndarray
    variance_factor: float
    correlation: np.ndarray
    repetition: float = 1.0
    recording_spread: float = 0.0
    quantile: float = 1.96


def uncertainty(evaluation: Evaluation, objective: Objective, left: np.ndarray | None = None,
                ) -> Uncertainty:
    """Return Gauss' approximation at a fit's end, without the mesh's error (:mod:`.model_error`);
    the step ``left`` [p] of a fit that did not end counts as an error of one deviation."""
    factor, repetition, freedom = noise_of(evaluation, objective)
    covariance = inverse_information(scaled_rows(evaluation.slopes, objective.space.own_row_count,
                                                 factor * repetition))
    from_recording = recording_spread(evaluation, objective, factor * repetition)
    together = np.zeros(len(covariance))
    together[:objective.space.group_count] = 1.0
    covariance += np.outer(together, together) * from_recording**2 / len(objective.forwards)
    covariance += 0.0 if left is None else np.outer(left, left)
    deviation = np.sqrt(np.diag(covariance))
    quantile = float(scipy.special.stdtrit(freedom, 0.975))
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


def noise_of(evaluation: Evaluation, objective: Objective) -> tuple[float, float, int]:
    """Return the noise's variance over the stated one, by a robust part of the residuals, weighted
    as in the fit; the frames in a row that err alike, whose errors do not average out; and the
    degrees of freedom."""
    # Priors and links are not measurements: they do not determine the noise, and its scale does not
    # apply to them.
    residual = evaluation.residual[:len(evaluation.residual) - objective.space.own_row_count]
    freedom = max(len(residual) - objective.space.size - evaluation.unknown_count, 1)
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
    return factor, repeated(objective.standardised(evaluation)), freedom


def weighed(fit: optimise.Fit, objective: Objective) -> optimise.Fit:
    """Fit again with measurements and priors by the noise that the residuals show. A misfit that is
    alike in all frames would else draw unknowns far beyond their priors: four frames of a hung
    weight, Poisson's ratio."""
    factor, repetition, _ = noise_of(fit.evaluation, objective)
    objective.variance = factor * repetition
    return optimise.gauss_newton(objective, fit.evaluation.free, is_near=True)


def scaled_rows(rows: np.ndarray, own_row_count: int, scale: float) -> np.ndarray:
    """Standardised residuals, or slopes, by the noise's variance over the stated one; the last
    ``own_row_count``, priors and links, stay."""
    scaled, count = rows.copy(), len(rows) - own_row_count
    scaled[:count] /= np.sqrt(max(scale, 1e-300))
    return scaled


def recording_spread(evaluation: Evaluation, objective: Objective, scale: float) -> float:
    """Return the deviation of log E between recordings: scatter of the pulls' steps beyond noise
    (DerSimonian and Laird's random effect), with the calibration's value as one more."""
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
    """Return the integrated autocorrelation of residuals [f, m, 3], [f, 3] (NaN: none): 1 + 2 sum
    of correlations, to the first below its noise or well beyond the result (Sokal)."""
    product, count = np.zeros(0), np.zeros(0)
    for points, forces in series:
        columns = np.hstack([points.reshape(len(points), -1), forces])
        # An outlier would hide the correlation of all others.
        columns = np.clip(columns, -4.0, 4.0)
        known = np.isfinite(columns)
        values = np.where(known, columns, 0.0)
        lags = len(columns) // 2 + 1
        product, count = (np.pad(a, (0, max(lags - len(a), 0))) for a in (product, count))
        for lag in range(lags):
            product[lag] += np.sum(values[:len(values) - lag] * values[lag:])
            count[lag] += np.sum(known[:len(known) - lag] & known[lag:])
    if len(product) < 2 or product[0] <= 0:
        return 1.0
    correlation = product / product[0]
    total = 1.0
    for lag in range(1, len(correlation)):
        if correlation[lag] < 2.0 / np.sqrt(count[lag]) or lag > 2.5 * total:
            break
        total += 2.0 * correlation[lag]
    return float(min(total, max(len(points) for points, _ in series)))


class Outlier(TypedDict):
    """A measurement that does not fit: its pull, time [s], kind, and number of deviations."""

    pull: str
    time_s: float
    what: str
    deviations: float


def outliers(evaluation: Evaluation, objective: Objective, limit: int = 10) -> list[Outlier]:
    """Name the measurements that do not fit, worst first: pull, time, point or force, deviation."""
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


# The most likely moduli over all forms of their field, not for the most likely form alone.
#
# A fit ends at the most likely combination of moduli and form. But the effect of the form increases
# with the difference of neighbouring moduli: with steeper moduli a pull leaves a smaller fraction
# of the prior forms possible, which the most likely form does not show. With the form integrated
# out by Laplace's approximation, the density of the moduli is that along the fit's valley over the
# root of the determinant of the information on all other unknowns. Its mode is at smaller steps: by
# one or two hundredths of a modulus, if the form matters.

LONGEST_STEP = 0.5
"""In standard deviations; beyond it the approximation is invalid, and the fit is kept."""


def averaged(fit: optimise.Fit, objective: Objective) -> optimise.Fit:
    """Return the fit moved by the short step that was left, and to the mode of the moduli's
    marginal density if the form of the field is an unknown."""
    field, free = objective.forwards[0].field, fit.evaluation.free
    step = np.zeros(len(free)) if fit.left is None else fit.left
    if field.names and set(field.names) <= set(objective.space.extra):
        slopes = scaled_rows(fit.evaluation.slopes, objective.space.own_row_count,
                             objective.variance)
        to_mode = marginal_step(free, slopes, objective.space, field)
        step = step + to_mode * bool(np.linalg.norm(slopes @ to_mode) < LONGEST_STEP)
    found = objective.moved(fit.evaluation, step)
    return fit if found is None else optimise.Fit(found, fit.status, fit.reason)


def marginal_step(free: np.ndarray, slopes: np.ndarray, space: ParameterSpace,
                  field: YoungField) -> np.ndarray:
    """Step [p] from the joint mode to the marginal one, by derivatives [r, p] of residuals of unit
    variance; the field's further unknowns are free."""
    count = space.group_count
    information = slopes.T @ slopes
    left_open = np.diag(np.linalg.inv(information[count:, count:]))
    informed = 1 - left_open[[space.extra.index(name) for name in field.names]]
    slope = np.zeros(space.size)
    slope[:count] = -(informed @ field.growth(space.unpack(free))) @ space.membership
    return np.linalg.solve(information, slope)


# Causes of the uncertainty of a modulus, as parts that add up to its variance.
#
# With the information of all measurements and priors in rows J, the covariance is C = (J^T J)^-1,
# and C = sum over groups of rows of C J_g^T J_g C: each group's part is the effect of its errors on
# the result through the fit. The unknown zero of a force sensor uses up part of the information;
# that is included in the part of the measurements that determine it.

@dataclass(frozen=True)
class InformationRows:
    """Rows of information from one origin over free vector, errors and force unknowns. ``name`` is
    the unknown of a prior (empty: measured, or a link), ``pull`` None for priors and links."""

    cause: str
    rows: np.ndarray
    name: str = ""
    pull: int | None = None


def variance_parts(evaluation: Evaluation, objective: Objective, scale: float = 1.0,
                   ) -> dict[str, np.ndarray]:
    """Return each cause's part [K] in the variance of log E; ``scale`` is the measurements'
    variance over the stated one."""
    rows = information_rows(evaluation, objective, scale)
    covariance = inverse_information(np.vstack([each.rows for each in rows]))
    total = covariance[list(objective.space.groups)]
    parts: dict[str, np.ndarray] = {}
    for each in rows:
        part = np.sum((total @ each.rows.T)**2, axis=1)
        parts[each.cause] = parts.get(each.cause, 0.0) + part
    return parts


class Cause(TypedDict):
    """One cause of the moduli's variance; see :func:`largest`."""

    cause: str
    share: float
    deviation: float
    advice: str


def largest(parts: dict[str, np.ndarray], count: int = 3) -> list[Cause]:
    """Return the causes of most variance: ``share`` (mean over moduli), ``deviation`` (largest of a
    log E from it) and ``advice``."""
    total = np.sum(list(parts.values()), axis=0)
    share = {cause: float(np.mean(part / np.maximum(total, 1e-300)))
             for cause, part in parts.items()}
    order = sorted(parts, key=lambda cause: -share[cause])[:count]
    return [{"cause": cause, "share": share[cause],
             "deviation": float(np.sqrt(np.max(parts[cause]))), "advice": advice_on(cause)}
            for cause in order if share[cause] > 0.01]


def information_rows(evaluation: Evaluation, objective: Objective, scale: float,
                     ) -> list[InformationRows]:
    """Return rows of all unknowns: free vector, errors, and each pull's course of the force.
    Arguments as for :func:`variance_parts`."""
    space, count = objective.space, objective.cell_errors.count
    pieces = objective.raw_slopes(evaluation)
    unknowns = [0 if piece.response is None else piece.response.shape[1] for piece in pieces]
    width = space.size + count + sum(unknowns)
    rows, start = [], space.size + count
    for number, (piece, unknown) in enumerate(zip(pieces, unknowns, strict=True)):
        block = np.zeros((len(piece.free), width))
        block[:, :space.size] = piece.free
        block[:, space.size:space.size + count] = piece.errors
        if unknown:
            block[:, start:start + unknown] = piece.response
        start += unknown
        block /= np.sqrt(scale)
        kinds = np.array(piece.kinds)
        rows += [InformationRows(kind, block[kinds == kind], pull=number)
                 for kind in dict.fromkeys(piece.kinds)]
    for number, nuisance in enumerate(objective.cell_errors.nuisances):
        row = np.zeros((1, width))
        row[0, space.size + number] = 1.0
        rows.append(InformationRows(nuisance.unknown.cause.name, row, nuisance.name))
    own, _ = space.own_rows()
    names = [name for name, _, _ in space.priors] + [""] * len(space.links)
    for name, row in zip(names, own, strict=True):
        # The field's form has several unknowns.
        cause = OTHER_CAUSES["form" if name.startswith("form") else name or "link"]
        wide = np.r_[row, np.zeros(width - space.size)][None]
        rows.append(InformationRows(cause.name, wide, name))
    return rows


# Intervals of poorly determined moduli, from the profile likelihood instead of its curvature.
#
# A pull measures the compliance of a soft piece: the stiffer the piece, the less the data depend on
# its modulus. The modulus may then be several times the most likely value, where the curvature at
# the optimum allows a factor of two to both sides; other intervals extend farther to the soft side.
# The limits are where the likelihood of the measurements has decreased as much as at the limits of
# a normal distribution, with all other values refitted (the profile likelihood; Venzon and
# Moolgavkar 1988).

WIDE = 0.4
"""Half width of an interval of log E, a factor of 1.5, above which its limits are computed. In the
trials of the bench, limits of narrower ones move by less than a fifth of the half width, to either
side.
"""
TRIES = 4
"""Most simulations for one limit; observed were 1 to 4."""
NEAR = 0.1
"""Change of log E below which a limit has converged."""
LIMITS_SHARE = 0.25
"""Part of a fit's budget for the limits of wide intervals."""


def profiled(sure: Uncertainty, evaluation: Evaluation, objective: Objective,
             progress: Progress = SILENT) -> tuple[Uncertainty, Evaluation | None, Objective]:
    """Return the uncertainty with wide intervals by the profile likelihood. The covariance stays:
    it holds for what depends on the moduli as measurements do, linear in the compliance. Beside it
    a place that leads to a lower loss, if one was met: there is no end of the fit then."""
    space = objective.space
    found = _Profile(sure, evaluation, objective, progress)
    interval = sure.young_interval.copy()
    for group in range(space.group_count):
        # A single modulus does not show the spread between recordings that all moduli share.
        whole = sure.quantile * np.sqrt(sure.covariance[group, group])
        if whole < WIDE:
            continue
        common = np.sqrt(max(whole**2 - (sure.quantile * found.deviations[group])**2, 0.0))
        low, high = found.limits(group)
        sides = [-np.hypot(low, common), np.hypot(high, common)]
        members = np.array(space.groups) == group
        interval[members] = np.exp(evaluation.free[group] + sides)
    if found.work.left <= 0:
        progress.warn("The budget was spent before the limits of all wide intervals were found: "
                      "those end at the largest plausible ratio to the neighbour's modulus.")
    lower, upper = (np.exp(each[0]) for each in space.bounds())
    return (replace(sure, young_interval=np.clip(interval, lower, upper)), found.lower,
            found.objective)


class _Profile:
    """Decrease of the likelihood of the measurements if one log E is held off its optimum."""

    def __init__(self, sure: Uncertainty, evaluation: Evaluation, objective: Objective,
                 progress: Progress):
        self._best, self._objective, self._quantile = evaluation, objective, sure.quantile
        self._progress, self.work = progress, Work(LIMITS_SHARE)
        self._scale = sure.variance_factor * sure.repetition
        self.lower: Evaluation | None = None
        # A fit is beside the end of its descent, at the mode.
        self.objective, self._cost = objective, optimise.cost_of(
            evaluation, objective) - (optimise.UNSETTLED_FALL + LONGEST_STEP**2 / 2) * self._scale
        self._slopes = self._scaled(evaluation.slopes)
        self._covariance = inverse_information(self._slopes)
        self.deviations = np.sqrt(np.diag(self._covariance))
        # As in the fit, an outlier has no more weight than a residual just beyond the others.
        residual = evaluation.residual
        self._pull = self._scaled(residual / np.sqrt(1 + (residual / optimise.OUTLYING)**2))
        # Priors and links are linear: they have no curvature to account for.
        self._pull[len(residual) - objective.space.own_row_count:] = 0.0

    def limits(self, group: int) -> tuple[float, float]:
        """Distances of log E at which the interval of a group ends, to the soft and stiff side."""
        # The stiff side is safe to evaluate. It keeps the soft side away from moduli without an
        # equilibrium.
        high, bend = self._limit(group, 1.0, self._quantile)
        low, _ = self._limit(group, -1.0, max(limit_of(bend, -self._quantile), -self._quantile))
        if self.work.left > 0 and high > self._quantile and high == self._farthest(group, 1.0):
            self._progress.warn(
                f"These pulls give no upper limit of {self._objective.space.names[group]}: a "
                "stiffer piece would hardly change the measurements. Its interval ends at the "
                "largest plausible ratio to its neighbour's modulus (a factor of "
                f"{np.exp(self._quantile * LINK_DEVIATION):.2g}). To determine it, pull at a "
                "point farther out, or pull farther.")
        deviation = self.deviations[group]
        return -low * deviation, high * deviation

    def _limit(self, group: int, side: float, first: float) -> tuple[float, float]:
        """Limit to one side, in deviations, and the curvature of the profile up to there."""
        objective, target = self._objective.on_copies(), side * self._quantile
        objective.work = self.work
        farthest, bend = self._farthest(group, side), 0.0
        at, others = side * min(abs(first), abs(farthest)), np.zeros(len(self._best.free))
        for _ in range(TRIES):
            if self.work.left <= 0:
                return self._farthest(group, side), bend
            self._progress(1.0, "finding the limits of wide intervals")
            found = self._rise(objective, group, at, others)
            if found is None:
                # There is no equilibrium, or it is not found from so far away.
                at, others = at / 2, others / 2
                continue
            rise, others = found
            bend = bend_of(at, side * np.sqrt(max(rise, 0.0)))
            aim = side * min(abs(limit_of(bend, target)), 2 * abs(at), abs(farthest))
            if abs(aim - at) * self.deviations[group] < NEAR:
                return aim, bend
            at, others = aim, others * aim / at
        return side * min(abs(limit_of(bend, target)), abs(farthest)), bend

    def _farthest(self, group: int, side: float) -> float:
        """Largest shift that is evaluated, in deviations: neighbours hardly differ by more."""
        free, count = self._best.free, self._objective.space.group_count
        beside = [k for k in (group - 1, group + 1) if 0 <= k < count] or [group]
        away = max(side * (free[k] - free[group]) for k in beside) + self._quantile * LINK_DEVIATION
        return side * max(away / self.deviations[group], self._quantile)

    def _rise(self, objective: Objective, group: int, at: float, others: np.ndarray,
              ) -> tuple[float, np.ndarray] | None:
        """Return the rise of squared residuals ``at`` deviations of log E, and the others' offset
        [p] from the linear path, guessed as ``others``; None if there is no equilibrium."""
        best = self._best
        direction = at * self._covariance[group] / self.deviations[group]
        free = np.clip(best.free + direction + others, *objective.space.bounds())
        found = objective.evaluate(free, jacobian=True)
        if found is None:
            return None
        slopes = self._scaled(found.slopes)
        change = self._scaled(found.residual - best.residual)
        # The optimum is the mode of the moduli's marginal density, not of this one: the rise is
        # relative to the slope there.
        bent = change - self._slopes @ (free - best.free)
        gradient = slopes.T @ change + (slopes - self._slopes).T @ self._pull
        movable = np.arange(len(free)) != group
        step = np.zeros(len(free))
        step[movable] = -np.linalg.lstsq(slopes[:, movable].T @ slopes[:, movable],
                                         gradient[movable], rcond=None)[0]
        rise = change @ change + 2 * self._pull @ bent - np.sum((slopes @ step)**2)
        if (cost := optimise.cost_of(found, objective)) < self._cost:
            self.lower, self.objective, self._cost = found, objective, cost
        return float(rise), free - best.free - direction + step

    def _scaled(self, rows: np.ndarray) -> np.ndarray:
        return scaled_rows(rows, self._objective.space.own_row_count, self._scale)


def bend_of(at: float, root: float) -> float:
    """Return the curvature a of (1 - exp(-a x)) / a through the ``root`` of the rise at x = ``at``
    deviations. The root has this form if measurements are linear in a power of the modulus: -a over
    the deviation of log E (-1: compliance, 0: log E)."""
    ratio = float(np.clip(root / at, 0.01, 100.0))
    if abs(ratio - 1) < 1e-6:
        return 0.0
    ends = (1e-9, 200.0) if ratio < 1 else (-20.0, -1e-9)
    return scipy.optimize.brentq(lambda step: -np.expm1(-step) / step - ratio, *ends) / at


def limit_of(bend: float, root: float) -> float:
    """Shift at which such a profile has risen to ``root``; infinite if it never does."""
    if bend * root >= 1:
        return float(np.copysign(np.inf, root))
    return root if bend == 0 else float(-np.log1p(-bend * root) / bend)
