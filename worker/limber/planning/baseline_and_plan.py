"""Two paths to the same goal region on one field: the shortest, and the gentle one."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy

from limber.core.errors import Command, InputError, NoPathError, Option, Text
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.planning.certificate.feasibility import judge
from limber.planning.certificate.lower_bound import ENERGY, ENOUGH, Certificate, certify
from limber.planning.constraints.limits import SURELY, Limits
from limber.planning.cost import STEP, CostWeights, EdgeWeights, arc_lengths, resample
from limber.planning.field.energy_field import UNITS, EnergyField, FieldArrays
from limber.planning.goals.goal import (
    Goal,
    GoalOverLimitsError,
    allowed_points,
    goal_points,
    grasp_goal,
    with_near_side,
)
from limber.planning.path_problem import (
    UNPROVEN,
    BlockedError,
    GentleProblem,
    check_start,
    not_found,
)
from limber.planning.planners.refine import (
    GentlePath,
    distinct,
    is_along,
    plan_gentle,
    plan_gentle_all,
    refine,
    separated,
)
from limber.planning.planners.rrt_star import PathProblem, Search
from limber.planning.planners.trees import FoundPath, chosen_engine, found_again, plan_path
from limber.planning.settings import PlanSettings

# The gentlest path that is not too long, and the trade-off between energy and length.
#
# Of all paths no longer than L, the gentlest has the least integral of energy I. None leaves the
# ellipsoid about start and goal whose points are reached and left within L: the bound uses its
# cells alone. With a weight w per metre, every path there costs I + w length >= B(w); so
#
#     I >= B(w) - w L        for any w
#
# (weak duality: Boyd and Vandenberghe 2004, 5.2). If the length does not constrain the path, the
# smallest weights give the best bound. Any path of length l and energy E keeps B(w) - w L below
# E + w (l - L): the best weight is where the least of these is greatest, between a path that is
# too long and one that is not (the cutting planes of Kelley 1960). Paths refined at that weight
# cut further; a refinement takes a hundredth of a bound's time. If the length jumps at a weight
# (energy over length is not convex: one path round a ridge, or the other), the remaining gap of
# the bound is the jump's.
#
# The whole trade-off needs several weights: each gives a path of its own length, and a line below
# which no path of any allowed length lies. The first bounds share their grids and energies.

_LIGHT = 1e-2  # fraction of the given weight of a metre: energy alone counts, nearly
_HEAVY = 1e3  # the same: length alone counts
_BINDS = 0.998  # fraction of the allowed length above which the length binds
_TIE = 0.004  # fraction of the bound for which a heavier weight is taken, which parts two paths
_SHORTER = 0.97  # fraction of the allowed length, for what the last metre saves
_CUTS, _WORTH = 6, 1.002  # refinements at the best weight; the factor that counts as a cut
_ENOUGH = 0.02  # gap of the energy below which a finer grid is not worth its time
_UNUSED = 0.004  # fraction of the energy that the weight of an unused length may cost the bound
_FINEST_GAP = 1e-3  # gap of the weighted cost that is asked for
_LADDER = (1.0, 1.0 / 3.0, 3.0)
"""Weights of the trade-off, relative to what a metre saves on average up to the shortest path."""
_APART = 1.5  # ratio of two weights that have a bound each
_LOOSE = 3.0  # factor on the gap asked of the other weights
_MOST_BOUNDS = 3
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
                others: list[np.ndarray], *, has_curve: bool = True, progress: Progress = SILENT,
                ) -> DetourPath:
    """Return the gentlest path of at most ``longest`` [m]; ``shortest`` [n, 3] is one such path.
    ``has_curve``: bound the whole trade-off too. NoPathError if there is no path at all; states
    whether that is proven."""
    least = float(arc_lengths(shortest)[-1])
    search = _Search(problem, shortest, longest)
    progress(0.0, "refining paths of the allowed length")
    search.begin(others)
    weights = search.first_weights()[:None if has_curve else 1]
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
        self.known: list[tuple[np.ndarray, float, float]] = []  # paths, lengths, integrals
        self.curve: list[TradePoint] = []
        self.best: GentlePath | None = None
        self.best_weight, self.value = np.nan, -np.inf
        self.levels: list[dict[str, float]] = []

    def begin(self, others: list[np.ndarray]) -> None:
        """Find the gentlest path from those known, and paths that cut what a bound may prove.
        NoPathError if the shortest path is not allowed."""
        light = _weighed(self.problem, _LIGHT)
        free = distinct([refine(path, light)[0] for path in distinct([*others, self.shortest])])
        for path in free:
            self._take(path)
        for path in distinct([*others, self.shortest, *free]):
            self._take(self._shortened(path))
        if not np.isfinite(replace(light, longest=self.longest).cost(self.path)):
            raise NoPathError("No allowed path was found as a starting point.",
                              "Refinement of the known paths ended outside the limits.",
                              "Sample more poses with ", Command("energy", Option("samples")), ".")
        for path in free:
            self._note(_LIGHT, *_measured(path, self.problem))
        shorter = self._shortened(self.path, _SHORTER)
        self.known += [(path, *_measured(path, self.problem)) for path in (
            *free, self.shortest, shorter) if np.isfinite(light.cost(path))]
        self._cut()

    def _cut(self) -> None:
        """Refine paths at the best weight until they hardly lower what a bound may prove."""
        for _ in range(_CUTS):
            metre, before, ends = self._best()
            for number in ends:
                path, cost = refine(self.known[number][0], _weighed(
                    self.problem, metre / self._metre))
                if np.isfinite(cost):
                    self._take(path)
                    self.known.append((path, *_measured(path, self.problem)))
            if self._best()[1] * _WORTH >= before:
                break
        for number in self._best()[2][:1]:
            self._take(self._shortened(self.known[number][0]))

    def _shortened(self, path: np.ndarray, share: float = 1.0) -> np.ndarray:
        """Return a path refined to the gentlest of a ``share`` of the allowed length."""
        return refine(path, replace(_weighed(self.problem, _LIGHT),
                                    longest=share * self.longest))[0]

    def _best(self) -> tuple[float, float, list[int]]:
        """Return the cost of a metre [J] at which the known paths allow the greatest bound of the
        energy, that bound [J m], and which of them meet there."""
        lengths, integrals = np.array([one[1:] for one in self.known] + [
            (self.length, self.integral)]).T
        spare = max(self.longest - self.length, (1.0 - _BINDS) * self.longest)
        metres = [min(_UNUSED * self.integral / spare, self.integral / self.longest)]
        saved, added = np.subtract.outer(integrals, integrals), np.subtract.outer(lengths, lengths)
        metres += [*-(saved / np.where(added == 0.0, 1.0, added))[(saved > 0.0) & (added < 0.0)]]
        values = integrals + np.multiply.outer(metres, lengths - self.longest)
        # Where two paths meet, both are in the bound's tube; beyond, the shorter one alone.
        least = values.min(axis=1)
        best = max(np.flatnonzero(least >= (1.0 - _TIE) * least.max()), key=metres.__getitem__)
        ends = [int(some[values[best, some].argmin()]) for some in (
            np.flatnonzero(lengths > self.longest), np.flatnonzero(lengths <= self.longest))
            if len(some)]
        return metres[best], float(least.max()), [
            number for number in ends if number < len(self.known)]

    def first_weights(self) -> list[float]:
        """Return the weights of the first bounds: the question's, then those of the trade-off."""
        weights = [self._own_weight()]
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
        return self._best()[0] / self._metre

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
        if every[0].certificate.stopped or self.integral <= (1.0 + _ENOUGH) * self.value:
            return None
        self._cut()
        following = self._own_weight()
        return None if 1.0 / _APART < following / weights[0] < _APART else following

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


_SHARES = (1.0, 0.5, 0.2)  # fractions of the margins that are tried
_AT_START = 1e-4  # [m] distance at which the approach ends
NOTHING_ASKED = "none"
"""The engine of paths that stay where they are."""
_ANY = 1e6  # gap: any path suffices


@dataclass(frozen=True)
class PathPair:
    """The shortest path known and the gentle plan. ``approach`` leads from rest to the start:
    pushed there straight, a branch may buckle. ``unbounded`` still needs a close bound
    (:func:`with_bound`); ``in_doubt``: these paths may keep the limits on the branch only."""

    baseline: FoundPath
    plan: FoundPath
    approach: np.ndarray
    cost: CostWeights
    certificate: Certificate
    compared: dict[str, np.ndarray]
    margins: dict[str, float] = field(default_factory=dict)
    detour: DetourPath | None = None
    trees: dict[str, FoundPath] = field(default_factory=dict)
    unbounded: GentleProblem | None = None
    in_doubt: BlockedError | None = None

    @property
    def stays(self) -> bool:
        """Whether the start is in the goal, so that the paths have no length."""
        return self.plan.engine == NOTHING_ASKED

    def repeats(self, before: "PathPair | None") -> bool:
        """Return whether the plan in doubt ``before`` was along this one, and the field, which
        knows the states along it since, still finds none that keeps the limits."""
        return before is not None and before.in_doubt is not None and is_along(
            self.plan.points, before.plan.points)


def plan_within(field: EnergyField, start: np.ndarray, goal: Goal, settings: PlanSettings,
                limits: Limits, *, asked: Limits | None = None, asked_goal: Goal | None = None,
                before: PathPair | None = None, is_bounded: bool = True,
                progress: Progress = SILENT) -> PathPair:
    """Plan as :func:`plan_pair` within the field's possible error; else on the field alone; else in
    doubt (:data:`~.limits.SURELY`). A proof refers to ``asked``, the bound to
    ``asked_goal``. ``before`` gives trees and paths to start from."""
    margins = limits.margins(field)
    check_start(field, start, limits.on(field))
    closed, is_open = _closed_by_field(field, start, goal, limits, asked or limits)
    none = dict.fromkeys(margins, 0.0)
    options: Any = {"sure": (asked or limits).on(field, SURELY), "asked_goal": asked_goal,
                    "before": before, "is_bounded": is_bounded}
    if closed is not None:
        return replace(_in_doubt(closed, field, start, goal, settings, limits, **options,
                                 progress=progress), margins=none)
    # A start near its limit leaves room for only a part of the margins.
    shares = [share for share in _SHARES if is_open and any(margins.values())
              and allowed_points(start[None], limits.on(field, share))[0]]
    if shares:
        part = {name: shares[0] * value for name, value in margins.items()}
        try:
            found = plan_pair(field, start, goal, settings, limits.on(field, shares[0]),
                              **options, progress=progress.part(0.0, 0.5))
            return replace(found, margins=part)
        except NoPathError as error:
            if isinstance(error, BlockedError) and error.is_proven:
                raise  # by the limits and the field's error alone: without margins as well
            progress.warn("No path keeps the limits with margins for the energy field's error "
                          f"({_margin_text(part)}). The path is planned without margins. The full "
                          "model decides whether it is allowed.")
    try:
        found = plan_pair(field, start, goal, settings, limits.on(field), **options,
                          progress=progress.part(0.5, 1.0))
    except BlockedError as error:
        found = _in_doubt(error, field, start, goal, settings, limits, **options,
                          progress=progress.part(0.5, 1.0))
    return replace(found, margins=none)


def _closed_by_field(field: EnergyField, start: np.ndarray, goal: Goal, limits: Limits,
                     asked: Limits) -> tuple[BlockedError | None, bool]:
    """The error if cells show before any search that no path keeps the limits by the field itself,
    or None; and whether they show a path. BlockedError if proven with the field's error too."""
    if not limits.asked():
        return None, True
    problem = GentleProblem(field, limits.on(field), EdgeWeights(0.0, 1.0, STEP), start, goal,
                            sure=asked.on(field, SURELY))
    verdict = judge(problem)
    if not verdict.proven:
        closed = not_found(problem, "By the energy field there is none, but its error leaves the "
                           "question open.") if verdict.closed_by_field else None
        return closed, verdict.path is not None
    none = separated(problem, verdict)
    try:
        goal_points(goal, field, problem.limits)
    except GoalOverLimitsError as nobody:
        raise BlockedError(nobody.seen, f"{nobody.why} {none.why}", nobody.fix).behind(
            none.wall, none.nearest) from nobody
    raise none


def _in_doubt(none: BlockedError, field: EnergyField, start: np.ndarray, goal: Goal,
              settings: PlanSettings, limits: Limits, **options: Any) -> PathPair:
    """Return the plan with limits relaxed by the field's possible error, without a close bound.
    BlockedError if ``none``, if it is proven, the field has no error, or relaxing does not help."""
    doubts, options = limits.doubts(field), options | {"is_bounded": False}
    if UNPROVEN not in none.seen or not any(doubts.values()):
        raise none
    options["progress"].warn(
        "No path keeps the limits on the energy field, but one may exist. The path is planned "
        f"with limits extended by the field's error, at most {_margin_text(doubts)}. The full "
        "model decides whether it is allowed.")
    try:
        return replace(plan_pair(field, start, goal, settings, limits.on(field, SURELY),
                                 **options), in_doubt=none)
    except NoPathError:
        raise none from None


def _margin_text(margins: dict[str, float]) -> str:
    return ", ".join(f"{name.replace('_', ' ')} " + (
        f"{value:.2g} {UNITS.get(name, '')}".rstrip() if value < np.inf else "not known")
        for name, value in margins.items() if value)


def plan_pair(field: EnergyField, start: np.ndarray, goal: Goal, settings: PlanSettings,
              limits: FieldArrays | None = None, *, sure: FieldArrays | None = None,
              asked_goal: Goal | None = None, before: PathPair | None = None,
              is_compared: bool = False, is_bounded: bool = True,
              progress: Progress = SILENT) -> PathPair:
    """Plan both paths under the same limits (None: the settings'), and bound any path
    (:class:`~.path_problem.GentleProblem`). The largest detour counts from the shortest path; if
    planners are compared, from that of RRT*, as in the paper. InputError if the start is not
    allowed, NoPathError if none."""
    limits = limits or Limits.of(settings).on(field)
    check_start(field, start, limits)
    if goal.excess(field, start[None])[0] <= 0.0:
        return _staying(field, start, goal, settings, limits, sure)
    nobody: GoalOverLimitsError | None = None
    try:
        goals = with_near_side(goal_points(goal, field, limits, seed=settings.seed), start, goal,
                               field, limits)
    except GoalOverLimitsError as error:
        # Drawn poses miss a narrow valley: cells find a path into it, or prove that there is none.
        goals, nobody = np.empty((0, 3)), error
    # Scales by the goal's centre, not by a random point in it: costs of two seeds compare.
    weighed = CostWeights.between(field, start, goal.centre(field), *settings.weights)
    problem = GentleProblem(field, limits, weighed.weights, start, goal, sure=sure,
                            asked_goal=asked_goal)
    trees = _trees(problem, goals, settings, weighed, {} if before is None else before.trees,
                   is_compared, progress.part(0.0, 0.5)) if nobody is None else {}
    try:
        known = [path.points for path in trees.values()]
        if before is not None:
            known.append(before.plan.points)
        tree = trees["RRT*"].raw if is_compared and "RRT*" in trees else None
        gentle, detour = _gentle(problem, known, tree, settings, ENOUGH if is_bounded else _ANY,
                                 progress.part(0.5, 1.0))
    except BlockedError as error:
        if nobody is None or UNPROVEN in error.seen:
            raise
        raise BlockedError(nobody.seen, f"{nobody.why} {error.why}", nobody.fix).behind(
            error.wall, error.nearest) from error
    if detour is not None:
        weighed = replace(weighed, distance=detour.weight * weighed.distance)
        problem = replace(problem, weights=weighed.weights)
    plan, certificate = _chosen(problem, gentle, trees, settings)
    baseline = _shortest_known(problem, trees.get("RRT*"), plan)
    compared = {"straight line": np.stack([start, goal.centre(field)]),
                "eikonal": gentle.points}
    for name, path in trees.items():
        compared |= {name: path.points, f"{name}, not smoothed": path.raw}
    return PathPair(baseline, plan, _approach(problem, settings), weighed, certificate, compared,
                    detour=detour, trees=trees,
                    unbounded=None if is_bounded or detour is not None else problem)


def with_bound(pair: PathPair, progress: Progress = SILENT) -> PathPair:
    """Return the pair, its plan as it is, with a close bound."""
    if pair.unbounded is None:
        return pair
    cost = pair.unbounded.cost(pair.plan.points)
    return replace(pair, unbounded=None, certificate=certify(
        pair.unbounded, lambda _rough: cost, progress=progress))


def _chosen(problem: GentleProblem, gentle: GentlePath, trees: dict[str, FoundPath],
            settings: PlanSettings) -> tuple[FoundPath, Certificate]:
    """Return the plan of the requested planner, and its gap to the best. NoPathError if that
    planner found none."""
    certificate = gentle.certificate
    if settings.planner == "eikonal":
        return FoundPath(gentle.points, gentle.cost, gentle.cost, [
            {"iteration": number + 1, "cost": level["upper"]}
            for number, level in enumerate(certificate.levels)], engine="eikonal"), certificate
    if "D-RRT*" not in trees:
        raise NoPathError(f"D-RRT* found no path in {settings.effort.iterations} iterations, but a "
                          "path exists.", "The eikonal planner found it.", "Omit ",
                          Option("planner"), ".")
    plan = trees["D-RRT*"]
    return plan, replace(certificate, upper=problem.cost(plan.points))


def _staying(field: EnergyField, start: np.ndarray, goal: Goal, settings: PlanSettings,
             limits: FieldArrays, sure: FieldArrays | None) -> PathPair:
    """Return the plan if the start is in the goal: both paths stay there."""
    weighed = CostWeights.between(field, start, goal.centre(field), *settings.weights)
    problem = GentleProblem(field, limits, weighed.weights, start, goal, sure=sure)
    path = FoundPath(np.stack([start, start]), 0.0, 0.0, engine=NOTHING_ASKED)
    return PathPair(path, path, _approach(problem, settings), weighed, Certificate(0.0, 0.0),
                    {"straight line": path.points, "eikonal": path.points})


def _gentle(problem: GentleProblem, known: list[np.ndarray], tree: np.ndarray | None,
            settings: PlanSettings, enough: float, progress: Progress,
            ) -> tuple[GentlePath, DetourPath | None]:
    """Return the gentlest path, and the effect of a limit on its length."""
    if settings.max_detour is None:
        return plan_gentle(problem, known, enough=enough, progress=progress), None
    detour = _detour(problem, known, tree, settings, progress)
    return detour.found, detour


def _detour(problem: GentleProblem, known: list[np.ndarray], tree: np.ndarray | None,
            settings: PlanSettings, progress: Progress) -> DetourPath:
    """Return the gentlest path within the length that the settings allow over the ``tree``'s path
    [n, 3], or the shortest one if it has none."""
    if settings.planner != "eikonal":
        raise InputError(
            Text(Option("max_detour"), " is given with ", Option("planner", "d-rrt-star"), "."),
            "D-RRT* cannot limit the length of its path.", "Omit ", Option("planner"), ".")
    rough = known or [plan_gentle(problem, progress=progress.part(0.0, 0.3)).points]
    paths = [_shortest(problem, path) for path in rough]
    # Near a limit none of them may be free, but those that they began from are.
    shortest = min([path.points for path in paths if np.isfinite(path.cost)] or rough,
                   key=lambda points: arc_lengths(points)[-1])
    length = float(arc_lengths(shortest)[-1])
    if tree is not None:  # as long as it is reported
        length = max(length, float(arc_lengths(resample(tree, STEP))[-1]))
    most = (1.0 + present(settings.max_detour, "largest detour") / 100.0) * length
    return plan_detour(problem, shortest, most, rough, has_curve=tree is None,
                       progress=progress.part(0.3, 1.0))


def _trees(problem: GentleProblem, goals: np.ndarray, settings: PlanSettings,
           weighed: CostWeights, before: dict[str, FoundPath], is_compared: bool,
           progress: Progress) -> dict[str, FoundPath]:
    """Return the results of RRT*, and of D-RRT* if it ``is_compared`` or plans, new or from
    before: either, both or none."""
    engine = chosen_engine(settings.effort.engine)
    search = Search(iterations=settings.effort.iterations, seed=settings.seed)
    shortest = replace(weighed, deformation=0.0, distance=1.0)
    found = {}
    for number, (name, cost) in enumerate([("RRT*", shortest), ("D-RRT*", weighed)][
            :2 if is_compared or settings.planner != "eikonal" else 1]):
        part = progress.part(0.5 * number, 0.5 * (number + 1))
        part(0.0, name)
        asked = PathProblem(problem.energy_field, problem.limits, cost.weights, problem.start,
                            problem.goal, goals=goals)
        if name in before and (again := found_again(before[name], asked)):
            found[name] = again
            continue
        try:
            found[name] = plan_path(asked, search, engine=engine, progress=part)
        except NoPathError:
            progress.warn(f"{name} found no path. The search goes on without it.")
    return found


def _shortest_known(problem: GentleProblem, tree: FoundPath | None, plan: FoundPath) -> FoundPath:
    """Return the shortest of RRT*'s path, which is refined on its length, the plan, and the plan
    shortened as far as possible: the tree's samples may have led another way."""
    known = [plan] if tree is None else [tree, plan]
    shortened = _shortest(problem, plan.points)
    shortest = min((*known, *([shortened] if np.isfinite(shortened.cost) else [])),
                   key=lambda one: float(arc_lengths(one.points)[-1]))
    return replace(shortest, history=known[0].history)


def _shortest(problem: GentleProblem, path: np.ndarray) -> FoundPath:
    """Return the path shortened as far as possible."""
    weights = problem.weights._replace(energy=0.0)
    points, cost = refine(path, replace(problem, weights=weights))
    return FoundPath(points, cost, cost, engine="refined")


def _approach(problem: GentleProblem, settings: PlanSettings) -> np.ndarray:
    """Return a gentle path [k, 3] from rest to the start, within the same limits. NoPathError if
    there is none."""
    field, start = problem.energy_field, problem.start
    if np.linalg.norm(start - field.rest) < STEP:
        return field.rest[None]
    cost = CostWeights.between(field, field.rest, start, *settings.weights)
    goal = grasp_goal(start, _AT_START)
    path = GentleProblem(field, problem.limits, cost.weights, field.rest.copy(), goal,
                         sure=problem.sure)
    line = np.linspace(field.rest, start, 40)
    points, least = refine(line, path)
    if not np.isfinite(least):
        try:
            rough = plan_path(PathProblem(
                field, problem.limits, cost.weights, field.rest, grasp_goal(start, 1e-9),
                goals=start[None]), Search(iterations=1500, seed=settings.seed)).points
            points, _ = refine(rough, path)
        except NoPathError:
            # A tree that misses a narrow passage is not conclusive: the grid finds it, or states
            # why not.
            points = plan_gentle(path, enough=_ANY).points
    return np.concatenate([points, start[None]])
