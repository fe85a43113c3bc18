"""Two paths to the same goal region on one field: the shortest, and the gentle one."""

from dataclasses import dataclass

import numpy as np

from limber.errors import InputError, NoPathError
from limber.planning.cost import STEP, CostWeights
from limber.planning.field import EnergyField, FieldArrays
from limber.planning.goals import Goal, allowed_points, goal_points
from limber.planning.ompl_engine import ompl_missing
from limber.planning.rrt_star import FoundPath, PathProblem, Search, plan_path
from limber.planning.settings import PlanSettings
from limber.progress import SILENT, Progress


@dataclass(frozen=True)
class PathPair:
    """RRT* (length alone) and D-RRT* between the same start and goal region.

    ``approach`` [k, 3] leads gently from the rest pose to the start: a branch that is pushed
    there straight may buckle on the way and be another branch when it arrives.
    """

    baseline: FoundPath
    plan: FoundPath
    approach: np.ndarray
    cost: CostWeights


def plan_pair(field: EnergyField, start: np.ndarray, goal: Goal, settings: PlanSettings, *,
              progress: Progress = SILENT) -> PathPair:
    """Plan both paths under the same limits, with the same search.

    Raises:
        InputError: the start is not allowed.
        NoPathError: the goal cannot be reached; says why.
    """
    limits = limits_of(field, settings)
    _check_start(field, start, limits)
    goals = goal_points(goal, field, limits, seed=settings.seed)
    nearest = goals[np.argmin(np.linalg.norm(goals - start, axis=1))]
    engine = chosen_engine(settings.engine)
    search = Search(iterations=settings.iterations, seed=settings.seed)

    def in_goal(points: np.ndarray) -> np.ndarray:
        return goal.distance(field, points) <= goal.tolerance

    found = []
    weighed = CostWeights.between(field, start, nearest, deformation=settings.deformation_weight,
                                  distance=settings.distance_weight)
    shortest = CostWeights(0.0, 1.0, weighed.energy_scale, weighed.length_scale)
    for number, (name, cost) in enumerate([("RRT*", shortest), ("D-RRT*", weighed)]):
        part = progress.part(0.45 * number, 0.45 * (number + 1))
        part(0.0, name)
        problem = PathProblem(start, goals, in_goal, field, limits, cost.weights)
        found.append(plan_path(problem, search, engine=engine, progress=part))
    return PathPair(*found, _approach(field, start, settings), weighed)


def _approach(field: EnergyField, start: np.ndarray, settings: PlanSettings) -> np.ndarray:
    if np.linalg.norm(start - field.rest) < STEP:
        return field.rest[None]
    cost = CostWeights.between(field, field.rest, start, distance=settings.distance_weight,
                               deformation=max(settings.deformation_weight, 1.0))
    problem = PathProblem(field.rest, start[None], lambda points: np.linalg.norm(
        points - start, axis=1) < 1e-9, field, field.limited(), cost.weights)
    return plan_path(problem, Search(iterations=1500, seed=settings.seed)).points


def limits_of(field: EnergyField, settings: PlanSettings) -> FieldArrays:
    """Return the field's arrays with the settings' limits; none given means no limit."""
    return field.limited(settings.max_energy or np.inf, settings.max_force or np.inf)


def chosen_engine(engine: str) -> str:
    """Return ``ompl`` or ``own`` for the setting.

    Both find equally good paths in about the same time (scripts/bench planning); OMPL's is the
    planner that others know, ours runs where OMPL has no wheel.
    """
    if engine == "auto":
        return "own" if ompl_missing() else "ompl"
    return engine


def random_start(field: EnergyField, goal: Goal, settings: PlanSettings, seed: int) -> np.ndarray:
    """Return a random deformed configuration far from rest and from the goal, shape [3].

    The paper's trials start from "randomized initial configurations"; it does not say how they
    were drawn. Here: uniform over the allowed region, at least half the largest deflection away
    from rest, and outside the goal by as much.

    Raises:
        NoPathError: no such configuration was found.
    """
    generator = np.random.default_rng([seed, 7])
    points = field.region.draw(4000, generator)
    half = 0.5 * float(np.linalg.norm(field.samples.positions - field.rest, axis=1).max())
    fit = np.linalg.norm(points - field.rest, axis=1) >= half
    fit &= goal.distance(field, points) >= half
    fit &= allowed_points(points, limits_of(field, settings))
    if not fit.any():
        raise NoPathError("No deformed start lies far from rest, far from the goal and allowed.",
                          f"Far is {half:.3f} m.", "Give a --start, or relax the limits.")
    return points[np.flatnonzero(fit)[0]]


def _check_start(field: EnergyField, start: np.ndarray, limits: FieldArrays) -> None:
    if allowed_points(start[None], limits)[0]:
        return
    place = ", ".join(f"{value:.3f}" for value in start)
    if not field.region.contains(start)[0]:
        raise InputError(f"The start ({place}) m lies outside the sampled region.",
                         "The branch's energy is not known there.",
                         "Choose a start nearer to rest, or sample farther (`limber energy "
                         "--deflection`).")
    energy = float(field.energy(start)[0])
    force = float(np.linalg.norm(field.force(start)))
    raise InputError(f"At the start the energy is {energy:.3g} J and the force {force:.3g} N.",
                     f"Allowed are {limits.max_energy:.3g} J and {limits.max_force:.3g} N.",
                     "Raise the limit, or choose another start.")
