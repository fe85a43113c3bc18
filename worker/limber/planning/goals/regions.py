"""Regions of space as goals for a point on the branch.

Each has a signed distance: negative inside, and outside at most the true one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np


class Region(Protocol):
    """A region of space, branch frame."""

    @property
    def middle(self) -> np.ndarray:
        """A point well inside [m], shape [3]."""
        ...

    @property
    def depth(self) -> float:
        """Lower bound of the middle's distance from the outside [m]."""
        ...

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distance of ``points`` [n, 3], shape [n]."""
        ...

    def draw(self, count: int, generator: np.random.Generator) -> np.ndarray:
        """Return ``count`` points of the region, shape [count, 3]."""
        ...

    @property
    def words(self) -> str:
        """The region as a user gave it, after "within": lengths in metres."""
        ...

    def describe(self) -> dict:
        """Return it as plain data."""
        ...


@dataclass(frozen=True)
class Ball:
    """The points within ``radius`` [m] of ``centre`` [m]."""

    centre: tuple[float, float, float]
    radius: float

    @property
    def middle(self) -> np.ndarray:
        return np.array(self.centre, float)

    @property
    def depth(self) -> float:
        return self.radius

    def distance(self, points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(np.asarray(points) - self.centre, axis=1) - self.radius

    def draw(self, count: int, generator: np.random.Generator) -> np.ndarray:
        return self.middle + 0.9 * self.radius * ball(count, generator)

    @property
    def words(self) -> str:
        return f"{self.radius:.3f} m of {position_text(self.centre)} m"

    def describe(self) -> dict:
        return {"position_m": list(map(float, self.centre)), "tolerance_m": self.radius}


class Convex(Protocol):
    """The points below planes ``n . x + c`` with unit normals; ``planes`` [k, 4]."""

    @property
    def planes(self) -> np.ndarray: ...

    @property
    def corners(self) -> np.ndarray: ...

    @property
    def middle(self) -> np.ndarray:
        return self.corners.mean(axis=0)

    @property
    def depth(self) -> float:
        return float(-self.distance(self.middle[None])[0])

    def distance(self, points: np.ndarray) -> np.ndarray:
        return (np.asarray(points) @ self.planes[:, :3].T + self.planes[:, 3]).max(axis=1)

    def draw(self, count: int, generator: np.random.Generator) -> np.ndarray:
        weights = generator.dirichlet(np.ones(len(self.corners)), count)
        return weights @ self.corners


@dataclass(frozen=True)
class BoxRegion(Convex):
    """The box from ``low`` to ``high`` [m]."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @property
    def planes(self) -> np.ndarray:
        return np.vstack([np.column_stack([np.eye(3), -np.array(self.high)]),
                          np.column_stack([-np.eye(3), np.array(self.low)])])

    @property
    def corners(self) -> np.ndarray:
        ends = np.array([self.low, self.high], float)
        return np.array([[ends[i, 0], ends[j, 1], ends[k, 2]]
                         for i in (0, 1) for j in (0, 1) for k in (0, 1)])

    @property
    def words(self) -> str:
        return f"the box from {position_text(self.low)} to {position_text(self.high)} m"

    def describe(self) -> dict:
        return {"low_m": list(map(float, self.low)), "high_m": list(map(float, self.high))}


def empty_along(low: Sequence[float] | np.ndarray, high: Sequence[float] | np.ndarray) -> str:
    """Return in words along which axis a box from ``low`` [3] to ``high`` [3] [m] is empty."""
    axis = int(np.flatnonzero(~np.less(low, high))[0])
    return f"along {'xyz'[axis]}, from {low[axis]:.3f} to {high[axis]:.3f} m"


def position_text(point: Sequence[float] | np.ndarray) -> str:
    """Return a position [3] in words, to millimetres."""
    return "(" + ", ".join(f"{value + 0.0:.3f}" for value in point) + ")"


def ball(count: int, generator: np.random.Generator) -> np.ndarray:
    """Return points uniform in the unit ball, shape [count, 3]."""
    direction = generator.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * generator.uniform(size=(count, 1)) ** (1 / 3)
