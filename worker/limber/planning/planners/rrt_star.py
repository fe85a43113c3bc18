"""RRT* over grasp positions, compiled here."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from limber.core.numerics.compiled import compiled
from limber.core.progress import Progress
from limber.planning.cost import edge_cost
from limber.planning.path_problem import GentleProblem

# Interface of a sampling planner: its problem and its result.


@dataclass(frozen=True, kw_only=True)
class PathProblem(GentleProblem):
    """A planning problem with ``goals`` [g, 3], allowed positions in the goal region."""

    goals: np.ndarray

    def in_goal(self, points: np.ndarray) -> np.ndarray:
        """Return whether positions [n, 3] are in the goal region, bool [n]."""
        return self.goal.distance(self.energy_field, points) <= self.goal.tolerance

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
    """Effort and range of a search.

    Attributes:
        iterations: Samples drawn.
        reach: Longest edge, as a fraction of the box's diagonal.
        goal_bias: Fraction of samples that are drawn from the goal region.
        shortcuts: Attempts to shorten the found path.
        seed: Seed of all random numbers.
    """

    iterations: int = 5000
    reach: float = 0.25
    goal_bias: float = 0.05
    shortcuts: int = 400
    seed: int = 0


@dataclass(frozen=True)
class SearchTree:
    """A tree as it ended: ``nodes`` [n, 3] [m], and their ``parents`` [n]. A parent comes before
    its children; the first node is the start and has the parent -1."""

    nodes: np.ndarray
    parents: np.ndarray

    @classmethod
    def of(cls, nodes: np.ndarray, parents: np.ndarray) -> "SearchTree":
        """Return the tree of nodes in any order; nodes not connected to the start are left out."""
        depth = np.where(parents < 0, 0, -1)
        depth[np.flatnonzero(depth == 0)[1:]] = -1
        while True:
            below = (depth < 0) & (parents >= 0) & (depth[parents] >= 0)
            if not below.any():
                break
            depth[below] = depth[parents[below]] + 1
        order = np.argsort(depth, kind="stable")[int((depth < 0).sum()):]
        index = np.full(len(nodes), -1)
        index[order] = np.arange(len(order))
        return cls(nodes[order], np.where(depth[order] > 0, index[parents[order]], -1))

    def pruned(self, most: int) -> "SearchTree":
        """Return at most ``most`` of its nodes: those with the most descendants. Its edges are all
        edges of the tree: a node has fewer descendants than its parent."""
        if len(self.nodes) <= most:
            return self
        carried = np.ones(len(self.nodes))
        for node in range(len(self.nodes) - 1, 0, -1):
            carried[self.parents[node]] += carried[node]
        kept = np.sort(np.argsort(-carried, kind="stable")[:most])
        return SearchTree.of(self.nodes[kept], np.searchsorted(kept, self.parents[kept])
                             - (self.parents[kept] < 0))


@dataclass(frozen=True)
class Searched:
    """Result of a search.

    Attributes:
        path: The best polyline of grasp positions [m], shape [k, 3]; None if none was found.
        history: ``{"iteration", "cost"}``, cost of the best path so far (absent before the first).
        tree: The whole search tree; None from a planner that grows no tree.
    """

    path: np.ndarray | None
    history: list[dict[str, float]] = field(default_factory=list)
    tree: SearchTree | None = None


class Planner(Protocol):
    """Searches for the path of least cost.

    It stops after a number of iterations, never a time, so that a seed gives the same path again.
    """

    def missing(self) -> str:
        """Return why it cannot be used here, or an empty string if it can."""
        ...

    def search(self, problem: PathProblem, search: Search, progress: Progress) -> Searched:
        """Return the best path that was found.

        Raises:
            MissingDependencyError: it is ``missing``.
            Cancelled: by the progress.
        """
        ...


_CHUNK = 250  # iterations between progress reports, at which it can be cancelled


class OwnRrtStar:
    """It runs on every system, with the same path, and holds no lock."""

    def missing(self) -> str:
        return ""

    def search(self, problem: PathProblem, search: Search, progress: Progress) -> Searched:
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
        return Searched(None if best is None else tree.branch(best), history, SearchTree.of(
            tree.nodes[:count].copy(), tree.parent[:count].copy()))


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
        neighbour_count = int(np.ceil(np.e * (1.0 + 1.0 / dimension) * np.log(count + 1.0)))
        near = _smallest(distance, count, neighbour_count)
        edges = np.empty(len(near))
        best, best_cost, best_slot = -1, np.inf, -1
        for i in range(len(near)):
            j = near[i]
            edges[i] = np.inf
            length = np.sqrt(distance[j])
            if length > reach or cost[j] + weights.length * length >= best_cost:
                continue  # cannot be the parent: its length alone costs too much
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
def _smallest(distance, count, most):
    """Return the indices of the ``most`` smallest of ``distance[:count]``, in ascending order."""
    most = min(most, count)
    kept = np.empty(most, np.int64)
    size = 0
    for i in range(count):
        if size == most and distance[i] >= distance[kept[size - 1]]:
            continue
        slot = size if size < most else most - 1
        while slot > 0 and distance[kept[slot - 1]] > distance[i]:
            if slot < most:
                kept[slot] = kept[slot - 1]
            slot -= 1
        kept[slot] = i
        size = min(size + 1, most)
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
    """Subtract ``saving`` from the cost of ``node`` and of all its descendants."""
    stack = [node]
    while len(stack) > 0:
        current = stack.pop()
        cost[current] -= saving
        child = first_child[current]
        while child >= 0:
            stack.append(child)
            child = next_sibling[child]
