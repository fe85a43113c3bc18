"""RRT* (Karaman and Frazzoli 2011) over grasp positions, by the requested planner.

``ompl`` is the Open Motion Planning Library's, kept as the widely known reference; ``own`` replaces
it where OMPL has no wheel. Paths are refined as the gentle one is, so that the two differ by their
costs and not by the luck of sampling; OMPL's simplifiers ignore the cost.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from limber.core.errors import MissingDependencyError, NoPathError, Option
from limber.core.optional import how_to_install
from limber.core.progress import SILENT, Progress
from limber.planning.cost import edge_cost, path_cost, resample
from limber.planning.planners.refine import refine
from limber.planning.planners.rrt_star import (
    PathProblem,
    Search,
    Searched,
    SearchTree,
)
from limber.planning.settings import PLANNERS

# RRT* of the Open Motion Planning Library on the same problem, cost and limits as our own.
#
# Peculiarities of its Python bindings (2.0.1), all found by measuring:
# ``StateCostIntegralObjective`` never calls Python, so the objective overrides ``motionCost``; the
# default neighbour constant connects every node to every other, so the rewire factor is small; the
# random seed must be set before anything is built; progress comes from the termination callback,
# where an exception (a cancelled run) passes through ``solve``.

_REWIRE_FACTOR = 0.05
_REPORT_EVERY = 100  # iterations


class OmplRrtStar:
    """OMPL's; it has no wheel for Windows, and its ``solve`` keeps Python's interpreter lock: call
    it in a worker process, as each command is one."""

    def missing(self) -> str:
        try:
            import ompl.geometric  # noqa: F401
        except ImportError as error:
            return str(error)
        return ""

    def search(self, problem: PathProblem, search: Search, progress: Progress) -> Searched:
        if reason := self.missing():
            raise MissingDependencyError("OMPL is not installed.", "The import failed with: "
                                         f"{reason}.", f"{how_to_install('planning')}")
        from ompl import base, geometric
        from ompl import util as ompl_util

        # OMPL takes seeds from 1 on; at a second call it logs that it is too late, but still
        # reseeds.
        ompl_util.setLogLevel(ompl_util.LogLevel.LOG_NONE)
        ompl_util.RNG.setSeed(search.seed + 1)
        setup, planner = _setup(base, geometric, problem, search)
        watch = _Watch(planner, search, progress)
        setup.solve(base.PlannerTerminationCondition(watch))
        data = base.PlannerData(setup.getSpaceInformation())
        setup.getPlannerData(data)
        tree = _tree(data)
        if not setup.haveExactSolutionPath():
            return Searched(None, watch.history, tree)
        states = setup.getSolutionPath().getStates()
        return Searched(np.array([state[0:3] for state in states]), watch.history, tree)


def _setup(base: object, geometric: object, problem: PathProblem, search: Search) -> tuple:
    space = _space(base, problem)
    setup = geometric.SimpleSetup(space)
    information = setup.getSpaceInformation()
    checker, motion, objective, goal = _rules(base, information, problem, search)
    setup.setStateValidityChecker(checker)
    information.setMotionValidator(motion)
    start = space.allocState()
    start[0:3] = problem.start.tolist()
    setup.addStartState(start)
    setup.setGoal(goal)
    setup.setOptimizationObjective(objective)
    planner = geometric.RRTstar(information)
    planner.setRange(search.reach * problem.diagonal)
    planner.setRewireFactor(_REWIRE_FACTOR)
    planner.setGoalBias(search.goal_bias)
    setup.setPlanner(planner)
    setup.setup()
    return setup, planner


def _tree(data: object) -> SearchTree:
    count = data.numVertices()
    nodes = np.array([data.getVertex(number).getState()[0:3] for number in range(count)])
    parents = np.full(count, -1)
    for number in range(count):
        parents[data.getEdges(number)] = number
    return SearchTree.of(nodes.reshape(-1, 3), parents)


class _Watch:
    """Ends the search after its iterations; reports progress, and so can be cancelled."""

    def __init__(self, planner: object, search: Search, progress: Progress):
        self._planner, self._search, self._progress = planner, search, progress
        self.history: list[dict[str, float]] = []
        self._calls = 0

    def __call__(self) -> bool:
        self._calls += 1
        if self._calls % _REPORT_EVERY == 0:
            cost = self._planner.bestCost().value()
            numbers = {"cost": cost} if math.isfinite(cost) else {}
            if numbers:
                self.history.append({"iteration": self._calls, "cost": cost})
            self._progress(self._calls / self._search.iterations, "growing the tree", **numbers)
        return self._calls > self._search.iterations


def _space(base: object, problem: PathProblem) -> object:
    space = base.RealVectorStateSpace(len(problem.start))
    bounds = base.RealVectorBounds(len(problem.start))
    for axis, (low, high) in enumerate(zip(problem.low, problem.high, strict=True)):
        bounds.setLow(axis, float(low))
        bounds.setHigh(axis, float(high))
    space.setBounds(bounds)
    return space


def _rules(base: object, information: object, problem: PathProblem, search: Search) -> tuple:
    """Make the subclasses of OMPL's classes for the problem."""
    generator = np.random.default_rng([search.seed, 2])
    weights, field = problem.weights, problem.limits

    def point(state: object) -> np.ndarray:
        return np.array(state[0:3])

    class Validity(base.StateValidityChecker):
        def isValid(self, state: object) -> bool:
            spot = point(state)
            return math.isfinite(edge_cost(spot, spot, field, weights))

    class EdgeCheck(base.MotionValidator):
        def checkMotion(self, first: object, second: object, *_last: object) -> bool:
            return math.isfinite(edge_cost(point(first), point(second), field, weights))

    class PathCost(base.OptimizationObjective):
        def stateCost(self, _state: object) -> object:
            return base.Cost(0.0)

        def motionCost(self, first: object, second: object) -> object:
            return base.Cost(edge_cost(point(first), point(second), field, weights))

        def motionCostHeuristic(self, first: object, second: object) -> object:
            return base.Cost(weights.length * math.dist(first[0:3], second[0:3]))

    class GoalRegion(base.GoalSampleableRegion):
        def distanceGoal(self, state: object) -> float:
            spot = point(state)[None]
            if problem.in_goal(spot)[0]:
                return 0.0
            return float(np.linalg.norm(problem.goals - spot, axis=1).min()) + 1e-9

        def sampleGoal(self, state: object) -> None:
            state[0:3] = problem.goals[generator.integers(len(problem.goals))].tolist()

        def maxSampleCount(self) -> int:
            return len(problem.goals)

    goal = GoalRegion(information)
    goal.setThreshold(1e-12)
    return Validity(information), EdgeCheck(information), PathCost(information), goal


def chosen_engine(engine: str) -> str:
    """Return the name of the planner for a setting: the first available one for ``auto``."""
    if engine != "auto":
        return engine
    return next(name for name in PLANNERS.own if name != "auto" and not PLANNERS.named(name)(
        ).missing())


@dataclass(frozen=True)
class FoundPath:
    """A path of even positions [n, 3] [m]. ``tree_cost`` and ``raw`` [k, 3] are before it was
    refined (None: no tree); ``history`` has ``{"iteration", "cost"}`` of the best so far."""

    points: np.ndarray
    cost: float
    tree_cost: float
    history: list[dict[str, float]] = field(default_factory=list)
    engine: str = "own"
    raw: np.ndarray | None = None
    tree: SearchTree | None = None


def plan_path(problem: PathProblem, search: Search, *, engine: str = "own",
              progress: Progress = SILENT) -> FoundPath:
    """Search for the path of least cost with one of ``PLANNERS``. NoPathError if none within the
    iterations, MissingDependencyError if the planner is not installed."""
    found = PLANNERS.named(engine)().search(problem, search, progress)
    raw, reached = found.path, len(found.tree.nodes) if found.tree else 1
    if raw is None:
        raise NoPathError(f"{search.iterations} iterations found no allowed path to the goal "
                          "region.", f"{reached} poses were reached from the start. The limits or "
                          "rejected poses may separate the start from the goal.", "Raise ",
                          Option("max_energy"), " or ",
                          Option("max_force"), ".")
    tree_cost = float(path_cost(raw, problem.limits, problem.weights))
    points, _ = refine(resample(raw, problem.weights.step), problem)
    return FoundPath(points, float(path_cost(points, problem.limits, problem.weights)), tree_cost,
                     found.history, engine, raw, found.tree)


def found_again(found: FoundPath, problem: PathProblem) -> FoundPath | None:
    """Return a found path on a field with more samples; None if it is not allowed there."""
    points = found.points
    if problem.weights.energy > 0.0:
        points, _ = refine(points, problem)
    cost = float(path_cost(points, problem.limits, problem.weights))
    return replace(found, points=points, cost=cost) if np.isfinite(cost) else None
