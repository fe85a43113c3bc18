"""RRT* (Karaman and Frazzoli 2011) over grasp positions, in two engines behind one function.

``own`` is compiled here: it runs wherever Limber runs, gives the same path on every system and
holds no lock. ``ompl`` is the Open Motion Planning Library's, kept as the reference that others
know; it has no wheel for Windows, and its ``solve`` keeps Python's interpreter lock, so call it
in a worker process (each command is one). ``compare.chosen_engine`` says which is taken and why.

Both stop after a number of iterations, never a time, so a seed gives the same path again. Both
end with shortcuts that lower the cost; OMPL's other simplifiers ignore it.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from limber.compiled import compiled
from limber.errors import NoPathError
from limber.planning.cost import EdgeWeights, edge_cost, path_cost
from limber.planning.field.energy_field import EnergyField, FieldArrays
from limber.planning.planners.smoothing import polish, shortcut, slide_end
from limber.progress import SILENT, Progress

_CHUNK = 250  # iterations between two reports of progress, each a chance to cancel


@dataclass(frozen=True)
class PathProblem:
    """A start, goals and a cost.

    Attributes:
        start: Grasp position [m], shape [3].
        goals: Allowed positions in the goal region, shape [g, 3].
        in_goal: Whether positions [n, 3] are in the goal region, bool [n].
        energy_field: The energy field.
        limits: The same with limits on energy and force, for compiled loops.
        weights: The cost of an edge.
    """

    start: np.ndarray
    goals: np.ndarray
    in_goal: Callable[[np.ndarray], np.ndarray]
    energy_field: EnergyField
    limits: FieldArrays
    weights: EdgeWeights

    @property
    def low(self) -> np.ndarray:
        """Lower corner of the box to search [m], shape [3]."""
        return self.energy_field.region.low

    @property
    def high(self) -> np.ndarray:
        """Upper corner of the box to search [m], shape [3]."""
        return self.energy_field.region.high

    @property
    def diagonal(self) -> float:
        """Diagonal of that box [m]."""
        return float(np.linalg.norm(self.high - self.low))


@dataclass(frozen=True)
class Search:
    """How long and how wide to search.

    Attributes:
        iterations: Samples drawn.
        reach: Longest edge, as a fraction of the box's diagonal.
        goal_bias: Share of samples that are drawn from the goal region.
        shortcuts: Attempts to shorten the found path.
        seed: Of all that is random.
    """

    iterations: int = 5000
    reach: float = 0.25
    goal_bias: float = 0.05
    shortcuts: int = 400
    seed: int = 0


@dataclass(frozen=True)
class FoundPath:
    """A path and how it was found.

    Attributes:
        points: Polyline of grasp positions [m], evenly spaced, shape [n, 3].
        cost: Its cost by the problem's weights.
        tree_cost: Cost before shortcuts.
        history: ``{"iteration", "cost"}``, cost of the best path so far (absent before the first).
        node_count: Size of the tree.
        engine: Which engine found it.
        raw: The tree's polyline before shortcuts, shape [k, 3]; None from a search without trees.
    """

    points: np.ndarray
    cost: float
    tree_cost: float
    history: list[dict[str, float]] = field(default_factory=list)
    node_count: int = 0
    engine: str = "own"
    raw: np.ndarray | None = None


def plan_path(problem: PathProblem, search: Search, *, engine: str = "own",
              progress: Progress = SILENT) -> FoundPath:
    """Search for the path of least cost with ``engine`` ``own`` or ``ompl``.

    Raises:
        NoPathError: no path was found within the iterations.
        MissingDependencyError: ``ompl`` was asked for and is not installed.
    """
    if engine == "ompl":
        from limber.planning.planners.ompl_engine import search_with_ompl

        raw, history, node_count = search_with_ompl(problem, search, progress)
    else:
        raw, history, node_count = _search(problem, search, progress)
    if raw is None:
        raise NoPathError(
            f"{search.iterations} iterations found no allowed path to the goal region.",
            f"{node_count} poses were reached from the start; the limits, or poses that the "
            "branch model refused, may separate it from the goal.",
            "Allow more --iterations, or raise --max-energy or --max-force.")
    tree_cost = float(path_cost(raw, problem.limits, problem.weights))
    points = shortcut(raw, problem.limits, problem.weights, attempts=search.shortcuts,
                      seed=search.seed)
    points = slide_end(points, problem.goals, problem.limits, problem.weights)
    points = polish(points, problem.energy_field, problem.limits, problem.weights)
    return FoundPath(points, float(path_cost(points, problem.limits, problem.weights)), tree_cost,
                     history, node_count, engine, raw)


def _search(problem: PathProblem, search: Search, progress: Progress,
            ) -> tuple[np.ndarray | None, list[dict[str, float]], int]:
    generator = np.random.default_rng([search.seed, 0])
    dimension = len(problem.start)
    tree = _Tree(search.iterations + 1, dimension)
    tree.nodes[0] = problem.start
    count = 1
    reach = search.reach * problem.diagonal
    history: list[dict[str, float]] = []
    for done in range(0, search.iterations, _CHUNK):
        size = min(_CHUNK, search.iterations - done)
        samples = generator.uniform(problem.low, problem.high, (size, dimension))
        aimed = generator.uniform(size=size) < search.goal_bias
        samples[aimed] = problem.goals[generator.integers(len(problem.goals), size=aimed.sum())]
        count = _grow(samples, count, *tree.arrays, reach, problem.limits, problem.weights)
        best = tree.best(count, problem.in_goal)
        numbers = {} if best is None else {"cost": float(tree.cost[best])}
        if best is not None:
            history.append({"iteration": done + size, "cost": float(tree.cost[best])})
        progress((done + size) / search.iterations, "growing the tree", **numbers)
    best = tree.best(count, problem.in_goal)
    return (None if best is None else tree.branch(best)), history, count


class _Tree:
    """Nodes with their parent and cost; children as linked lists, so that costs can follow."""

    def __init__(self, capacity: int, dimension: int):
        self.nodes = np.zeros((capacity, dimension))
        self.cost = np.zeros(capacity)
        self.parent = np.full(capacity, -1, np.int64)
        self.first_child = np.full(capacity, -1, np.int64)
        self.next_sibling = np.full(capacity, -1, np.int64)

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        return self.nodes, self.cost, self.parent, self.first_child, self.next_sibling

    def best(self, count: int, in_goal: Callable[[np.ndarray], np.ndarray]) -> int | None:
        hits = np.flatnonzero(in_goal(self.nodes[:count]))
        return int(hits[np.argmin(self.cost[hits])]) if len(hits) else None

    def branch(self, node: int) -> np.ndarray:
        """Return the polyline from the root to ``node``."""
        chain = [node]
        while self.parent[chain[-1]] >= 0:
            chain.append(int(self.parent[chain[-1]]))
        return self.nodes[chain[::-1]].copy()


@compiled
def _grow(samples, count, nodes, cost, parent, first_child, next_sibling, reach, field, weights):
    """Add a node for each sample that can be reached; returns the new node count."""
    dimension = nodes.shape[1]
    distance = np.empty(len(nodes))
    for s in range(len(samples)):
        nearest = _distances(samples[s], nodes, count, distance)
        gap = np.sqrt(distance[nearest])
        if gap < 1e-9:
            continue
        step = min(1.0, reach / gap)
        new = nodes[nearest] + (samples[s] - nodes[nearest]) * step
        _distances(new, nodes, count, distance)
        # k = e (1 + 1/d) log n keeps RRT* asymptotically optimal (Karaman and Frazzoli, 2011).
        wanted = int(np.ceil(np.e * (1.0 + 1.0 / dimension) * np.log(count + 1.0)))
        near = _smallest(distance, count, wanted)
        edges = np.empty(len(near))
        best, best_cost, best_slot = -1, np.inf, -1
        for i in range(len(near)):
            j = near[i]
            edges[i] = np.inf
            length = np.sqrt(distance[j])
            if length > reach or cost[j] + weights.length * length >= best_cost:
                continue  # cannot be the parent: the length alone costs too much
            edges[i] = edge_cost(nodes[j], new, field, weights)
            if cost[j] + edges[i] < best_cost:
                best, best_cost, best_slot = j, cost[j] + edges[i], i
        if best < 0:
            continue
        nodes[count] = new
        cost[count] = best_cost
        _attach(count, best, parent, first_child, next_sibling)
        for i in range(len(near)):
            j = near[i]
            length = np.sqrt(distance[j])
            if i == best_slot or length > reach:
                continue
            if best_cost + weights.length * length >= cost[j]:
                continue
            saving = cost[j] - best_cost - edge_cost(new, nodes[j], field, weights)
            if saving > 1e-12:
                _detach(j, parent, first_child, next_sibling)
                _attach(j, count, parent, first_child, next_sibling)
                _lower(j, saving, cost, first_child, next_sibling)
        count += 1
    return count


@compiled
def _distances(point, nodes, count, distance):
    """Write squared distances to all nodes; returns the nearest node."""
    nearest = 0
    for i in range(count):
        squared = 0.0
        for k in range(nodes.shape[1]):
            squared += (nodes[i, k] - point[k]) ** 2
        distance[i] = squared
        if squared < distance[nearest]:
            nearest = i
    return nearest


@compiled
def _smallest(distance, count, wanted):
    """Return the indices of the ``wanted`` smallest of ``distance[:count]``, in rising order."""
    wanted = min(wanted, count)
    kept = np.empty(wanted, np.int64)
    size = 0
    for i in range(count):
        if size == wanted and distance[i] >= distance[kept[size - 1]]:
            continue
        place = size if size < wanted else wanted - 1
        while place > 0 and distance[kept[place - 1]] > distance[i]:
            if place < wanted:
                kept[place] = kept[place - 1]
            place -= 1
        kept[place] = i
        size = min(size + 1, wanted)
    return kept


@compiled
def _attach(node, to, parent, first_child, next_sibling):
    parent[node] = to
    next_sibling[node] = first_child[to]
    first_child[to] = node


@compiled
def _detach(node, parent, first_child, next_sibling):
    above = parent[node]
    if first_child[above] == node:
        first_child[above] = next_sibling[node]
        return
    child = first_child[above]
    while next_sibling[child] != node:
        child = next_sibling[child]
    next_sibling[child] = next_sibling[node]


@compiled
def _lower(node, saving, cost, first_child, next_sibling):
    """Take ``saving`` off the cost of ``node`` and of all below it."""
    stack = [node]
    while len(stack) > 0:
        current = stack.pop()
        cost[current] -= saving
        child = first_child[current]
        while child >= 0:
            stack.append(child)
            child = next_sibling[child]
