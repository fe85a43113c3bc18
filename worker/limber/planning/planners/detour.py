"""The gentlest path that is not too long, and the trade between energy and length.

Of all paths no longer than L the gentlest has the least integral of energy I. With a weight w on a
metre, every path costs I + w length >= B(w), the certificate's bound; so one no longer than L has

    I >= B(w) - w L        for any w

(weak duality: Boyd and Vandenberghe 2004, 5.2). The weight is sought at which the gentlest path is
just short enough; there the bound is nearly met. Where the length jumps at a weight (energy over
length is not convex: one way round a ridge, or the other) no weight gives a path that is just short
enough. So from the short path and from the long one it is also sought directly, the length a limit;
what the bound leaves open then is the jump's.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy

from limber.core.errors import NoPathError
from limber.core.progress import SILENT, Progress
from limber.planning.cost import arc_lengths, resample
from limber.planning.path_problem import GentleProblem
from limber.planning.planners.gentle import GentlePath, plan_gentle
from limber.planning.planners.refine import refine

_RANGE = (1e-2, 1e3)  # of the weight of a metre, times that which was given
_STEPS = 8  # of the search for the weight
_CLOSE = 2e-3  # of the length limit: near enough below it
_ENOUGH = 0.001  # gap of the weighed cost: of the energy, a part of it, it is five to ten times
_MOST_BOUNDS = 3
_NEAR = 0.01  # of the energy: a bound so near needs no other
_ROUGH = 0.03  # gap of the weighed cost above which a dearer metre tells more
_STRIDE = 2.5
_SPACING = 0.001  # [m] at which a path's integral is taken


@dataclass(frozen=True)
class TradePoint:
    """A weight of a metre relative to the given one, the gentlest path that was found with it, and
    what no path costs less than (None where it was not asked): in J m, length at the weight."""

    weight: float
    length_m: float
    energy_integral_jm: float
    lower_bound_jm: float | None = None
    metre_jm: float = 0.0


@dataclass(frozen=True)
class DetourPath:
    """The gentlest path within a length.

    Attributes:
        found: Path and certificate at the weight that was found.
        weight: That weight, relative to the problem's.
        shortest, longest: Length of the shortest path known, and what was allowed [m].
        energy_integral: Of the path [J m]. energy_bound: No path so short has less.
        curve: The trade, by weight.
    """

    found: GentlePath
    weight: float
    shortest: float
    longest: float
    energy_integral: float
    energy_bound: float
    curve: tuple[TradePoint, ...]

    def describe(self) -> dict:
        """Return it as plain data."""
        bound = max(self.energy_bound, 0.0)
        gap = 100.0 * (self.energy_integral / bound - 1.0) if bound > 0.0 else None
        return {"shortest_m": self.shortest, "longest_m": self.longest, "weight": self.weight,
                "energy_integral_jm": self.energy_integral, "energy_bound_jm": bound,
                "gap_percent": gap, "curve": [vars(point) for point in self.curve]}


def plan_detour(problem: GentleProblem, shortest: np.ndarray, max_detour: float,
                others: list[np.ndarray], *, progress: Progress = SILENT) -> DetourPath:
    """Return the gentlest path at most ``max_detour`` (a share) longer than ``shortest`` [n, 3].

    Raises:
        NoPathError: there is no path at all; says whether that is proven.
    """
    least = arc_lengths(shortest)[-1]
    longest = float((1.0 + max_detour) * least)
    search = _Search(problem, longest, [shortest, *others])
    for step in range(_STEPS):
        progress(0.5 * step / _STEPS, "weighing length against energy", length=search.last_length)
        if not search.step():
            break
    bounds = _Bounds(problem, search)
    weight = search.first_weight()
    for number in range(_MOST_BOUNDS):
        part = progress.part(0.5 + 0.4 * number / _MOST_BOUNDS, 0.5 + 0.4 * (number + 1)
                             / _MOST_BOUNDS)
        weight = bounds.ask(weight, part)
        if weight is None:
            break
    if not bounds.stopped:
        progress(0.95, "refining the path of the allowed length")
    return search.result(bounds.best, bounds.best_weight, float(least), bounds.stopped)


class _Bounds:
    """The dual's ascent: bounds at a few weights, and which weight to try next."""

    def __init__(self, problem: GentleProblem, search: "_Search"):
        self.problem, self.search = problem, search
        self.best: GentlePath | None = None
        self.best_weight, self.value = np.nan, -np.inf
        self.low, self.high = 0.0, np.inf
        self.stopped = False

    def ask(self, weight: float, progress: Progress) -> float | None:
        """Bound at a weight; returns the next one, None where none is worth its time."""
        search, weighed = self.search, _weighed(self.problem, weight)
        found = plan_gentle(weighed, [search.short_path], enough=_ENOUGH, progress=progress)
        self.stopped = found.certificate.stopped
        search.add(weight, found.points, found.certificate.lower)
        last = search.curve[-1]
        value = last.lower_bound_jm - last.metre_jm * search.longest
        if value > self.value:
            self.best, self.best_weight, self.value = found, weight, value
        if last.length_m > search.longest:
            search.long_path = found.points
        if self.stopped or value >= (1.0 - _NEAR) * search.gentlest_short(found.points):
            return None
        spare = last.metre_jm * (search.longest - last.length_m)
        unsure = found.cost / self.problem.weights.energy - last.lower_bound_jm
        if spare < 0.0 or (found.certificate.gap > _ROUGH and unsure > spare):
            self.low = weight
        elif spare > unsure:
            self.high = weight
        else:
            return None
        if self.low > 0.0 and self.high < np.inf:
            return float(np.sqrt(self.low * self.high))
        return weight * _STRIDE if self.low > 0.0 else weight / _STRIDE


class _Search:
    """Bisection of the weight: length falls as it grows."""

    def __init__(self, problem: GentleProblem, longest: float, starts: list[np.ndarray]):
        self.problem, self.longest, self.starts = problem, longest, starts
        self.low, self.high = np.log(_RANGE)
        self.curve: list[TradePoint] = []
        self.short_weight, self.short_path = _RANGE[1], starts[0]
        self.long_path: np.ndarray | None = None
        self.last_length = np.nan

    def step(self) -> bool:
        """Try one weight; returns whether another one is worth it."""
        weight = float(np.exp(self.low if not self.curve else 0.5 * (self.low + self.high)))
        weighed = _weighed(self.problem, weight)
        tried = [refine(path, weighed) for path in self.starts]
        path, cost = min(tried, key=lambda item: item[1])
        if not np.isfinite(cost):
            raise NoPathError("No allowed path was found as a starting point.",
                              "Refinement of the known paths ended outside the limits.",
                              "Sample more poses with `limber energy --samples`.")
        self.add(weight, path, None)
        # From here on the neighbouring weight's path is start enough.
        self.starts = [path, self.short_path]
        if self.last_length > self.longest:
            self.low, self.long_path = np.log(weight), path
            return True
        first = len(self.curve) == 1
        self.high, self.short_weight, self.short_path = np.log(weight), weight, path
        return not first and self.last_length < (1.0 - _CLOSE) * self.longest

    def add(self, weight: float, path: np.ndarray, bound: float | None) -> None:
        """Note what a weight gave; ``bound`` on the weighed cost."""
        energy = self.problem.weights.energy
        self.last_length, integral = _measured(path, self.problem)
        self.curve.append(TradePoint(
            weight, self.last_length, integral, None if bound is None else bound / energy,
            weight * self.problem.weights.length / energy))

    def first_weight(self) -> float:
        """Return the weight whose bound is asked for first.

        That of the search where the length holds the path back. Where it does not, any smaller one
        proves as much, but where a metre costs nearly nothing the grid tells little: that at which
        the length allowed costs as much as the energy.
        """
        if self.long_path is not None:
            return self.short_weight
        last = self.curve[-1]
        return last.energy_integral_jm * last.weight / (last.metre_jm * self.longest)

    def gentlest_short(self, *others: np.ndarray) -> float:
        """Take the gentlest of the short enough paths that are known, or follow from the short and
        the long one with the length as a limit; return its integral of energy [J m]."""
        limited = replace(_weighed(self.problem, _RANGE[0]), longest=self.longest)
        starts = [self.short_path] if self.long_path is None else [self.short_path, self.long_path]
        known = [self.short_path, *others, *(refine(path, limited)[0] for path in starts)]
        measured = [_measured(path, self.problem) for path in known]
        integral, number = min((integral, number) for number, (length, integral)
                               in enumerate(measured) if length <= self.longest * (1.0 + 1e-9))
        self.short_path = known[number]
        return integral

    def result(self, found: GentlePath, weight: float, shortest: float, stopped: bool,
               ) -> DetourPath:
        """Return the gentlest of the short enough paths that are known, and the best bound."""
        bounds = [p.lower_bound_jm - p.metre_jm * self.longest for p in self.curve
                  if p.lower_bound_jm is not None]
        integral = self.gentlest_short()
        cost = _weighed(self.problem, weight).cost(self.short_path)
        found = GentlePath(self.short_path, cost, replace(found.certificate, upper=cost,
                                                                    stopped=stopped))
        return DetourPath(found, weight, shortest, self.longest, integral, max(bounds),
                          tuple(sorted(self.curve, key=lambda point: point.weight)))


def _weighed(problem: GentleProblem, weight: float) -> GentleProblem:
    return replace(problem, weights=problem.weights._replace(
        length=weight * problem.weights.length))


def _measured(path: np.ndarray, problem: GentleProblem) -> tuple[float, float]:
    fine = resample(path, _SPACING)
    along = arc_lengths(fine)
    energies = problem.energy_field.energy(fine)
    return float(along[-1]), float(scipy.integrate.trapezoid(energies, along))
