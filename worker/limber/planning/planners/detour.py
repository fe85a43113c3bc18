"""The gentlest path that is not too long, and the trade-off between energy and length.

Of all paths no longer than L, the gentlest has the least integral of energy I. None leaves the
ellipsoid about start and goal whose points are reached and left within L: the bound uses its cells
alone. With a weight w per metre, every path there costs I + w length >= B(w); so

    I >= B(w) - w L        for any w

(weak duality: Boyd and Vandenberghe 2004, 5.2). If the length does not constrain the path, the
smallest weights give the best bound. If it does, the best weight is the saving per additional
metre: the slope of the gentlest path's energy over the length. If the length jumps at a weight
(energy over length is not convex: one path round a ridge, or the other), the remaining gap of the
bound is the jump's.

The whole trade-off needs several weights: each gives a path of its own length, and a line below
which no path of any allowed length lies. The first bounds share their grids and energies.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from limber.core.errors import Command, NoPathError, Option
from limber.core.progress import SILENT, Progress
from limber.planning.certificate.lower_bound import ENERGY
from limber.planning.cost import arc_lengths, resample
from limber.planning.path_problem import GentleProblem
from limber.planning.planners.refine import GentlePath, distinct, plan_gentle_all, refine

_LIGHT = 1e-2  # fraction of the given weight of a metre: energy alone counts, nearly
_HEAVY = 1e3  # the same: length alone counts
_SHORTER = (0.99, 0.97)  # fractions of the allowed length, for the slope of energy over length
_BINDS = 0.998  # fraction of the allowed length above which the length binds
_ENOUGH = 0.03  # gap of the energy below which a finer grid is not worth its time
_UNUSED = 0.004  # fraction of the energy that the weight of an unused length may cost the bound
_FINEST_GAP = 1e-3  # gap of the weighted cost that is asked for
_LADDER = (1.0, 1.0 / 3.0, 3.0)
"""Weights of the trade-off, relative to what a metre saves on average up to the shortest path."""
_APART = 1.5  # ratio of two weights that have a bound each
_LOOSE = 3.0  # factor on the gap asked of the other weights
_MOST_BOUNDS = 3
_STRIDE = 2.5
_SPACING = 0.001  # [m] spacing of a path's integral


@dataclass(frozen=True)
class TradePoint:
    """A weight per metre relative to the given one, the gentlest path found with it, and the lower
    bound on the cost of any path (None if it was not computed): in J m, length at the weight."""

    weight: float
    length_m: float
    energy_integral_jm: float
    lower_bound_jm: float | None = None
    metre_jm: float = 0.0


@dataclass(frozen=True)
class DetourPath:
    """The gentlest path within a length, certified by its integral of energy [J m]. ``weight`` is
    relative to the problem's, lengths are in m, ``energy_bound`` is for paths this short."""

    found: GentlePath
    weight: float
    shortest: float
    longest: float
    energy_integral: float
    energy_bound: float
    curve: tuple[TradePoint, ...]

    def describe(self) -> dict:
        """Return it as plain data."""
        return {"shortest_m": self.shortest, "longest_m": self.longest, "weight": self.weight,
                "energy_integral_jm": self.energy_integral, "energy_bound_jm": self.energy_bound,
                "gap_percent": self.found.certificate.describe()["gap_percent"],
                "curve": [vars(point) for point in self.curve]}


def plan_detour(problem: GentleProblem, shortest: np.ndarray, longest: float,
                others: list[np.ndarray], *, progress: Progress = SILENT) -> DetourPath:
    """Return the gentlest path of at most ``longest`` [m]; ``shortest`` [n, 3] is one such path.
    NoPathError if there is no path at all; states whether that is proven."""
    least = float(arc_lengths(shortest)[-1])
    search = _Search(problem, shortest, longest)
    progress(0.0, "refining paths of the allowed length")
    search.begin(others)
    weights = search.first_weights()
    for number in range(_MOST_BOUNDS):
        part = progress.part(0.2 + 0.8 * number / _MOST_BOUNDS, 0.2 + 0.8 * (number + 1)
                             / _MOST_BOUNDS)
        weight = search.bound(weights, part)
        if weight is None:
            break
        weights = [weight]
    return search.result(least)


class _Search:
    """The gentlest path of the allowed length, and bounds at a few weights."""

    def __init__(self, problem: GentleProblem, shortest: np.ndarray, longest: float):
        self.problem, self.longest = problem, longest
        self.path, self.shortest = shortest, shortest
        self.length, self.integral = _measured(shortest, problem)
        self.slope = 0.0  # [J] saved by one more metre
        self.curve: list[TradePoint] = []
        self.best: GentlePath | None = None
        self.best_weight, self.value = np.nan, -np.inf
        self.levels: list[dict[str, float]] = []
        self.low, self.high = 0.0, np.inf

    def begin(self, others: list[np.ndarray]) -> None:
        """Find the gentlest path from those known, and the saving per additional metre. NoPathError
        if the shortest path is not allowed."""
        light = _weighed(self.problem, _LIGHT)
        free = distinct([refine(path, light)[0] for path in distinct([*others, self.shortest])])
        limited = replace(light, longest=self.longest)
        for path in free:
            self._take(path)
        for path in distinct([*others, self.shortest, *free]):
            self._take(refine(path, limited)[0])
        if not np.isfinite(limited.cost(self.path)):
            raise NoPathError("No allowed path was found as a starting point.",
                              "Refinement of the known paths ended outside the limits.",
                              "Sample more poses with ", Command("energy", Option("samples")), ".")
        for path in free:
            self._note(_LIGHT, *_measured(path, self.problem))
        if self.length < _BINDS * self.longest:
            return
        for share in _SHORTER:
            path, cost = refine(self.path, replace(light, longest=share * self.longest))
            if np.isfinite(cost):
                length, integral = _measured(path, self.problem)
                if length < self.length:
                    self.slope = max((integral - self.integral) / (self.length - length), 0.0)
                    self._note(self._own_weight(), length, integral)
                    break

    def first_weights(self) -> list[float]:
        """Return the weights of the first bounds: the question's, then those of the trade-off."""
        spare = max(self.longest - self.length, (1.0 - _BINDS) * self.longest)
        light = _UNUSED * self.integral / spare
        weights = [max(self.slope, min(light, self.integral / self.longest)) / self._metre]
        length, integral = _measured(self.shortest, self.problem)
        if self.length > length and integral > self.integral:
            mean = (integral - self.integral) / (self.length - length) / self._metre
            weights += [mean * share for share in _LADDER]
        return [one for k, one in enumerate(weights) if all(
            not 1.0 / _APART < one / other < _APART for other in weights[:k])]

    @property
    def _metre(self) -> float:
        """Cost of a metre by the problem's own weights [J]."""
        return self.problem.weights.length / self.problem.weights.energy

    def _own_weight(self) -> float:
        """Return the weight at which the path would be the gentlest."""
        return max(self.slope / self._metre, _LIGHT)

    def bound(self, weights: Sequence[float], progress: Progress) -> float | None:
        """Bound at the first of ``weights``, and less closely at the others; return the next one,
        None if none is worth its time."""
        asked = [replace(_weighed(self.problem, one), longest=self.longest) for one in weights]
        enough = [self._enough(one) * (_LOOSE if k else 1.0) for k, one in enumerate(weights)]
        every = plan_gentle_all(asked, [self.path, self.shortest], enough=enough,
                                progress=progress)
        for one in every:
            self._take(one.points)
        for weight, one in zip(weights, every, strict=True):
            self._bounded(weight, one)
        weight, found = weights[0], every[0]
        if found.certificate.stopped or self.integral <= (1.0 + _ENOUGH) * self.value:
            return None
        metre, energy = weight * self._metre, self.problem.weights.energy
        length, _ = _measured(found.points, self.problem)
        spare = metre * (self.longest - length)
        uncertainty = (found.cost - found.certificate.lower) / energy
        if spare < uncertainty and self.length >= _BINDS * self.longest:
            self.low = weight
        elif spare > uncertainty:
            self.high = weight
        else:
            return None
        if self.low > 0.0 and self.high < np.inf:
            return float(np.sqrt(self.low * self.high))
        return weight * _STRIDE if self.low > 0.0 else weight / _STRIDE

    def _enough(self, weight: float) -> float:
        """Return the gap of the weighted cost with which the energy, a part of it, has its own."""
        metre = weight * self._metre
        least_cost = self.integral / (1.0 + _ENOUGH) + metre * self.longest
        return max((self.integral + metre * self.length) / least_cost - 1.0, _FINEST_GAP)

    def _bounded(self, weight: float, found: GentlePath) -> None:
        """Keep the bound found at a weight."""
        energy, metre = self.problem.weights.energy, weight * self._metre
        lower = found.certificate.lower / energy
        self._note(weight, *_measured(found.points, self.problem), lower, metre)
        value = lower - metre * self.longest
        if value > self.value:
            self.best, self.best_weight, self.value = found, weight, value
            self.levels = [level | {"lower": max(
                level["lower"] / energy - metre * self.longest, 0.0), "upper": self.integral}
                for level in found.certificate.levels]

    def _take(self, path: np.ndarray) -> None:
        """Keep a path if it is short enough, allowed and gentler than the known ones."""
        length, integral = _measured(path, self.problem)
        allowed = np.isfinite(replace(self.problem, longest=self.longest).cost(path))
        if allowed and integral < self.integral:
            self.path, self.length, self.integral = path, length, integral

    def _note(self, weight: float, length: float, integral: float, lower: float | None = None,
              metre: float = 0.0) -> None:
        self.curve.append(TradePoint(weight, length, integral, lower, metre))

    def result(self, least: float) -> DetourPath:
        """Return the gentlest path of the allowed length, and the best bound."""
        assert self.best is not None
        bound = min(max(self.value, 0.0), self.integral)
        proof = replace(self.best.certificate, lower=bound, upper=self.integral,
                        levels=self.levels, quantity=ENERGY)
        cost = _weighed(self.problem, self.best_weight).cost(self.path)
        self._note(_HEAVY, *_measured(self.shortest, self.problem))
        self._note(self._own_weight(), self.length, self.integral)
        return DetourPath(GentlePath(self.path, cost, proof), self.best_weight, least,
                          self.longest, self.integral, bound,
                          tuple(sorted(self.curve, key=lambda point: point.weight)))


def _weighed(problem: GentleProblem, weight: float) -> GentleProblem:
    return replace(problem, weights=problem.weights._replace(
        length=weight * problem.weights.length))


def _measured(path: np.ndarray, problem: GentleProblem) -> tuple[float, float]:
    fine = resample(path, _SPACING)
    along = arc_lengths(fine)
    energies = problem.energy_field.energy(fine)
    return float(along[-1]), float(scipy.integrate.trapezoid(energies, along))
