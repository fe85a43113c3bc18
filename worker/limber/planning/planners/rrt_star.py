"""RRT* over grasp positions, native here."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from limber.core.progress import Progress
from limber.kernels import Kernel
from limber.planning.path_problem import GentleProblem

# Interface of a sampling planner: its problem and its result.


@dataclass(frozen=True, kw_only=True)
class PathProblem(GentleProblem):
    """A planning problem with ``goals`` [g, 3], allowed positions in the goal region."""

    goals: np.ndarray

    def in_goal(self, points: np.ndarray) -> np.ndarray:
        """Return whether positions [n, 3] are in the goal region, bool [n]."""
        return self.goal.excess(self.energy_field, points) <= 0.0

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
        seed: Seed of all random numbers.
    """

    iterations: int = 5000
    reach: float = 0.25
    goal_bias: float = 0.05
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


_grown = Kernel(
    "tree_grown", "samples float64[samples, 3]", "field float64[field]",
    "out nodes float64[capacity, 3]", "out cost float64[capacity]", "out parent int64[capacity]",
    "out first_child int64[capacity]", "out next_sibling int64[capacity]", "count int",
    "reach float", "energy float", "length float", "step float", returns="int")
_CHUNK = 250  # iterations between progress reports, at which it can be cancelled


class OwnRrtStar:
    """It runs on every system, with the same path, and holds no lock."""

    def missing(self) -> str:
        return ""

    def search(self, problem: PathProblem, search: Search, progress: Progress) -> Searched:
        generator = np.random.default_rng([search.seed, 0])
        tree = _Tree(search.iterations + 1)
        tree.nodes[0] = problem.start
        count = 1
        reach = search.reach * problem.diagonal
        history: list[dict[str, float]] = []
        for done in range(0, search.iterations, _CHUNK):
            size = min(_CHUNK, search.iterations - done)
            samples = generator.uniform(problem.low, problem.high, (size, 3))
            aimed = generator.uniform(size=size) < search.goal_bias
            samples[aimed] = problem.goals[generator.integers(len(problem.goals), size=aimed.sum())]
            count = _grown(samples, problem.limits.numbers, *tree.arrays, count, reach,
                           *problem.weights)
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

    def __init__(self, capacity: int):
        self.nodes = np.zeros((capacity, 3))
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
