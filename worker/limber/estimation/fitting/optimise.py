"""The optimisers: the paper's Nelder-Mead, and Gauss-Newton with exact sensitivities."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import scipy

from limber.core.errors import Cancelled, Option, Text, WorkError
from limber.estimation.fitting.objective import Evaluation, Objective

EVALUATION_LIMIT = 400
"""Forward simulations of all pulls, after which a fit that still moves is given up."""
LEAST_DAMPING, FIRST_DAMPING, MOST_DAMPING = 1e-3, 0.02, 1e3
"""Damping, over the squares of the slopes: of a step tried again the second; under the first none
is left, above the last no step descends."""
LONGEST_STEP = 1.1
"""Longest step of Gauss-Newton in a log E, a factor of three: beyond it no linearisation holds."""
OUTLYING = 3.0
"""Standard deviations beyond which residuals count linearly in a robust fit."""
SETTLED_ITERATIONS = 4
"""Iterations of Nelder-Mead without change, per corner of its simplex, after which it ends. Chosen.
"""
SETTLED_FALL = 0.01
"""Negligible decrease of half the squared standardised residuals: a seventh of a deviation."""
UNSETTLED_FALL = 0.03
"""Fall of the cost that states settled to half a millimetre do not show: a quarter of a deviation.
"""
SETTLED_STEP = 0.2
"""Length of the remaining step, in standard deviations, at which Gauss-Newton ends. It is taken
with the last simulation of a fit; elsewhere it adds two percent to the deviation.
"""
LEAST_NOISE = 0.025
"""Noise over the stated one below which no simulation shows a shorter step."""
FIRST_SIMPLEX = 0.5
"""Step of Nelder-Mead's first simplex in log E: a factor of 1.6. With 1 it finds the paper's young
branch as fast.
"""
ROUGH_ENDING = 0.02
"""Relative change of the cost at which the first phase of a robust fit ends."""
FORCE_ROUNDS = 6
"""Most linearisations of a measured input force."""
FORCE_SETTLED = 0.1
"""Change of a fit, in standard deviations, below which the course is no longer updated."""


class FitStatus(StrEnum):
    """How a fit ended; the value is the text shown.

    converged: by the optimiser's own criterion.
    out_of_evaluations: no more simulations were allowed.
    out_of_work: its budget was spent; another fit goes on from there.
    misfit: it settled, but farther from the measurements than requested.
    stopped: by the user.
    """

    converged = "converged"
    out_of_evaluations = "out of evaluations"
    out_of_work = "out of budget"
    misfit = "misfit"
    stopped = "stopped"


@dataclass(frozen=True)
class Fit:
    """End of an optimiser: the best evaluation, with derivatives if requested, the reason as text
    with numbers, and the step [p] that it would have taken next."""

    evaluation: Evaluation
    status: FitStatus
    reason: str
    left: np.ndarray | None = None

    @property
    def converged(self) -> bool:
        return self.status is FitStatus.converged

    @property
    def is_unfinished(self) -> bool:
        """Whether the user or the budget ended it on its way."""
        return self.status in (FitStatus.stopped, FitStatus.out_of_work)


def gauss_newton(objective: Objective, start: np.ndarray, *,
                 evaluation_limit: int = EVALUATION_LIMIT, tolerance: float = 3e-5,
                 is_near: bool = False, force_rounds: int = FORCE_ROUNDS,
                 shortest: float = SETTLED_STEP) -> Fit:
    """Levenberg-Marquardt within bounds, at most threefold in a modulus a step. In the end
    residuals beyond ``OUTLYING`` count linearly (soft l1). It ends at a relative change
    ``tolerance`` of the cost or a step ``shortest`` in deviations. WorkError if the start has no
    equilibrium."""
    # Far from the solution all residuals are large, and a robust loss would only slow convergence.
    phases = [(False, ROUGH_ENDING), (True, tolerance)][is_near:]
    search = _Search(objective, evaluation_limit, shortest)
    at = _required(objective, search.inside(start))
    for phase in phases:
        end = search.minimised(at, *phase)
        at = end.evaluation
    for _ in range(force_rounds):
        # Measured input forces are now known better, and so is their effect on the points.
        if end.status is FitStatus.out_of_work or not objective.follow_forces(at):
            break
        before = _required(objective, at.free)
        end = search.minimised(before, *phases[-1])
        at = end.evaluation
        if np.linalg.norm(before.slopes @ (at.free - before.free)) < FORCE_SETTLED:
            break
    return replace(end, evaluation=_required(objective, at.free))


def own_weights(found: Evaluation, objective: Objective) -> np.ndarray:
    """Weights of the rows: the noisier the measurements, the more the priors count, [r]. Less than
    stated they never do: small residuals do not show that what is alike in all frames is small."""
    weights, count = np.ones(len(found.residual)), objective.space.own_row_count
    weights[len(weights) - count:] = max(objective.variance, 1.0)**0.5
    return weights


def cost_of(found: Evaluation, objective: Objective, *, robust: bool = True) -> float:
    """What Gauss-Newton minimises."""
    squares = found.residual**2
    if robust:
        squares = 2 * OUTLYING**2 * (np.sqrt(1 + squares / OUTLYING**2) - 1)
    return 0.5 * float(squares @ own_weights(found, objective)**2)


class _Search:
    """Damped steps from evaluation to evaluation; one that has no equilibrium, or does not descend,
    is tried again with more damping."""

    def __init__(self, objective: Objective, evaluation_limit: int, shortest: float):
        self._objective, self._limit, self._shortest = objective, evaluation_limit, shortest
        self._lower, self._upper = objective.space.bounds()
        # Measurements may be better than stated.
        self._noise = float(np.clip(objective.variance**0.5, LEAST_NOISE, 1.0))

    def inside(self, free: np.ndarray) -> np.ndarray:
        """The vector within the bounds."""
        return np.clip(free, self._lower + 1e-6, self._upper - 1e-6)

    def minimised(self, at: Evaluation, robust: bool, ending: float) -> Fit:
        """Descend from an evaluation to a relative change of cost."""
        def cost(found: Evaluation) -> float:
            return cost_of(found, self._objective, robust=robust)

        damping = 0.0
        for _ in range(self._limit):
            weight = own_weights(at, self._objective)
            if robust:
                weight = weight * (1 + (at.residual / OUTLYING)**2)**-0.25
            slopes, residual = weight[:, None] * at.slopes, weight * at.residual
            full = self._step(at.free, slopes, residual, 0.0)
            length = float(np.linalg.norm(slopes @ full))
            if length < self._shortest * self._noise:
                return Fit(at, FitStatus.converged, "The next step is shorter than "
                           f"{self._shortest * self._noise:.2g} standard deviations.", full)
            if self._objective.work.left <= 0:
                return Fit(at, FitStatus.out_of_work, f"Its budget was spent {length:.2g} standard "
                           "deviations from where it was going.", full)
            step = self._step(at.free, slopes, residual, damping) if damping else full
            longest = float(np.abs(step[:self._objective.space.group_count]).max())
            step *= min(1.0, LONGEST_STEP / max(longest, 1e-12))
            foreseen = 0.5 * float(residual @ residual - np.sum((residual + slopes @ step)**2))
            # Too little is to be gained.
            if damping > MOST_DAMPING or (damping and foreseen < max(
                    ending * cost(at), UNSETTLED_FALL * self._noise**2)):
                return Fit(at, FitStatus.converged, "No step descends.")
            tried = self._objective.evaluate(at.free + step, jacobian=True)
            fall = -np.inf if tried is None else cost(at) - cost(tried)
            if tried is None or fall <= 0:
                damping = max(FIRST_DAMPING, 8 * damping)
                continue
            # Where a full step failed, the next one would too.
            damping = 0.0 if damping < LEAST_DAMPING else (
                damping / 8 if fall > 0.25 * foreseen else 2 * damping)
            was, at = cost(at), tried
            if fall < ending * was:
                return Fit(at, FitStatus.converged, f"The last step changed the cost by less than "
                           f"{ending:g} of it.")
        return Fit(at, FitStatus.out_of_evaluations, f"{self._limit} simulations were not enough.")

    def _step(self, free: np.ndarray, slopes: np.ndarray, residual: np.ndarray, damping: float,
              ) -> np.ndarray:
        """The damped Gauss-Newton step; what would leave the bounds ends there, and the others
        follow."""
        scale = np.sqrt(damping) * np.linalg.norm(slopes, axis=0)
        rows = np.vstack([slopes, np.diag(scale)]) if damping else slopes
        right = np.r_[-residual, np.zeros(len(free))] if damping else -residual
        step, moves = np.zeros(len(free)), np.ones(len(free), bool)
        while moves.any():
            step[moves] = np.linalg.lstsq(rows[:, moves], right - rows[:, ~moves] @ step[~moves],
                                          rcond=None)[0]
            inside = self.inside(free + step) - free
            out = moves & (np.abs(inside - step) > 1e-12)
            if not out.any():
                break
            step[out], moves[out] = inside[out], False
        return step


def nelder_mead(objective: Objective, start: np.ndarray, *,
                evaluation_limit: int = EVALUATION_LIMIT, delta_m2: float | None = None,
                tolerance: float = 1e-3) -> Fit:
    """The paper's estimator (Algorithm 1): Nelder-Mead, restarted from its best with a full simplex
    until that gains nothing. Values free only within priors stay. It stops below ``delta_m2``
    [m^2], the algorithm's delta; when the error settles against the noise (above delta: not
    converged); or when log E and objective span ``tolerance``. WorkError if no candidate has an
    equilibrium."""
    lower, upper = objective.space.bounds()
    rule = _Settling(objective, delta_m2)
    if any(forward.drive == "force" for forward in objective.forwards):
        # The effect of its errors on the points is computed with the derivatives.
        _required(objective, start)

    def cost(free: np.ndarray) -> float:
        rule.count += 1
        found = objective.evaluate(free)
        if found is None or found.objective is None or found.loss is None:
            # The simplex only asks which of its corners is worse.
            return np.inf
        rule.seen(found.objective, found.loss)
        return found.objective

    steps = _first_steps(objective)
    best, value, is_settled = np.clip(start, lower, upper), np.inf, False
    while rule.count < evaluation_limit and not rule.is_small_enough:
        found = _simplex_search(cost, best, steps, (lower, upper), rule, tolerance,
                                evaluation_limit - rule.count)
        gain, value = value - found.fun, float(found.fun)
        best = best.copy()
        best[steps > 0] = found.x
        has_ended = rule.begin_again() or bool(found.success)
        is_settled = has_ended or (is_settled and gain <= SETTLED_FALL)
        if not has_ended or gain <= SETTLED_FALL:
            break
    return Fit(_required(objective, best), *rule.verdict(is_settled, evaluation_limit))


def _simplex_search(cost: Callable[[np.ndarray], float], begin: np.ndarray, steps: np.ndarray,
                    bounds: tuple[np.ndarray, np.ndarray], rule: "_Settling", tolerance: float,
                    limit: int) -> "scipy.optimize.OptimizeResult":
    """Return scipy's result over the values with a first step, from one full simplex."""
    varied = np.flatnonzero(steps)
    lower, upper = (each[varied] for each in bounds)

    def of_varied(values: np.ndarray) -> float:
        free = begin.copy()
        free[varied] = values
        return cost(free)

    simplex = np.vstack([begin, begin + np.diag(steps)[varied]])[:, varied]
    return scipy.optimize.minimize(
        of_varied, begin[varied], method="Nelder-Mead",
        bounds=list(zip(lower, upper, strict=True)), callback=rule.after_iteration, options={
            "initial_simplex": np.clip(simplex, lower, upper), "xatol": tolerance,
            "fatol": tolerance, "maxfev": limit, "adaptive": False})


def _first_steps(objective: Objective) -> np.ndarray:
    """First steps of the simplex in the free vector, 0 for what stays at its prior, shape [p]."""
    space = objective.space
    held = {name for name, _, _ in space.priors}
    return np.r_[np.full(space.group_count, FIRST_SIMPLEX), [
        0.0 if name in held else 0.3 for name in space.extra]]


class _Settling:
    """The paper's termination: the mean squared error of the points settles below a threshold."""

    def __init__(self, objective: Objective, delta_m2: float | None = None):
        self._delta = delta_m2
        self._points = max(sum(int(np.isfinite(f.frames.positions).all(axis=2).sum())
                               for f in objective.forwards), 1)
        self._window = SETTLED_ITERATIONS * (np.count_nonzero(_first_steps(objective)) + 1)
        self.count = 0
        self._best = (np.inf, np.inf)
        self._course: list[float] = []
        self._has_settled = False

    @property
    def _error(self) -> float:
        """Mean squared distance of the best candidate [m^2]."""
        return self._best[1] / self._points

    def begin_again(self) -> bool:
        """Return whether the last search ended by this rule; the next one is judged anew."""
        ended = self._has_settled or self.is_small_enough
        self._course, self._has_settled = [], False
        return ended

    @property
    def is_small_enough(self) -> bool:
        """Whether the error is below the requested one."""
        return self._delta is not None and self._error < self._delta

    def seen(self, objective: float, loss: float) -> None:
        self._best = min(self._best, (objective, loss))

    def after_iteration(self, _free: np.ndarray) -> None:
        self._course.append(self._best[0])
        if self.is_small_enough:
            raise StopIteration
        if len(self._course) > self._window:
            fell = self._course[-1 - self._window] - self._course[-1]
            self._has_settled = fell <= min(SETTLED_FALL, 1e-3 * self._course[-1])
        if self._has_settled:
            raise StopIteration

    def verdict(self, is_settled: bool, limit: int) -> tuple[FitStatus, str]:
        """Status and reason."""
        error = f"the mean squared distance of the points, {self._error:.3g} m2,"
        if self.is_small_enough:
            return FitStatus.converged, f"{error} fell below {self._delta:.3g} m2"
        if not is_settled:
            return FitStatus.out_of_evaluations, (
                Text(f"{limit} simulations were not enough: {error} is still falling. Use ",
                     Option("method", "gauss-newton")))
        if self._delta is None:
            return FitStatus.converged, f"{error} settled"
        return FitStatus.misfit, (
            Text(f"{error} settled above the requested {self._delta:.3g} m2 (", Option("delta_m2"),
                 "). The noise or the error of the model is larger"))


def _required(objective: Objective, free: np.ndarray) -> Evaluation:
    found = objective.evaluate(free, jacobian=True)
    if found is None:
        values = objective.space.unpack(free)
        young = ", ".join(f"{value:.3g}" for value in values.young)
        raise WorkError(f"The simulation finds no equilibrium with E = {young} Pa.", "This branch "
                        "may not be able to reach the recorded poses.", "Check the grasp point and "
                        "the poses, or make the branch with another ", Option("young"), ".")
    return found


def best_so_far(objective: Objective) -> Fit:
    """Return the best evaluation of a stopped fit. Cancelled if there is no evaluation yet."""
    best = objective.log.best
    quiet = Objective(objective.forwards, objective.space, force_sigma=objective.force_sigma)
    evaluation = None if best is None or len(best.parameters) != objective.space.size else (
        quiet.evaluate(np.array(best.parameters), jacobian=True))
    if evaluation is None:
        raise Cancelled("The estimate was stopped before it found an equilibrium.",
                        "There is no result to keep yet.", "Run it again.")
    return Fit(evaluation, FitStatus.stopped, "It was stopped.")
