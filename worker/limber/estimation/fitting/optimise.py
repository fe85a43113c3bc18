"""The optimisers: the paper's Nelder-Mead, and Gauss-Newton with exact sensitivities."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import scipy

from limber.core.errors import Cancelled, Option, Text, WorkError
from limber.estimation.fitting.objective import Evaluation, Objective

EVALUATION_LIMIT = 400
"""Forward simulations of all pulls, after which a fit that still moves is given up."""
FIRST_STEP = 1.5
"""Longest first step of Gauss-Newton in log E: a factor of 4.5. Chosen, not measured."""
LONGEST_STEP = 1.1
"""Longest step of Gauss-Newton in a log E, a factor of three: beyond it no linearisation holds."""
OUTLYING = 3.0
"""Standard deviations beyond which residuals count linearly in a robust fit."""
SETTLED_ITERATIONS = 4
"""Iterations of Nelder-Mead without change, per corner of its simplex, after which it ends. Chosen.
"""
SETTLED_FALL = 0.01
"""Negligible decrease of half the squared standardised residuals: a seventh of a deviation."""
SETTLED_STEP = 0.005
"""Length of the remaining step, in standard deviations, at which Gauss-Newton ends."""
WANDERING_STEP = 0.1
"""The same if forces are settled in every simulation: to half a millimetre of the gripper's
position, whose repeatability is no better; a stricter end does not converge. The remainder adds
half a percent to the deviation.
"""
SHORTEST_STEP = 3e-4
"""Step relative to the free vector's length at which it ends if no step descends."""
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
    misfit: it settled, but farther from the measurements than requested.
    unconfirmed: a reduced model's fit that the full model could not confirm.
    stopped: by the user.
    """

    converged = "converged"
    out_of_evaluations = "out of evaluations"
    misfit = "misfit"
    unconfirmed = "unconfirmed"
    stopped = "stopped"


@dataclass(frozen=True)
class Fit:
    """End of an optimiser: the best evaluation, with derivatives if requested, and the reason as
    text with numbers."""

    evaluation: Evaluation
    status: FitStatus
    reason: str

    @property
    def converged(self) -> bool:
        return self.status is FitStatus.converged


def gauss_newton(objective: Objective, start: np.ndarray, *, robust: bool = True,
                 evaluation_limit: int = 40, tolerance: float = 3e-5, is_near: bool = False,
                 force_rounds: int = FORCE_ROUNDS, shortest: float = SETTLED_STEP) -> Fit:
    """Levenberg-Marquardt in a trust region (``least_squares``). ``robust``: residuals beyond
    ``OUTLYING`` count linearly (``soft_l1``). It ends at a relative change ``tolerance`` of the
    cost or a step ``shortest`` in deviations. WorkError if the start has no equilibrium."""
    # Far from the solution all residuals are large, and a robust loss would only slow convergence.
    phases = [("linear", ROUGH_ENDING), ("soft_l1", tolerance)]
    if not robust:
        phases = [("linear", tolerance)]
    elif is_near:
        phases = phases[1:]
    search = _Search(objective, start, evaluation_limit, shortest)
    moved = search.begin
    for phase in phases:
        found = search.minimised(moved, *phase)
        moved = found.x
    for _ in range(force_rounds):
        # Measured input forces are now known better, and so is their effect on the points.
        if not objective.follow_forces(search.at(moved)):
            break
        before = search.at(moved)
        found = search.minimised(moved, *phases[-1])
        away = before.jacobian @ (found.x - moved)
        moved = found.x
        if np.linalg.norm(away) < FORCE_SETTLED:
            break
    status = FitStatus.converged if found.status > 0 else FitStatus.out_of_evaluations
    return Fit(search.at(found.x), status, str(found.message))


class _Search:
    """Scipy's searches use shifted vectors, as it limits the first step by the vector's length: to
    about a factor of e in all moduli, while log E itself would allow any."""

    def __init__(self, objective: Objective, start: np.ndarray, evaluation_limit: int,
                 shortest: float):
        self._objective, self._limit = objective, evaluation_limit
        self._lower, self._upper = objective.space.bounds()
        start = np.clip(start, self._lower + 1e-6, self._upper - 1e-6)
        self._size = len(_required(objective, start).residual)
        self._shift = start - FIRST_STEP / np.sqrt(len(start))
        self.begin = self._accepted = start - self._shift
        settles = any(forward.watches_pose for forward in objective.forwards)
        self._shortest = max(WANDERING_STEP if settles else 0.0, shortest)

    def at(self, moved: np.ndarray) -> Evaluation:
        """Evaluate with derivatives."""
        return _required(self._objective, moved + self._shift)

    def minimised(self, moved: np.ndarray, loss: str,
                  ending: float) -> "scipy.optimize.OptimizeResult":
        """Return scipy's result from ``moved`` with a loss, to a relative change of cost."""
        self._accepted = moved

        def jacobian(moved: np.ndarray) -> np.ndarray:
            # Asked at each accepted vector.
            self._accepted = moved.copy()
            found = self.at(moved)
            step, length = _wanted_step(found, loss)
            aim = moved + self._shift + step
            if length < self._shortest and np.all((self._lower < aim) & (aim < self._upper)):
                raise _SettledError(moved)
            return found.slopes

        try:
            return scipy.optimize.least_squares(
                self._residual, moved, jacobian,
                bounds=(self._lower - self._shift, self._upper - self._shift), method="trf",
                loss=loss, f_scale=OUTLYING, ftol=ending, xtol=SHORTEST_STEP, gtol=1e-12,
                max_nfev=self._limit)
        except _SettledError as end:
            return scipy.optimize.OptimizeResult(
                x=end.moved, status=1, message=f"The next step is shorter than {self._shortest:g} "
                "standard deviations.")

    def _residual(self, moved: np.ndarray) -> np.ndarray:
        # Nearly every step is accepted, and its derivative is cheapest right after the solve.
        found = None if self._is_far(moved) else self._objective.evaluate(
            moved + self._shift, jacobian=True)
        # What is not finite has no value for scipy: the trust region shrinks.
        return np.full(self._size, np.nan) if found is None else found.residual

    def _is_far(self, moved: np.ndarray) -> bool:
        """Whether a step from the last accepted vector changes a modulus too much to be tried."""
        count = self._objective.space.group_count
        return bool(np.abs(moved - self._accepted)[:count].max() > LONGEST_STEP)


class _SettledError(Exception):
    """Ends scipy's iteration at ``moved``."""

    def __init__(self, moved: np.ndarray):
        super().__init__()
        self.moved = moved


def _wanted_step(found: Evaluation, loss: str) -> tuple[np.ndarray, float]:
    """Return the Gauss-Newton step from an evaluation, shape [p], and its length in standard
    deviations."""
    weight = np.ones(len(found.residual))
    if loss == "soft_l1":
        weight = (1 + (found.residual / OUTLYING)**2)**-0.25
    slopes = weight[:, None] * found.slopes
    step = -np.linalg.lstsq(slopes, weight * found.residual, rcond=None)[0]
    return step, float(np.linalg.norm(slopes @ step))


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
        found = objective.log.find(free) or objective.evaluate(free)
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
        0.0 if name in held else 0.03 if name == "poisson" else 0.3 for name in space.extra]]


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
        self._iterations = 0
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
        self._iterations += 1
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
                Text(f"{limit} simulations were not enough: {error} is still falling. "
                     f"{self._outlook()} Use ", Option("method", "gauss-newton")))
        if self._delta is None:
            return FitStatus.converged, f"{error} settled"
        return FitStatus.misfit, (
            Text(f"{error} settled above the requested {self._delta:.3g} m2 (", Option("delta_m2"),
                 "). The noise or the error of the model is larger"))

    def _outlook(self) -> str:
        """After how many simulations it would settle if its fall went on shrinking as it does."""
        course, half = self._course, len(self._course) // 2
        early, late = (course[0] - course[half], course[half] - course[-1]) if half else (0, 0)
        if not 0 < late < early < np.inf:
            return f"It would take more than {2 * self.count}."
        negligible = min(SETTLED_FALL, 1e-3 * course[-1])
        halves = max(np.log(negligible / late) / np.log(late / early), 1.0)
        more = halves * half * self.count / self._iterations
        return f"At this rate it would settle after about {float(f'{self.count + more:.2g}'):.0f}."


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
    if best is None or len(best.parameters) != objective.space.size:
        raise Cancelled("The estimate was stopped before the first step of the fit.",
                        "There is no result to keep yet.", "Run it again.")
    quiet = Objective(objective.forwards, objective.space, force_sigma=objective.force_sigma)
    evaluation = quiet.evaluate(np.array(best.parameters), jacobian=True)
    if evaluation is None:
        raise Cancelled("The estimate was stopped before it found an equilibrium.",
                        "There is no result to keep yet.", "Run it again.")
    return Fit(evaluation, FitStatus.stopped, "stopped")
