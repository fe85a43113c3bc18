"""Regions of space for a point of the branch: ball, box, the view of a camera.

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

    def draw(self, count: int, generator: np.random.Generator, share: float = 1.0) -> np.ndarray:
        """Return ``count`` points of the region, shrunk to a ``share`` of it, [count, 3]."""
        ...

    @property
    def words(self) -> str:
        """The region as a user gave it, after "within": lengths in metres."""
        ...

    def describe(self) -> dict:
        """Return it as plain data."""
        ...


@dataclass(frozen=True)
class Ball(Region):
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

    def draw(self, count: int, generator: np.random.Generator, share: float = 1.0) -> np.ndarray:
        return self.middle + share * self.radius * ball(count, generator)

    @property
    def words(self) -> str:
        return f"{self.radius:.3f} m of {position_text(self.centre)} m"

    def describe(self) -> dict:
        return {"position_m": list(map(float, self.centre)), "tolerance_m": self.radius}


class Convex(Region, Protocol):
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

    def draw(self, count: int, generator: np.random.Generator, share: float = 1.0) -> np.ndarray:
        weights = generator.dirichlet(np.ones(len(self.corners)), count)
        return self.middle + share * (weights @ self.corners - self.middle)


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


@dataclass(frozen=True)
class View(Convex):
    """The view of a pinhole camera in the range of z [m]: its frame [4, 4] in the branch's (x
    right, y down, z ahead), and x / z and y / z at the borders left, right, top, bottom."""

    frame: np.ndarray
    slopes: tuple[float, float, float, float]
    range_m: tuple[float, float]

    @property
    def planes(self) -> np.ndarray:
        left, right, top, bottom = self.slopes
        near, far = self.range_m
        own = np.array([[-1, 0, left, 0], [1, 0, -right, 0], [0, -1, top, 0], [0, 1, -bottom, 0],
                        [0, 0, -1, near], [0, 0, 1, -far]], float)
        own /= np.linalg.norm(own[:, :3], axis=1, keepdims=True)
        normals = own[:, :3] @ self.frame[:3, :3].T
        return np.column_stack([normals, own[:, 3] - normals @ self.frame[:3, 3]])

    @property
    def corners(self) -> np.ndarray:
        left, right, top, bottom = self.slopes
        own = np.array([[x * z, y * z, z] for z in self.range_m for x in (left, right)
                        for y in (top, bottom)])
        return own @ self.frame[:3, :3].T + self.frame[:3, 3]

    @property
    def words(self) -> str:
        near, far = self.range_m
        return (f"the image of the camera at {position_text(self.frame[:3, 3])} m that looks along "
                f"{position_text(self.frame[:3, 2])}, {near:.3f} to {far:.3f} m ahead of it")

    def describe(self) -> dict:
        return {"camera_m": self.frame[:3, 3].tolist(), "axis": self.frame[:3, 2].tolist(),
                "range_m": list(self.range_m)}

    def hidden_by(self, triangles: np.ndarray, point: np.ndarray, slack: float) -> bool:
        """Whether triangles [f, 3, 3] are between camera and ``point``, to which surface within
        ``slack`` [m] belongs (Moeller and Trumbore 1997)."""
        eye = self.frame[:3, 3]
        ray = np.asarray(point, float) - eye
        first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        across = np.cross(ray, second)
        volume = np.einsum("ij,ij->i", first, across)
        # A triangle that the ray lies in hides nothing; rounding would give it a place anywhere.
        size = np.linalg.norm(first, axis=1) * np.linalg.norm(across, axis=1)
        safe = np.where(np.abs(volume) > 1e-9 * size + 1e-30, volume, np.inf)
        to_eye = eye - triangles[:, 0]
        u = np.einsum("ij,ij->i", to_eye, across) / safe
        turned = np.cross(to_eye, first)
        v = (turned @ ray) / safe
        t = np.einsum("ij,ij->i", second, turned) / safe
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        return bool((hit & (t < 1.0 - slack / np.linalg.norm(ray))).any())
