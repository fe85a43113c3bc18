"""Allowed poses of a goal, and the error if there are none."""

import numpy as np

from limber.core.errors import NoPathError
from limber.core.numerics.compiled import compiled
from limber.planning.field.energy_field import EnergyField, FieldArrays, allowed_at, energy_at
from limber.planning.field.limited_quantities import limited
from limber.planning.goals.goal import Goal
from limber.planning.goals.regions import position_text

_MILLIMETRES = 30.0  # times the sampled region's size; a goal is never so far away

_HALVINGS = 20  # halvings of a path into the goal
_NEARER, _NEAREST = 3, 10  # rounds in which paths near the last round's best are tried
_ASIDE, _DEEPER = 0.2, 1.15  # of the distance: sideways offset, and depth behind the border


class GoalOverLimitsError(NoPathError):
    """None of the poses drawn in the goal region keeps the limits."""


def goal_points(goal: Goal, field: EnergyField, limits: FieldArrays, *, count: int = 200,
                seed: int = 0) -> np.ndarray:
    """Return allowed grasp positions in the goal region, at most ``count``, shape [n, 3].

    Raises:
        NoPathError: the region is out of reach. GoalOverLimitsError: no drawn pose keeps the
            limits; in a narrow valley one may.
    """
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
            "Raise the limit (--max-energy, --max-force and others, the workspace), or choose a "
            "goal nearer to the rest pose.")
    return np.ascontiguousarray(allowed)


def with_near_side(points: np.ndarray, start: np.ndarray, goal: Goal, field: EnergyField,
                   limits: FieldArrays) -> np.ndarray:
    """Return ``points`` [n, 3] of the goal, and where the straight lines to them from ``start`` [3]
    enter it: in a large goal, short and gentle paths end on the near side. More lines are tried
    around the nearest ones.
    """
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
    """Return where the straight lines from ``start`` [3] to ``points`` [n, 3] of the goal enter it.
    """
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


@compiled
def allowed_points(points: np.ndarray, limits: FieldArrays) -> np.ndarray:
    """Return whether each of ``points`` [n, 3] is trusted and within the limits, bool [n]."""
    allowed = np.empty(len(points), np.bool_)
    for i in range(len(points)):
        allowed[i] = allowed_at(points[i], energy_at(points[i], limits), limits)
    return allowed


def _out_of_reach(goal: Goal, field: EnergyField, seed: int) -> NoPathError:
    points = field.region.draw(2000, np.random.default_rng(seed))
    distance = goal.distance(field, points)
    nearest = points[np.argmin(distance)]
    missed = max(float(distance.min()) - goal.tolerance, 0.0)
    return NoPathError(
        f"No sampled pose brings {goal.what} {goal.where}; the nearest misses it by "
        f"{missed:.3f} m, with the grasp at {position_text(nearest)} m"
        f"{unit_hint(missed, field)}.",
        "The branch was sampled with its grasp from "
        f"{position_text(field.region.low)} to {position_text(field.region.high)} m.",
        f"{goal.advice}, or sample farther (`limber energy --deflection`).")


def unit_hint(off: float, field: EnergyField) -> str:
    """Return a hint about the unit if something is so far ``off`` [m] that it is hardly in metres;
    else an empty text.
    """
    size = float(np.linalg.norm(field.region.high - field.region.low))
    return " (in millimetres? Lengths are in metres)" if off > _MILLIMETRES * size else ""
