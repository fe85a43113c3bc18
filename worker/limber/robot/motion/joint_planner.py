"""Path of an arm between joint angles that avoids obstacles (RRT-Connect).

Kuffner and LaValle 2000, "RRT-Connect: an efficient approach to single-query path planning". The
straight path is used if it is free. The path found is shortened, not optimal.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from limber.core.errors import NoPathError

STEP_RAD = 0.05  # of the joint that turns most, between checked configurations
_GROWN_RAD = 0.4
_MOST = 1500  # nodes of the two trees
_SHORTCUTS = 80

Free = Callable[[np.ndarray], np.ndarray]
"""Whether an arm with joint angles [n, joints] is free of collisions, shape [n]."""


@dataclass
class _Tree:
    angles: list[np.ndarray]
    parents: list[int] = field(default_factory=lambda: [-1])

    def nearest(self, target: np.ndarray) -> int:
        return int(np.abs(np.array(self.angles) - target).max(axis=1).argmin())

    def path_to(self, index: int) -> list[np.ndarray]:
        """From the root to an entry."""
        path = []
        while index >= 0:
            path.append(self.angles[index])
            index = self.parents[index]
        return path[::-1]


def joint_space_path(start: np.ndarray, goal: np.ndarray, limits: np.ndarray, free: Free, *,
                     seed: int = 0) -> np.ndarray:
    """Return joint angles from ``start`` [n] to ``goal`` [n] on a free path, shape [k, n].

    Neighbours are at most :data:`STEP_RAD` apart.

    Args:
        limits: Least and greatest angles [rad], shape [n, 2].
        free: Returns which joint angles are free.

    Raises:
        NoPathError: start or goal is not free, or no path was found.
    """
    for name, angles in (("start", start), ("goal", goal)):
        if not free(angles[None])[0]:
            raise NoPathError(f"The arm's {name} is in collision, or closer than allowed.",
                              "So no way begins or ends there.",
                              "Move the arm by hand, or correct the cell's obstacles.")
    if free(straight(start, goal)).all():
        return straight(start, goal)
    rng = np.random.default_rng(seed)
    low = np.maximum(limits[:, 0], np.minimum(start, goal) - np.pi)
    high = np.minimum(limits[:, 1], np.maximum(start, goal) + np.pi)
    trees = [_Tree([start]), _Tree([goal])]
    for _ in range(_MOST):
        reached = _grown(trees[0], rng.uniform(low, high), free)
        if reached is not None and (met := _connected(trees[1], trees[0].angles[reached], free)):
            first, second = trees[0].path_to(reached), trees[1].path_to(met)
            corners = first + second[::-1][1:]
            if not np.array_equal(corners[0], start):
                corners.reverse()
            return densely_turned(_shortened(corners, free, rng))
        trees.reverse()
    raise NoPathError("No free way of the arm was found between its start and its goal.",
                      f"{_MOST} directions were tried.",
                      "Move the arm by hand, or check the cell's obstacles.")


def straight(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return angles from ``first`` [n] to ``second`` [n], all joints at once, shape [k, n]."""
    count = max(int(np.ceil(np.abs(second - first).max() / STEP_RAD)), 1)
    return first + np.linspace(0.0, 1.0, count + 1)[:, None] * (second - first)


def densely_turned(corners: list[np.ndarray]) -> np.ndarray:
    """Return angles close together through ``corners``, shape [k, n]."""
    parts = [straight(first, second)[1:] for first, second in pairwise(corners)]
    return np.vstack([corners[:1], *parts])


def _grown(tree: _Tree, sample: np.ndarray, free: Free) -> int | None:
    """Grow a tree one step towards ``sample``; returns the new entry, None if blocked."""
    near = tree.nearest(sample)
    step = sample - tree.angles[near]
    size = float(np.abs(step).max())
    target = tree.angles[near] + step * min(1.0, _GROWN_RAD / max(size, 1e-12))
    if size < 1e-9 or not free(straight(tree.angles[near], target)[1:]).all():
        return None
    tree.angles.append(target)
    tree.parents.append(near)
    return len(tree.angles) - 1


def _connected(tree: _Tree, target: np.ndarray, free: Free) -> int | None:
    """Grow a tree until it reaches ``target``; returns the entry there, None if blocked."""
    while (last := _grown(tree, target, free)) is not None:
        if np.array_equal(tree.angles[last], target) or (
                np.abs(tree.angles[last] - target).max() < 1e-9):
            return last
    return None


def _shortened(corners: list[np.ndarray], free: Free, rng: np.random.Generator,
               ) -> list[np.ndarray]:
    """Remove corners between two that are connected by a free path."""
    for _ in range(_SHORTCUTS):
        if len(corners) < 3:
            break
        first, last = sorted(rng.choice(len(corners), 2, replace=False))
        if last - first > 1 and free(straight(corners[first], corners[last])[1:-1]).all():
            corners = corners[:first + 1] + corners[last:]
    return corners
