"""RRT* over grasp positions, compiled here."""

from collections.abc import Callable

import numpy as np

from limber.core.numerics.compiled import compiled
from limber.core.progress import Progress
from limber.planning.cost import edge_cost
from limber.planning.planners.tree_search import PathProblem, Search, Searched, SearchTree

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
