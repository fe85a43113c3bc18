"""From any rough path to the nearest gentlest one, along limits where it meets them.

The cost of a polyline is smooth and so are its limits: L-BFGS with exact gradients minimises the
augmented Lagrangian. Each limit has a multiplier at each point. After each round it becomes the
force of the limit there. So the limits are kept in the end without a penalty that grows until it
dominates (that left paths up to 4 % over a limit on force, or 10 to 40 % too dear). The gentlest
path often runs along the face of the sampled region or in a valley a tenth of a millimetre
wide: steps that are merely refused there stop far from it.

The variables are corners in the chart of the shell that the grasp follows
(:mod:`limber.planning.field.chart`), off it in units that are smaller in proportion
to the branch's stiffness: chords in space leave the valley between their ends.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import scipy
from scipy.spatial import cKDTree

from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.planning.certificate.feasibility import Verdict, judge
from limber.planning.certificate.lower_bound import ENOUGH, Certificate, certify_all
from limber.planning.cost import EdgeWeights, arc_lengths, resample
from limber.planning.field.energy_field import EnergyField, Quantity, limited
from limber.planning.field.valid_region import nearest_of
from limber.planning.path_problem import BlockedError, GentleProblem, no_path_error, not_found
from limber.planning.planners.least_violation import easiest_path

_MIN_GAP = 1e-9  # [m] keeps the length's gradient finite where two corners meet


def smooth_cost(path: np.ndarray, energy_field: EnergyField, weights: EdgeWeights,
                 ) -> tuple[float, np.ndarray]:
    """Return the trapezoidal cost of a polyline and its gradient to each point, [n, 3]."""
    edges = np.diff(path, axis=0)
    lengths = np.sqrt((edges**2).sum(axis=1) + _MIN_GAP**2)
    direction = edges / lengths[:, None]
    energy: Any = 0.0
    slope: Any = 0.0
    rate = np.full(len(edges), weights.length)
    gradient = np.zeros_like(path)
    if weights.energy > 0.0:
        energy = energy_field.energy(path)
        slope = energy_field.energy_gradient(path)
        rate += weights.energy * (energy[1:] + energy[:-1]) / 2
        near = np.zeros(len(path))
        near[:-1] += lengths / 2
        near[1:] += lengths / 2
        gradient += weights.energy * near[:, None] * slope
    gradient[1:] += rate[:, None] * direction
    gradient[:-1] -= rate[:, None] * direction
    return float((rate * lengths).sum()), gradient


_EDGES = 48  # edges of the polyline while it is optimised; limits are evaluated half-way too
_FINE = 0.001  # [m] between returned points: chords in space leave the low-energy surface
_STRETCH = 4.0  # off the surface, where there is one
_ROUNDS = 12
_ITERATIONS = 80  # in a round
_WEIGHTS = (1e3, 1.0)  # of squared excesses at first: of position and length, and of loads
_HOPELESS = 1e5  # factor on the weights above which violated limits stay violated
_FAR = 10.0  # relative excess above which heavier weights change nothing
_HEAVIER = 25.0  # from round to round, where limits are not kept much better than before
_BETTER = 0.25
_SETTLED = 3e-4  # change of the cost in a round, relative
_MARGINS = (2e-5, 3e-4, 8e-4, 2e-3)  # [m] kept from the limits; the next if one was not enough
_FIRST_STEP = 0.1  # fraction of an edge: the first step, without known curvature
_FLAT = 1e-8  # slope in those units, for a cost of about 1
_LEVEL = 1e-7  # relative gain in an iteration that ends a round: finer takes twice as long
_INSIDE = 1e-3  # fraction of the goal's tolerance by which an end lies inside; at most the margin
_STEP = 1e-5  # [m] of the two finite differences
_SAME_WAY = 0.05  # fraction of a path's length; another path around a ridge is farther away


def refine(path: np.ndarray, problem: GentleProblem) -> tuple[np.ndarray, float]:
    """Return the path [n, 3] at the nearest optimum, its end within the goal, and its cost:
    infinite, with the given path, if no allowed one was found near."""
    best, least, moved = path, problem.cost(path), path
    limits = Excesses(problem, 0.0)
    for margin, following in zip(_MARGINS, (*_MARGINS[1:], 0.0), strict=True):
        limits.margin = margin
        moved, over = _moved(moved, limits)
        cost = problem.cost(moved)
        if cost < least:
            best, least = moved, cost
        # A margin mends an excess between two points of a path, not one that is larger than it.
        if np.isfinite(cost) or over * limits.scale > following:
            break
    return best, least


def is_along(rough: np.ndarray, path: np.ndarray) -> bool:
    """Return whether a rough path [n, 3] is so near to a refined one [k, 3] that refining it would
    give the same path."""
    away = cKDTree(resample(path, _FINE)).query(rough)[0]
    return bool(away.max() <= _SAME_WAY * arc_lengths(path)[-1])


def distinct(paths: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return those of ``paths`` [n, 3] that are not along one before."""
    found: list[np.ndarray] = []
    for path in paths:
        if not any(is_along(path, other) for other in found):
            found.append(path)
    return found


def _moved(path: np.ndarray, limits: "Excesses") -> tuple[np.ndarray, float]:
    """Move a path [n, 3] to keep the margin from ``limits``, whose multipliers go on; and its
    largest excess over a limit, relative to it."""
    line = _Line(limits.problem)
    flat = line.chart.map(path)
    flat[0] = line.chart.map(limits.problem.start)[0]
    before, worst, over = np.inf, np.inf, np.inf
    for _ in range(_ROUNDS):
        flat = resample(flat, max(np.linalg.norm(np.diff(flat, axis=0), axis=1).sum(), 1e-6)
                        / _EDGES)
        limits.steep = max(1.0, float(np.linalg.norm(limits.outward(line.points(flat[-2:])[-1]))))
        flat, cost = line.settle(flat, limits)
        over = limits.push(line.points(flat))
        if over <= 0.5 * limits.reserve and abs(cost - before) <= _SETTLED * abs(cost):
            break
        if over > max(_BETTER * worst, limits.reserve):
            limits.heavier *= _HEAVIER
        if limits.heavier > (_HEAVIER if over > _FAR else _HOPELESS):
            break
        before, worst = cost, over
    return line.chart.curved(resample(flat, _FINE)), over


class _Line:
    """Polylines by their corners [n, 3] in the plain chart, the first of which stays."""

    def __init__(self, problem: GentleProblem):
        self.problem = problem
        self.chart = problem.energy_field.region.chart.plain
        self.units = np.array([1.0, 1.0, 1.0 / _STRETCH if self.chart.radius > 0.0 else 1.0])

    def points(self, flat: np.ndarray) -> np.ndarray:
        """Return the corners and the points half-way between them, [2 n - 1, 3] in space."""
        both = np.empty((2 * len(flat) - 1, 3))
        both[::2], both[1::2] = flat, 0.5 * (flat[1:] + flat[:-1])
        return self.chart.curved(both)

    def settle(self, flat: np.ndarray, limits: "Excesses") -> tuple[np.ndarray, float]:
        """Move corners to the minimum of the augmented Lagrangian; and its cost. Unknowns are
        edges, so a step moves whole parts as lightly as a corner (a chain of springs)."""
        edges = np.diff(flat, axis=0)
        units = _FIRST_STEP * float(np.linalg.norm(edges, axis=1).mean()) * self.units

        def moved(unknown: np.ndarray) -> np.ndarray:
            return np.concatenate([flat[:1], flat[0] + np.cumsum(
                unknown.reshape(edges.shape) * units, axis=0)])

        def cost(unknown: np.ndarray) -> tuple[float, np.ndarray]:
            points = self.points(moved(unknown))
            value, gradient = smooth_cost(points, self.problem.energy_field, self.problem.weights)
            broken, slope = limits.penalty(points)
            own = self.chart.push_forward(points, gradient + slope)
            to_corners = own[::2]
            to_corners[1:] += 0.5 * own[1::2]
            to_corners[:-1] += 0.5 * own[1::2]
            to_edges = np.cumsum(to_corners[:0:-1], axis=0)[::-1]
            return value + broken, (to_edges * units).ravel()

        found = scipy.optimize.minimize(
            cost, (edges / units).ravel(), jac=True, method="L-BFGS-B",
            options={"maxiter": _ITERATIONS, "maxcor": 20, "gtol": _FLAT, "ftol": _LEVEL})
        flat = moved(found.x)
        return flat, smooth_cost(self.points(flat), self.problem.energy_field,
                                 self.problem.weights)[0]


@dataclass(frozen=True)
class _Excess:
    """Relative excess of a path over a limit, ``values`` [k], and ``pull``, which maps weights [k]
    on them to the gradient of the weighted sum at each of the path's points, [n, 3]."""

    values: np.ndarray
    pull: Callable[[np.ndarray], np.ndarray]
    weight: float = _WEIGHTS[0]


def _along(outward: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    return lambda push: push[:, None] * outward


@dataclass
class Excesses:
    """The limits on a path's points and their multipliers. Points within ``margin`` [m] of trust's
    border are over; energy and force are relative. The least margin is enough for end and length,
    which do not change between points."""

    problem: GentleProblem
    margin: float
    heavier: float = 1.0
    steep: float = 1.0  # growth of the goal's excess per metre: a target may move 30 times as far
    multipliers: list[np.ndarray] = field(default_factory=list)

    @property
    def scale(self) -> float:
        """The length [m] that others are relative to."""
        if self.problem.longest < np.inf:
            return self.problem.longest
        return 1.0 / self.problem.weights.length if self.problem.weights.length > 0.0 else 1.0

    @property
    def reserve(self) -> float:
        """Relative margin kept from every limit."""
        return self.margin / self.scale

    def penalty(self, points: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the limits' contribution to the cost, and its gradient to each point, [n, 3]."""
        total, gradient = 0.0, np.zeros_like(points)
        for excess, multiplier in self._with_multipliers(points):
            weight = self.heavier * excess.weight
            push = np.maximum(multiplier + weight * excess.values, 0.0)
            total += float((push**2 - multiplier**2).mean()) / (2.0 * weight)
            if push.any():
                gradient += excess.pull(push / len(push))
        return total, gradient

    def push(self, points: np.ndarray) -> float:
        """Set each multiplier to its limit's force on this path; return the largest excess."""
        found = list(self._with_multipliers(points))
        self.multipliers = [np.maximum(
            multiplier + self.heavier * excess.weight * excess.values, 0.0)
                            for excess, multiplier in found]
        return max(float(excess.values.max()) for excess, _ in found)

    def _with_multipliers(self, points: np.ndarray) -> Iterator[tuple[_Excess, np.ndarray]]:
        for number, excess in enumerate(self._excesses(points)):
            count = len(excess.values)
            known = self.multipliers[number] if self.multipliers else np.zeros(count)
            if len(known) != count:
                # A path that has shrunk to next to nothing has fewer corners than before.
                known = np.interp(np.linspace(0.0, 1.0, count),
                                  np.linspace(0.0, 1.0, len(known)), known)
            yield excess, known

    def _excesses(self, points: np.ndarray) -> Iterator[_Excess]:
        problem, scale = self.problem, self.scale
        region = problem.energy_field.region
        # The highest plane only, and never at the start, which may lie on it and stays.
        height, slope = region.height_and_slope(points)
        height += self.margin
        height[0] = -scale
        yield _Excess(height / scale, lambda push: push[:, None] * slope / scale)
        if len(region.rejected):
            accepted, toward = nearest_of(points, region.accepted)
            rejected, away = nearest_of(points, region.rejected)
            beyond = accepted - rejected + self.margin
            beyond[0] = -scale
            yield _Excess(beyond / scale, lambda push: push[:, None] * (toward - away) / scale)
        yield from self._on_loads(points)
        limits = problem.limits
        for axis in range(3):
            for bound, side in ((limits.low[axis], -1.0), (limits.high[axis], 1.0)):
                if np.isfinite(bound):
                    outward = side * np.eye(3)[axis] / scale
                    yield _Excess((side * (points[:, axis] - bound) + self.margin) / scale,
                                  _along(outward))
        inside = min(_INSIDE * problem.goal.tolerance, _MARGINS[0])
        outside = (problem.goal_excess(points[-1]) / self.steep + inside) / scale
        yield _Excess(np.array([outside]), lambda push: self._at_end(points, push))
        if problem.longest < np.inf:
            yield self._on_length(points)

    def _on_loads(self, points: np.ndarray) -> Iterator[_Excess]:
        """Yield the excess of energy, loads and force at each point; slopes are computed only where
        a limit acts."""
        def pull(one: Quantity, push: np.ndarray) -> np.ndarray:
            out, active = np.zeros_like(points), np.flatnonzero(push)
            out[active] = push[active, None] * one.slope(points[active]) / one.limit
            return out
        for one in limited(self.problem.energy_field, self.problem.limits):
            yield _Excess(one.share(points) - 1.0 + self.reserve, partial(pull, one), _WEIGHTS[1])

    def _at_end(self, points: np.ndarray, push: np.ndarray) -> np.ndarray:
        out = np.zeros_like(points)
        out[-1] = push[0] * self.outward(points[-1]) / (self.steep * self.scale)
        return out

    def outward(self, end: np.ndarray) -> np.ndarray:
        """Return the gradient of the goal's excess at an end [3]."""
        shifts = _STEP * np.concatenate([np.eye(3), -np.eye(3)])
        excess = self.problem.goal.excess(self.problem.energy_field, end + shifts)
        return (excess[:3] - excess[3:]) / (2.0 * _STEP)

    def _on_length(self, points: np.ndarray) -> _Excess:
        edges = np.diff(points, axis=0)
        lengths = np.maximum(np.linalg.norm(edges, axis=1), 1e-12)

        def pull(push: np.ndarray) -> np.ndarray:
            along = push[0] / self.problem.longest * edges / lengths[:, None]
            out = np.zeros_like(points)
            out[1:] += along
            out[:-1] -= along
            return out
        return _Excess(np.array([(lengths.sum() + _MARGINS[0]) / self.problem.longest - 1.0]), pull)


# The gentlest path with its certificate: eikonal descent, refinement, bound.
#
# Each grid of the certificate gives its cheapest path; refined, it becomes a path on the field. The
# first paths tried are the straight line and those of other planners that keep the limits; if none
# does, the path that exceeds them least. If that fails, next comes a path through cells that keep
# them, if there is one (:mod:`limber.planning.certificate.feasibility`).

_GAIN = 1e-3  # relative gain of cost that another refinement must bring


@dataclass(frozen=True)
class GentlePath:
    """A path [n, 3], its cost, and its gap to the best."""

    points: np.ndarray
    cost: float
    certificate: Certificate


def plan_gentle(problem: GentleProblem, others: list[np.ndarray] | None = None, *,
                enough: float = ENOUGH, progress: Progress = SILENT) -> GentlePath:
    """Return the gentlest path found, from ``others`` [n, 3] too, and a bound, refined to a gap of
    ``enough``. BlockedError if there is none, and whether that is proven."""
    return plan_gentle_all([problem], others, enough=[enough], progress=progress)[0]


def plan_gentle_all(problems: Sequence[GentleProblem], others: list[np.ndarray] | None = None, *,
                    enough: Sequence[float], progress: Progress = SILENT) -> list[GentlePath]:
    """Return the same for each of problems that differ in the weight of length alone; their bounds
    share the energies of the field. BlockedError as for one."""
    found = [_Gentlest(problem, others or []) for problem in problems]
    certificates = certify_all(problems, found, enough=enough, progress=progress)
    return [GentlePath(present(one.points, "path"), one.cost, certificate)
            for one, certificate in zip(found, certificates, strict=True)]


class _Gentlest:
    """The gentlest path of a problem so far."""

    def __init__(self, problem: GentleProblem, others: list[np.ndarray]):
        self.problem, self._others = problem, others
        self.points: np.ndarray | None = None
        self.cost = np.inf
        self._tried: list[np.ndarray] = []
        self._is_in_vain = False

    def __call__(self, rough: np.ndarray | None) -> float:
        """Return the cost after refining a ``rough`` path [n, 3]; None: those known before."""
        problem, before = self.problem, self.cost
        along = rough is not None and self.points is not None and is_along(rough, self.points)
        if along and self._is_in_vain:
            return before  # leads to the same optimum
        if self._found_from(self._starts() if rough is None else [rough], rough is None):
            self._is_in_vain |= along and self.cost > (1.0 - _GAIN) * before
            return self.cost
        if problem.limits.slack.factors.any():
            # Cells are asked about the limits as requested, not about extended or tighter ones.
            raise not_found(problem, "The easiest path does not keep them.")
        verdict = judge(problem)
        # A path that keeps the limits is a better proof than cells that separate.
        if verdict.path is None or not self._found_from([verdict.path]):
            raise separated(problem, verdict) if verdict.proven else not_found(
                problem, f"The question is undecided on {_grid(verdict)}.")
        return self.cost

    def _starts(self) -> list[np.ndarray]:
        """Return the known paths that keep the limits; if none does, the path that exceeds them
        least."""
        # Those of planners first: mostly the straight line then leads to the same optimum.
        known = [path for path in [*self._others[::-1], _straight(self.problem)]
                 if len(path) > 1 and np.isfinite(self.problem.cost(path))]
        return known or _easiest(self.problem)

    def _found_from(self, paths: list[np.ndarray], skips_same: bool = False) -> bool:
        for path in paths:
            if len(path) < 2 or not arc_lengths(path)[-1] > 0.0:
                continue
            same = self._tried if self.points is None or not skips_same else [
                *self._tried, self.points]
            if any(is_along(path, other) for other in same):
                continue  # leads to the same optimum
            self._tried.append(path)
            points, cost = refine(path, self.problem)
            if cost < self.cost:
                self.points, self.cost = points, cost
        return self.points is not None


def separated(problem: GentleProblem, verdict: Verdict) -> BlockedError:
    """Return the error for a goal that cells separate from the start."""
    return no_path_error(problem,
                         f"This is proven on {_grid(verdict)}: forbidden cells separate the "
                         "start from the goal.").behind(verdict.wall, verdict.nearest)


def _easiest(problem: GentleProblem) -> list[np.ndarray]:
    path = easiest_path(problem.energy_field, problem.limits, problem.start, problem.goal)
    return [] if path is None else [path.points]


def _grid(verdict: Verdict) -> str:
    along, off = 1e3 * verdict.edges[0], 1e3 * verdict.edges[2]
    return f"a grid of {along:.1f} mm along the low-energy surface and {off:.2g} mm across it"


def _straight(problem: GentleProblem) -> np.ndarray:
    end = problem.goal.centre(problem.energy_field)
    return problem.start + np.linspace(0.0, 1.0, 40)[:, None] * (end - problem.start)
