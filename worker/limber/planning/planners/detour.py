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
from scipy.integrate import trapezoid

from limber.errors import NoPathError
from limber.planning.cost import arc_lengths, resample
from limber.planning.planners.gentle import GentlePath, plan_gentle
from limber.planning.planners.refine import refine
from limber.planning.problem import GentleProblem
from limber.progress import SILENT, Progress

_RANGE = (1e-2, 1e3)  # of the weight of a metre, times that which was given
_STEPS = 8  # of the search for the weight
_CLOSE = 2e-3  # of the length limit: near enough below it
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
        progress(0.5 * step / _STEPS, "how much a metre may cost", length=search.last_length)
        if not search.step():
            break
    for attempt in range(3):
        weight = search.short_weight * 1.2**attempt
        found = plan_gentle(_weighed(problem, weight), [search.short_path],
                            progress=progress.part(0.5, 0.9))
        search.add(weight, found.points, found.certificate.lower)
        if arc_lengths(found.points)[-1] <= longest * (1.0 + 1e-9):
            break
        search.long_path = found.points
    progress(0.95, "just short enough")
    return search.result(found, weight, float(least))


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
            raise NoPathError("No allowed path was found to start from.",
                              "Refining the known ones ended outside the limits.",
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

    def result(self, found: GentlePath, weight: float, shortest: float) -> DetourPath:
        """Return the gentlest of the short enough paths that are known, and the best bound."""
        bounds = [p.lower_bound_jm - p.metre_jm * self.longest for p in self.curve
                  if p.lower_bound_jm is not None]
        known = [found.points, self.short_path, *self._just_short_enough()]
        measured = [_measured(path, self.problem) for path in known]
        integral, number = min((integral, number) for number, (length, integral)
                               in enumerate(measured) if length <= self.longest * (1.0 + 1e-9))
        cost = _weighed(self.problem, weight).cost(known[number])
        found = GentlePath(known[number], cost, replace(found.certificate, upper=cost))
        return DetourPath(found, weight, shortest, self.longest, integral, max(bounds),
                          tuple(sorted(self.curve, key=lambda point: point.weight)))

    def _just_short_enough(self) -> list[np.ndarray]:
        """Return what the short and the long path become with the length as a limit."""
        limited = replace(_weighed(self.problem, _RANGE[0]), longest=self.longest)
        starts = [self.short_path] if self.long_path is None else [self.short_path, self.long_path]
        found = [refine(path, limited) for path in starts]
        return [path for path, cost in found if np.isfinite(cost)]


def _weighed(problem: GentleProblem, weight: float) -> GentleProblem:
    return replace(problem, weights=problem.weights._replace(
        length=weight * problem.weights.length))


def _measured(path: np.ndarray, problem: GentleProblem) -> tuple[float, float]:
    fine = resample(path, _SPACING)
    along = arc_lengths(fine)
    return float(along[-1]), float(trapezoid(problem.energy_field.energy(fine), along))
