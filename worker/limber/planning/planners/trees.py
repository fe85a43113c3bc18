"""RRT* (Karaman and Frazzoli 2011) over grasp positions, in two engines behind one function.

``own`` (:mod:`limber.planning.planners.rrt_star`) runs wherever Limber runs, gives the same path on
every system and holds no lock. ``ompl`` (:mod:`limber.planning.planners.ompl_engine`) is the Open
Motion Planning Library's, kept as the reference that others know; it has no wheel for Windows, and
its ``solve`` keeps Python's interpreter lock, so call it in a worker process (each command is one).
``compare.chosen_engine`` says which is taken and why.

Both stop after a number of iterations, never a time, so a seed gives the same path again. Both
end with shortcuts that lower the cost; OMPL's other simplifiers ignore it.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from limber.core.errors import NoPathError
from limber.core.progress import SILENT, Progress
from limber.planning.cost import path_cost
from limber.planning.planners.ompl_engine import search_with_ompl
from limber.planning.planners.rrt_star import search_tree
from limber.planning.planners.smoothing import polish, shortcut, slide_end
from limber.planning.planners.tree_search import PathProblem, Search, SearchTree


@dataclass(frozen=True)
class FoundPath:
    """A path and how it was found.

    Attributes:
        points: Polyline of grasp positions [m], evenly spaced, shape [n, 3].
        cost: Its cost by the problem's weights.
        tree_cost: Cost before shortcuts.
        history: ``{"iteration", "cost"}``, cost of the best path so far (absent before the first).
        engine: Which engine found it.
        raw: The tree's polyline before shortcuts, shape [k, 3]; None from a search without trees.
        tree: All that was searched; None from a search without trees.
    """

    points: np.ndarray
    cost: float
    tree_cost: float
    history: list[dict[str, float]] = field(default_factory=list)
    engine: str = "own"
    raw: np.ndarray | None = None
    tree: SearchTree | None = None


def plan_path(problem: PathProblem, search: Search, *, engine: str = "own",
              progress: Progress = SILENT) -> FoundPath:
    """Search for the path of least cost with ``engine`` ``own`` or ``ompl``.

    Raises:
        NoPathError: no path was found within the iterations.
        MissingDependencyError: ``ompl`` was asked for and is not installed.
    """
    if engine == "ompl":
        raw, history, tree = search_with_ompl(problem, search, progress)
    else:
        raw, history, tree = search_tree(problem, search, progress)
    if raw is None:
        raise NoPathError(
            f"{search.iterations} iterations found no allowed path to the goal region.",
            f"{len(tree.nodes)} poses were reached from the start; the limits, or poses that the "
            "branch model refused, may separate it from the goal.",
            "Allow more --iterations, or raise --max-energy or --max-force.")
    tree_cost = float(path_cost(raw, problem.limits, problem.weights))
    points = shortcut(raw, problem.limits, problem.weights, attempts=search.shortcuts,
                      seed=search.seed)
    points = slide_end(points, problem.goals, problem.limits, problem.weights)
    points = polish(points, problem.energy_field, problem.limits, problem.weights)
    return FoundPath(points, float(path_cost(points, problem.limits, problem.weights)), tree_cost,
                     history, engine, raw, tree)


def found_again(found: FoundPath, problem: PathProblem) -> FoundPath | None:
    """Return a found path on a field that has learnt since; None if it is not allowed there."""
    points = found.points
    if problem.weights.energy > 0.0:
        points = polish(points, problem.energy_field, problem.limits, problem.weights)
    cost = float(path_cost(points, problem.limits, problem.weights))
    return replace(found, points=points, cost=cost) if np.isfinite(cost) else None
