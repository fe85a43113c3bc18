"""Intervals of poorly determined moduli, from the profile likelihood instead of its curvature.

A pull measures the compliance of a soft piece: the stiffer the piece, the less the data depend on
its modulus. The modulus may then be several times the most likely value, where the curvature at the
optimum allows a factor of two to both sides; other intervals extend farther to the soft side. The
limits are where the likelihood of the measurements has decreased as much as at the limits of a
normal distribution, with all other values refitted (the profile likelihood; Venzon and Moolgavkar
1988).
"""

from dataclasses import replace

import numpy as np
import scipy

from limber.core.progress import SILENT, Progress
from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.fitting.optimise import OUTLYING
from limber.estimation.parameters import LINK_DEVIATION
from limber.estimation.uncertainty.covariance import Uncertainty, inverse_information, scaled_rows

WIDE = 0.4
"""Half width of an interval of log E, a factor of 1.5, above which its limits are computed. In the
trials of the bench, limits of narrower ones move by less than a fifth of the half width, to either
side.
"""
TRIES = 4
"""Most simulations for one limit; observed were 1 to 4."""
NEAR = 0.1
"""Change of log E below which a limit has converged."""


def profiled(sure: Uncertainty, evaluation: Evaluation, objective: Objective,
             progress: Progress = SILENT) -> Uncertainty:
    """Return the uncertainty with the limits of wide intervals from the profile likelihood.

    The covariance is not changed. It applies to quantities that depend on the moduli as the
    measurements do. These are linear in the compliance, and change by as much as the covariance
    states even if the modulus is already far beyond it.

    Args:
        evaluation: At the end of the fit, with derivatives.
        objective: The minimised objective. It is not changed.
    """
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
    lower, upper = (np.exp(each[0]) for each in space.bounds())
    return replace(sure, young_interval=np.clip(interval, lower, upper))


class _Profile:
    """Decrease of the likelihood of the measurements if one log E is held off its optimum."""

    def __init__(self, sure: Uncertainty, evaluation: Evaluation, objective: Objective,
                 progress: Progress):
        self._best, self._objective, self._quantile = evaluation, objective, sure.quantile
        self._progress = progress
        self._scale = sure.variance_factor * sure.repetition
        self._slopes = self._scaled(evaluation.slopes)
        self._covariance = inverse_information(self._slopes)
        self.deviations = np.sqrt(np.diag(self._covariance))
        # As in the fit, an outlier has no more weight than a residual just beyond the others.
        residual = evaluation.residual
        self._pull = self._scaled(residual / np.sqrt(1 + (residual / OUTLYING)**2))
        # Priors and links are linear: they have no curvature to account for.
        self._pull[len(residual) - objective.space.own_row_count:] = 0.0

    def limits(self, group: int) -> tuple[float, float]:
        """Distances of log E at which the interval of a group ends, to the soft and stiff side."""
        # The stiff side is safe to evaluate. It keeps the soft side away from moduli without an
        # equilibrium.
        high, bend = self._limit(group, 1.0, self._quantile)
        low, _ = self._limit(group, -1.0, max(limit_of(bend, -self._quantile), -self._quantile))
        if high > self._quantile and high == self._farthest(group, 1.0):
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
        farthest, bend = self._farthest(group, side), 0.0
        at, others = side * min(abs(first), abs(farthest)), np.zeros(len(self._best.free))
        for _ in range(TRIES):
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
        """Rise of the squared residuals with log E shifted by ``at`` deviations, and the offset of
        the others from the linear path there; None if no equilibrium exists.

        Args:
            others: Expected offset of the others, shape [p].
        """
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
        return float(rise), free - best.free - direction + step

    def _scaled(self, rows: np.ndarray) -> np.ndarray:
        return scaled_rows(rows, self._objective.space.own_row_count, self._scale)


def bend_of(at: float, root: float) -> float:
    """Curvature of a profile through a point: a of (1 - exp(-a x)) / a.

    That is the root of the rise if the measurements are linear in a power of the modulus: its
    exponent is -a over the deviation of log E; -1 is the compliance, 0 log E itself.

    Args:
        at: Shift x of log E in its deviations, not 0.
        root: Root of the rise of the squared residuals there, with the sign of the shift.
    """
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
