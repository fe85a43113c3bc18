"""Interface of a sampling planner: its problem and its result."""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from limber.core.progress import Progress
from limber.planning.path_problem import GentleProblem


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
    """A tree as it ended: ``nodes`` [n, 3] [m], and their ``parents`` [n].

    A parent comes before its children; the first node is the start and has the parent -1.
    """

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
        """Return at most ``most`` of its nodes: those with the most descendants.

        Its edges are all edges of the tree: a node has fewer descendants than its parent.
        """
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
