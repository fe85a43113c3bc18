"""RRT* (Karaman and Frazzoli 2011) over grasp positions, by the requested planner.

``ompl`` is the Open Motion Planning Library's, kept as the widely known reference; ``own`` replaces
it where OMPL has no wheel. Paths end with shortcuts that lower the cost; OMPL's other simplifiers
ignore it.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from limber.core.errors import NoPathError
from limber.core.progress import SILENT, Progress
from limber.planning.cost import path_cost
from limber.planning.planners.ompl_engine import OmplRrtStar
from limber.planning.planners.rrt_star import OwnRrtStar
from limber.planning.planners.smoothing import polish, shortcut, slide_end
from limber.planning.planners.tree_search import PathProblem, Planner, Search, SearchTree

PLANNERS: dict[str, Planner] = {"ompl": OmplRrtStar(), "own": OwnRrtStar()}
"""Planners by the names of ``--engine``, in the order in which ``auto`` prefers them; an external
one is added to it.
"""


def chosen_engine(engine: str) -> str:
    """Return the name of the planner for a setting: the first available one for ``auto``."""
    if engine != "auto":
        return engine
    return next(name for name, planner in PLANNERS.items() if not planner.missing())


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
        tree: The whole search tree; None from a search without trees.
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
    """Search for the path of least cost with one of ``PLANNERS``.

    Raises:
        NoPathError: no path was found within the iterations.
        MissingDependencyError: the planner is not installed.
    """
    found = PLANNERS[engine].search(problem, search, progress)
    raw, reached = found.path, len(found.tree.nodes) if found.tree else 1
    if raw is None:
        raise NoPathError(
            f"{search.iterations} iterations found no allowed path to the goal region.",
            f"{reached} poses were reached from the start. The limits or rejected poses may "
            "separate the start from the goal.",
            "Allow more --iterations, or raise --max-energy or --max-force.")
    tree_cost = float(path_cost(raw, problem.limits, problem.weights))
    points = shortcut(raw, problem.limits, problem.weights, attempts=search.shortcuts,
                      seed=search.seed)
    points = slide_end(points, problem.goals, problem.limits, problem.weights)
    points = polish(points, problem.energy_field, problem.limits, problem.weights)
    return FoundPath(points, float(path_cost(points, problem.limits, problem.weights)), tree_cost,
                     found.history, engine, raw, found.tree)


def found_again(found: FoundPath, problem: PathProblem) -> FoundPath | None:
    """Return a found path on a field with more samples; None if it is not allowed there."""
    points = found.points
    if problem.weights.energy > 0.0:
        points = polish(points, problem.energy_field, problem.limits, problem.weights)
    cost = float(path_cost(points, problem.limits, problem.weights))
    return replace(found, points=points, cost=cost) if np.isfinite(cost) else None
