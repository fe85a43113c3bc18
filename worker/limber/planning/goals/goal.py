"""Goals of a plan, and the description of a kind of goal.

Each kind has its own file beside this one; :mod:`limber.planning.goals.goal_kinds` has the list.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from limber.core.errors import Command, NoPathError, Option, Text
from limber.kernels import Kernel, for_kernels
from limber.planning.field.energy_field import (
    EnergyField,
    FieldArrays,
    limited,
)
from limber.planning.field.grasp_model import GraspModel
from limber.planning.field.stored_states import States
from limber.planning.settings import PlanSettings

# Regions of space as goals for a point on the branch.
#
# Each has a signed distance: negative inside, and outside at most the true one.


class Region(Protocol):
    """A region of space, branch frame."""

    @property
    def middle(self) -> np.ndarray:
        """A point well inside [m], shape [3]."""
        ...

    @property
    def depth(self) -> float:
        """Lower bound of the middle's distance from the outside [m]."""
        ...

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distance of ``points`` [n, 3], shape [n]."""
        ...

    def draw(self, count: int, generator: np.random.Generator) -> np.ndarray:
        """Return ``count`` points of the region, shape [count, 3]."""
        ...

    @property
    def words(self) -> str:
        """The region as a user gave it, after "within": lengths in metres."""
        ...

    def describe(self) -> dict:
        """Return it as plain data."""
        ...


@dataclass(frozen=True)
class Ball:
    """The points within ``radius`` [m] of ``centre`` [m]."""

    centre: tuple[float, float, float]
    radius: float

    @property
    def middle(self) -> np.ndarray:
        return np.array(self.centre, float)

    @property
    def depth(self) -> float:
        return self.radius

    def distance(self, points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(np.asarray(points) - self.centre, axis=1) - self.radius

    def draw(self, count: int, generator: np.random.Generator) -> np.ndarray:
        return self.middle + 0.9 * self.radius * ball(count, generator)

    @property
    def words(self) -> str:
        return f"{self.radius:.3f} m of {position_text(self.centre)} m"

    def describe(self) -> dict:
        return {"position_m": list(map(float, self.centre)), "tolerance_m": self.radius}


class Convex(Protocol):
    """The points below planes ``n . x + c`` with unit normals; ``planes`` [k, 4]."""

    @property
    def planes(self) -> np.ndarray: ...

    @property
    def corners(self) -> np.ndarray: ...

    @property
    def middle(self) -> np.ndarray:
        return self.corners.mean(axis=0)

    @property
    def depth(self) -> float:
        return float(-self.distance(self.middle[None])[0])

    def distance(self, points: np.ndarray) -> np.ndarray:
        return (np.asarray(points) @ self.planes[:, :3].T + self.planes[:, 3]).max(axis=1)

    def draw(self, count: int, generator: np.random.Generator) -> np.ndarray:
        weights = generator.dirichlet(np.ones(len(self.corners)), count)
        return weights @ self.corners


@dataclass(frozen=True)
class BoxRegion(Convex):
    """The box from ``low`` to ``high`` [m]."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @property
    def planes(self) -> np.ndarray:
        return np.vstack([np.column_stack([np.eye(3), -np.array(self.high)]),
                          np.column_stack([-np.eye(3), np.array(self.low)])])

    @property
    def corners(self) -> np.ndarray:
        ends = np.array([self.low, self.high], float)
        return np.array([[ends[i, 0], ends[j, 1], ends[k, 2]]
                         for i in (0, 1) for j in (0, 1) for k in (0, 1)])

    @property
    def words(self) -> str:
        return f"the box from {position_text(self.low)} to {position_text(self.high)} m"

    def describe(self) -> dict:
        return {"low_m": list(map(float, self.low)), "high_m": list(map(float, self.high))}


def empty_along(low: Sequence[float] | np.ndarray, high: Sequence[float] | np.ndarray) -> str:
    """Return in words along which axis a box from ``low`` [3] to ``high`` [3] [m] is empty."""
    axis = int(np.flatnonzero(~np.less(low, high))[0])
    return f"along {'xyz'[axis]}, from {low[axis]:.3f} to {high[axis]:.3f} m"


def position_text(point: Sequence[float] | np.ndarray) -> str:
    """Return a position [3] in words, to millimetres."""
    return "(" + ", ".join(f"{value + 0.0:.3f}" for value in point) + ")"


def ball(count: int, generator: np.random.Generator) -> np.ndarray:
    """Return points uniform in the unit ball, shape [count, 3]."""
    direction = generator.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * generator.uniform(size=(count, 1)) ** (1 / 3)


NEARER = Text("Choose a goal nearer to this region, raise ", Option("goal_tolerance"))
"""Advice for a ball that nothing reaches."""


class Goal(Protocol):
    """A region of grasp positions.

    Attributes:
        tolerance: Largest ``distance`` at which the branch is in the goal [m].
        what: The part of the branch to be brought there, in words.
        where: Where it is brought, in words, after "brings it".
        advice: What a user may change if nothing reaches it, a clause.
    """

    @property
    def tolerance(self) -> float: ...

    @property
    def what(self) -> str: ...

    @property
    def where(self) -> str: ...

    @property
    def advice(self) -> str: ...

    def distance(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        """Return the branch's distance from the goal with its grasp at ``points`` [m], [n]."""
        ...

    def uncertainty(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        """Return how much nearer than its ``distance`` the branch may be at most with its grasp at
        ``points`` [m], shape [n]; infinite if the field's error is not known.
        """
        ...

    def guess(self, field: EnergyField, count: int, generator: np.random.Generator) -> np.ndarray:
        """Return grasp positions that are probably in the region, shape [n, 3]."""
        ...

    def centre(self, field: EnergyField) -> np.ndarray:
        """Return one representative grasp position of the region, the same for any seed, [3]."""
        ...

    def missed_by(self, states: States) -> float:
        """Return how far outside the goal the last state is [m]; inside: 0 or below."""
        ...

    def drawn_in(self, states: States) -> "Goal":
        """Return the goal to plan for next if the last state was the end of a plan."""
        ...

    def require_end(self, grasp_model: GraspModel, states: States) -> None:
        """Raise NoPathError if the last state is in the region and is not valid."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return the goal as plain data: its ``kind``, and for pictures ``position_m`` [3] and
        ``tolerance_m``, a ball in it."""
        ...

    def describe_end(self, states: States) -> dict[str, Any]:
        """Return the plan summary's entries about the last state, as plain data."""
        ...


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

_HALVINGS = 20  # halvings of a path into the goal
_NEARER, _NEAREST = 3, 10  # rounds in which paths near the last round's best are tried
_ASIDE, _DEEPER = 0.2, 1.15  # of the distance: sideways offset, and depth behind the border


class GoalOverLimitsError(NoPathError):
    """None of the poses drawn in the goal region keeps the limits."""


def goal_points(goal: Goal, field: EnergyField, limits: FieldArrays, *, count: int = 200,
                seed: int = 0) -> np.ndarray:
    """At most ``count`` allowed grasp positions [n, 3] in the goal. NoPathError if out of reach;
    GoalOverLimitsError if no drawn pose keeps the limits, though in a narrow valley one may."""
    points = goal.guess(field, count, np.random.default_rng(seed))
    reached = points[goal.distance(field, points) <= goal.tolerance]
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
        near = _entered(aims, start, goal, field)
        near = near[allowed_points(near, limits)]
        found.append(near)
        away = np.linalg.norm(near - start, axis=1)
        best = near[np.argsort(away)[:_NEAREST]]
        if not len(best):
            break
        aims = np.repeat(best, len(points) // len(best) + 1, axis=0)
        aims = aims + _ASIDE * away.min() * generator.normal(size=aims.shape)
        aims = start + _DEEPER * (aims - start)
        aims = aims[goal.distance(field, aims) <= goal.tolerance]
        if not len(aims):
            break
    return np.concatenate(found)


def _entered(points: np.ndarray, start: np.ndarray, goal: Goal, field: EnergyField) -> np.ndarray:
    """Return where straight lines from ``start`` [3] to ``points`` [n, 3] of the goal enter it."""
    low, high = np.zeros(len(points)), np.ones(len(points))
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        inside = goal.distance(field, start + middle[:, None] * (points - start)) <= goal.tolerance
        low, high = np.where(inside, low, middle), np.where(inside, middle, high)
    return np.ascontiguousarray(start + high[:, None] * (points - start))


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
    distance = goal.distance(field, points)
    nearest = points[np.argmin(distance)]
    missed = max(float(distance.min()) - goal.tolerance, 0.0)
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
