"""Goals of a plan: a point of the branch in a region of space, and the kinds that settings name.

Own and external kinds are listed in :mod:`limber.planning.goals.goal_kinds`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from limber.core.errors import Command, NoPathError, Option, Text
from limber.kernels import Kernel, for_kernels
from limber.planning.field.energy_field import EnergyField, FieldArrays, limited, refit
from limber.planning.field.grasp_model import GraspModel
from limber.planning.field.sampling import solve_branch
from limber.planning.field.stored_states import States
from limber.planning.goals.region import Ball, Region, position_text
from limber.planning.settings import PlanSettings

NEARER = Text("Choose a goal nearer to this region, raise ", Option("goal_tolerance"))
"""Advice for a ball that nothing reaches."""
_COVERED = 0.95  # fraction of the samples that the margin covers
_MOST = 0.4  # fraction of a region's depth; where the field is worse, the full model decides
_SHARES = (1.0, 0.5, 0.2)  # fractions of the margin that are tried
_DRAWN = 200  # poses with which they are
_INNER = 0.9  # fraction of a region at whose places a target is aimed
_SMALL = 0.02  # [m] depth of a region up to which targets are drawn in all of it
_HALVINGS = 12  # halvings of a path into a region
_GROWN = 8  # most states of the branch model towards a region


@dataclass(frozen=True)
class Point:
    """A point of the branch: the grasp, else the target ``number``, else the tip."""

    name: str = "tip"
    number: int | None = None
    is_grasp: bool = False

    def at(self, field: EnergyField, grasps: np.ndarray) -> np.ndarray:
        """Return its position with the grasp at ``grasps`` [m], shape [n, 3] each."""
        return np.asarray(grasps) if self.is_grasp else field.tip(grasps, self.number)

    def errors(self, field: EnergyField, grasps: np.ndarray, covered: float = 1.0) -> np.ndarray:
        """Return the field's possible error of that position (``EnergyField.place_errors``)."""
        if self.is_grasp:
            return np.zeros(len(grasps))
        return field.place_errors(self.number, grasps, covered)

    def in_states(self, states: States) -> np.ndarray:
        """Return its position in each state [m], shape [n, 3]."""
        if self.is_grasp:
            return states.positions
        return states.tips if self.number is None else states.targets[:, self.number]


GRASP, TIP = Point("grasp", is_grasp=True), Point()


@dataclass(frozen=True)
class Goal:
    """A point of the branch within a region of space: a set of grasp positions.

    Attributes:
        inset: Distance that plans keep from the region's outside [m]: what an earlier one missed.
        margin: Fraction of the field's error at each pose that plans keep from it as well.
        advice: What a user may change if nothing reaches it, a clause.
    """

    point: Point
    region: Region
    inset: float = 0.0
    margin: float = 0.0
    advice: str = NEARER

    @property
    def tolerance(self) -> float:
        """Distance of the region's middle from its outside [m]."""
        return self.region.depth

    @property
    def what(self) -> str:
        """The point in words."""
        return f"the {self.point.name}"

    @property
    def where(self) -> str:
        """Where it is brought, in words, after "brings it"."""
        return f"within {self.region.words}"

    def excess(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        """Return how far outside the goal the branch is with its grasp at ``points`` [m], [n]; in
        it: 0 or below."""
        return self.region.distance(self.point.at(field, points)) + self._kept_off(field, points)

    def uncertainty(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        """Return how much less than its ``excess`` the branch may be outside the region at most
        with its grasp at ``points`` [m], [n]; infinite if the field's error is not known."""
        return self._kept_off(field, points) + self.point.errors(field, points)

    def _kept_off(self, field: EnergyField, points: np.ndarray) -> np.ndarray | float:
        return self.inset + self.margin_at(field, points)

    def margin_at(self, field: EnergyField, points: np.ndarray) -> np.ndarray | float:
        """Return what plans keep from the outside at ``points`` due to the field's error [m], [n].
        """
        if self.margin == 0.0:
            return 0.0
        stated = self.point.errors(field, points, _COVERED)
        stated = np.where(np.isfinite(stated), stated, 0.0)  # not known: the full model decides
        return self.margin * np.minimum(stated, _MOST * self.tolerance)

    def with_margin(self, field: EnergyField, limits: FieldArrays, start: np.ndarray) -> Self:
        """Return the goal less the field's error in the point's position, or the largest of a few
        fractions of it with which a drawn pose keeps ``limits``; all of it if the ``start`` [3] is
        in it. The grasp's position has no error."""
        if self.point.is_grasp or self.excess(field, start[None])[0] <= 0.0:
            return self
        for share in _SHARES:
            part = replace(self, margin=share)
            points = part.guess(field, _DRAWN, np.random.default_rng(0))
            reached = part.excess(field, points) <= 0.0
            if allowed_points(np.ascontiguousarray(points[reached]), limits).any():
                return part
        return self

    def guess(self, field: EnergyField, count: int, generator: np.random.Generator) -> np.ndarray:
        """Return grasp positions that are probably in the goal, shape [n, 3]."""
        if self.point.is_grasp:
            inside = self.region.draw(count, generator)
            inside[0] = self.region.middle
            return inside
        # A small region is a thin bent lens in grasp space: draw everywhere, then walk onto it.
        # Points already in it stay: in a large one a walk may lead out of the samples.
        drawn = field.region.draw(20 * count, generator)
        excess = self.excess(field, drawn)
        points = drawn[excess <= 0.0][:count]
        found = np.concatenate([points, self._walked(
            field, drawn[np.argsort(excess)[len(points):count]], generator)])
        if (self.excess(field, found) <= 0.0).any():
            return found
        # Where the target moves far within millimetres of the grasp, draws miss a region that a
        # sample is in, or near to.
        known = field.samples.positions
        known = known[np.argsort(self.excess(field, known), kind="stable")[:count]]
        return np.concatenate([found, known, self._walked(field, known, generator)])

    def _walked(self, field: EnergyField, points: np.ndarray, generator: np.random.Generator,
                ) -> np.ndarray:
        """Return ``points`` [n, 3] moved so that the target approaches places in the region; none
        leaves the box that was sampled, beyond which the field knows nothing."""
        if not len(points):
            return points
        aims = self._aims(self.point.at(field, points),
                          self.region.draw(len(points), generator, _INNER))
        for _ in range(8):
            outside = self.excess(field, points) > -0.5 * self.tolerance
            points = np.clip(points + np.where(outside[:, None], self._steps(
                field, points, self.point.at(field, points), aims), 0.0), field.region.low,
                             field.region.high)
        return points

    def _aims(self, positions: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Points [n, 3] just inside the region on the path to places inside: in a large region
        others are far out of the branch's reach."""
        inside = 0.25 * min(self.tolerance, _SMALL)
        return entered(lambda points: self.region.distance(points) <= -inside, positions, places,
                       _HALVINGS)

    def _steps(self, field: EnergyField, grasps: np.ndarray, positions: np.ndarray,
               aims: np.ndarray) -> np.ndarray:
        """Gauss-Newton steps [n, 3] of the grasp that bring the target from ``positions`` [n, 3] to
        ``aims`` [n, 3], damped where it moves little."""
        slope = field.tip_gradient(grasps, self.point.number)
        normal = slope @ slope.transpose(0, 2, 1) + 1e-3 * np.eye(3)
        return np.linalg.solve(normal, slope @ (aims - positions)[:, :, None])[:, :, 0]

    def grown(self, field: EnergyField, grasp_model: GraspModel) -> EnergyField:
        """Return the field with states of the branch model on the way from the sample nearest to
        the region into it, where the field has no pose in it; as it is if the way does not end
        there."""
        drawn = self.guess(field, _DRAWN, np.random.default_rng(0))
        nearest = int(self.region.distance(self.point.in_states(field.samples)).argmin())
        place, states = field.samples.positions[nearest][None], list[States]()
        while len(states) < _GROWN and (self.excess(field, drawn) > 0.0).all():
            found = solve_branch(grasp_model, place, workers=1)[0]
            if not found:
                break
            states.append(found[0].state)
            if len(states) > 1 and self.missed_by(states[-1]) <= 0.0:
                return refit(field, States.joined(*states[1:]))
            tip = self.point.in_states(states[-1])
            place = place + self._steps(field, place, tip,
                                        self._aims(tip, self.region.middle[None]))
        return field

    def centre(self, field: EnergyField) -> np.ndarray:
        """Return one representative grasp position of the goal, the same for any seed, [3]."""
        if self.point.is_grasp:
            return self.region.middle
        points = self.guess(field, 50, np.random.default_rng(0))
        trusted = points[field.region.contains(points)]
        points = trusted if len(trusted) else points
        return points[np.argmin(self.excess(field, points))]

    def missed_by(self, states: States) -> float:
        """Return how far outside the region the last state is [m]; inside: 0 or below."""
        return float(self.region.distance(self.point.in_states(states))[-1])

    def drawn_in(self, states: States) -> Self:
        """Return the goal to plan for next if the last state was the end of a plan: inwards by its
        distance from it, at most half."""
        if self.point.is_grasp:
            return self
        missed = max(self.missed_by(states), 0.0)
        return replace(self, inset=min(self.inset + 1.5 * missed, 0.5 * self.tolerance))

    def require_end(self, grasp_model: GraspModel, states: States) -> None:
        """Raise NoPathError if the last state is in the region and is not valid."""

    def describe(self) -> dict[str, Any]:
        """Return the goal as plain data: its ``kind``, and for pictures ``position_m`` [3] and
        ``tolerance_m``, a ball in it."""
        told = {"position_m": self.region.middle.tolist(), "tolerance_m": self.tolerance}
        if self.point.is_grasp:
            return {"kind": "grasp", **told}
        return {"kind": "tip" if self.point.number is None else "target",
                "target": self.point.name, **told, "region": self.region.describe()}

    def describe_end(self, states: States) -> dict[str, Any]:
        """Return the plan summary's entries about the last state, as plain data."""
        return {} if self.point.is_grasp else {"target_end_m": self.point.in_states(states)[-1]}


def grasp_goal(position: Sequence[float] | np.ndarray, tolerance: float) -> Goal:
    """Return the goal of a grasp within ``tolerance`` [m] of ``position`` [3]."""
    x, y, z = map(float, position)
    return Goal(GRASP, Ball((x, y, z), tolerance))


def entered(is_inside: Callable[[np.ndarray], np.ndarray], start: np.ndarray, ends: np.ndarray,
            halvings: int) -> np.ndarray:
    """Return where straight lines from ``start`` [n, 3] or [3] to ``ends`` [n, 3] enter a set,
    given which of points [n, 3] it contains; found by that many ``halvings``."""
    low, high = np.zeros(len(ends)), np.ones(len(ends))
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        inside = is_inside(start + middle[:, None] * (ends - start))
        low, high = np.where(inside, low, middle), np.where(inside, middle, high)
    return start + high[:, None] * (ends - start)


@dataclass(frozen=True)
class CellPlace:
    """A region given by a robot's cell.

    Attributes:
        region: Contains every valid position.
        blocked: Why a position [3] in it is not valid while the branch's surface is at triangles
            [f, 3, 3] (None: not known), as a clause; empty if it is valid.
        of_surface: Whether that surface counts.
        words: The region in words, after "within".
        refusal: Sentence without full stop if no position is valid, with ``{what}``.
        advice: What a user may change then, a clause.
    """

    region: Region
    blocked: Callable[[np.ndarray, np.ndarray | None], str]
    of_surface: bool
    words: str
    refusal: str
    advice: str

    def require(self, what: str, position: np.ndarray, surface: np.ndarray | None) -> None:
        """Raise NoPathError if ``position`` [3] is not valid for something, given in words."""
        if cause := self.blocked(position, surface):
            raise NoPathError(
                f"{self.refusal.format(what=what)} at the end of the path: {cause}.",
                f"{what[0].upper()}{what[1:]} is at {position_text(position)} m there.",
                self.advice, ".").at(position)


@dataclass(frozen=True)
class GoalRequest:
    """Inputs from which a goal is made.

    Attributes:
        field, grasp_model: Field and model of the branch.
        settings: Settings of the plan.
        limits: Those settings' limits on the field.
        cell: Data of a robot's cell, by the names of settings.
    """

    field: EnergyField
    grasp_model: GraspModel
    settings: PlanSettings
    limits: FieldArrays
    cell: Mapping[str, CellPlace]


@dataclass(frozen=True)
class GoalKind:
    """A kind of goal.

    Attributes:
        name: Name of the setting that requests it, if neither None nor False. An external kind
            brings settings of its own, a class that inherits from ``PlanSettings``.
        make: Makes the goal, given the setting's value; raises InputError or NoPathError if it
            cannot.
        is_of_target: Whether it is a position of the tip or of ``--target``.
        is_place: Whether the setting's value is a position [m], which no obstacle may cover.
    """

    name: str
    make: Callable[[GoalRequest, Any], Goal]
    is_of_target: bool = False
    is_place: bool = False

    @property
    def option(self) -> str:
        return "--" + self.name.replace("_", "-")

    def is_asked(self, settings: PlanSettings) -> bool:
        """Whether the settings request it."""
        value = getattr(settings, self.name, None)
        return value is not None and value is not False


# Allowed poses of a goal, and the error if there are none.

_MILLIMETRES = 30.0  # times the sampled region's size; a goal is never so far away

_PATH_HALVINGS = 20  # halvings of a path into the goal
_NEARER, _NEAREST = 3, 10  # rounds in which paths near the last round's best are tried
_ASIDE, _DEEPER = 0.2, 1.15  # of the distance: sideways offset, and depth behind the border


class GoalOverLimitsError(NoPathError):
    """None of the poses drawn in the goal region keeps the limits."""


def goal_points(goal: Goal, field: EnergyField, limits: FieldArrays, *, count: int = 200,
                seed: int = 0) -> np.ndarray:
    """At most ``count`` allowed grasp positions [n, 3] in the goal. NoPathError if out of reach;
    GoalOverLimitsError if no drawn pose keeps the limits, though in a narrow valley one may."""
    points = goal.guess(field, count, np.random.default_rng(seed))
    reached = points[goal.excess(field, points) <= 0.0]
    trusted = reached[field.region.contains(reached)]
    if len(trusted) == 0:
        raise _out_of_reach(goal, field, seed)
    allowed = trusted[allowed_points(trusted, limits)]
    if len(allowed) == 0:
        raise GoalOverLimitsError(
            f"No pose in the goal region keeps the limits: {over_limits(field, trusted, limits)}.",
            f"{len(trusted)} poses in the region were checked.",
            "Raise the limit (", Option("max_energy"), ", ", Option("max_force"), " and others, "
            "the workspace), or choose a goal nearer to the rest pose.")
    return np.ascontiguousarray(allowed)


def with_near_side(points: np.ndarray, start: np.ndarray, goal: Goal, field: EnergyField,
                   limits: FieldArrays) -> np.ndarray:
    """Return points [n, 3] and where straight lines to them from ``start`` enter the goal, more
    about the nearest: in a large goal, short and gentle paths end on the near side."""
    generator, found = np.random.default_rng(0), [points]
    aims = points
    for _ in range(_NEARER):
        border = np.ascontiguousarray(entered(lambda points: goal.excess(field, points) <= 0.0,
                                              start, aims, _PATH_HALVINGS))
        border = border[allowed_points(border, limits)]
        found.append(border)
        away = np.linalg.norm(border - start, axis=1)
        best = border[np.argsort(away)[:_NEAREST]]
        if not len(best):
            break
        aims = np.repeat(best, len(points) // len(best) + 1, axis=0)
        aims = aims + _ASIDE * away.min() * generator.normal(size=aims.shape)
        aims = start + _DEEPER * (aims - start)
        aims = aims[goal.excess(field, aims) <= 0.0]
        if not len(aims):
            break
    return np.concatenate(found)


def over_limits(field: EnergyField, points: np.ndarray, limits: FieldArrays) -> str:
    """Describe which limits none of ``points`` [n, 3] keeps, and by how much."""
    outside = np.maximum(limits.low - points, points - limits.high).max(axis=1)
    exceeded = [f"the {one.words} is at least {one.with_unit(least)}, its limit is "
                f"{one.with_unit(one.limit)}" for one in limited(field, limits)
                if (least := float(one.size(points).min())) > one.limit]
    if outside.min() > 0.0:
        exceeded.append(f"the workspace is {outside.min():.3f} m away"
                        + unit_hint(outside.min(), field))
    return " and ".join(exceeded) or "every pose breaks at least one of them"


_ALLOWED = Kernel("points_allowed", "points float64[points, 3]", "field float64[field]",
                  "out allowed bool[points]")


def allowed_points(points: np.ndarray, limits: FieldArrays) -> np.ndarray:
    """Return whether each of ``points`` [n, 3] is trusted and within the limits, bool [n]."""
    allowed = np.empty(len(points), bool)
    _ALLOWED(for_kernels(points), limits.numbers, allowed)
    return allowed


def _out_of_reach(goal: Goal, field: EnergyField, seed: int) -> NoPathError:
    points = field.region.draw(2000, np.random.default_rng(seed))
    excess = goal.excess(field, points)
    nearest, missed = points[np.argmin(excess)], max(float(excess.min()), 0.0)
    return NoPathError(f"No sampled pose brings {goal.what} {goal.where}; the nearest misses it by "
                       f"{missed:.3f} m, with the grasp at {position_text(nearest)} "
                       f"m{unit_hint(missed, field)}.", "The branch was sampled with its grasp "
                       f"from {position_text(field.region.low)} to "
                       f"{position_text(field.region.high)} m.", goal.advice, ", or sample farther "
                       "(", Command("energy", Option("deflection")), ").").at(
                           goal.centre(field))


def unit_hint(off: float, field: EnergyField) -> str:
    """Return a hint about the unit if something is so far ``off`` [m] that it is hardly in metres;
    else an empty text."""
    size = float(np.linalg.norm(field.region.high - field.region.low))
    return " (in millimetres? Lengths are in metres)" if off > _MILLIMETRES * size else ""
