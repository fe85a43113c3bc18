"""Regions of space that a place on the branch may be brought into: a ball, a box, a camera's view.

Each has a signed distance: negative inside, and outside at most the true one.
"""

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
        """How far the middle is from the outside, at least [m]."""
        ...

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distance of ``points`` [n, 3], shape [n]."""
        ...

    def draw(self, count: int, generator: np.random.Generator) -> np.ndarray:
        """Return ``count`` points of the region, shape [count, 3]."""
        ...

    def describe(self) -> dict:
        """Return it as plain data."""
        ...


@dataclass(frozen=True)
class Ball:
    """All that is within ``radius`` [m] of ``centre`` [m]."""

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

    def describe(self) -> dict:
        return {"position_m": list(map(float, self.centre)), "tolerance_m": self.radius}


class _Convex:
    """What is below planes ``n . x + c`` with unit normals; ``planes`` [k, 4]."""

    planes: np.ndarray
    corners: np.ndarray

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
class BoxRegion(_Convex):
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

    def describe(self) -> dict:
        return {"low_m": list(map(float, self.low)), "high_m": list(map(float, self.high))}


@dataclass(frozen=True)
class View(_Convex):
    """What a pinhole camera sees within a range of distances along its axis.

    Attributes:
        frame: The camera's in the branch's: x right, y down, z ahead, shape [4, 4].
        slopes: x / z and y / z at the picture's borders: left, right, top, bottom.
        range_m: Least and greatest z [m].
    """

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

    def describe(self) -> dict:
        return {"camera_m": self.frame[:3, 3].tolist(), "axis": self.frame[:3, 2].tolist(),
                "range_m": list(self.range_m)}

    def hidden_by(self, triangles: np.ndarray, place: np.ndarray, slack: float) -> bool:
        """Return whether a surface lies between the camera and ``place`` [3].

        ``triangles`` are [f, 3, 3]; what is within ``slack`` [m] of the place is the place's own.
        Moeller and Trumbore 1997.
        """
        eye = self.frame[:3, 3]
        way = np.asarray(place, float) - eye
        first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        across = np.cross(way, second)
        volume = np.einsum("ij,ij->i", first, across)
        safe = np.where(np.abs(volume) > 1e-30, volume, np.inf)
        to_eye = eye - triangles[:, 0]
        u = np.einsum("ij,ij->i", to_eye, across) / safe
        turned = np.cross(to_eye, first)
        v = (turned @ way) / safe
        t = np.einsum("ij,ij->i", second, turned) / safe
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        return bool((hit & (t < 1.0 - slack / np.linalg.norm(way))).any())


def ball(count: int, generator: np.random.Generator) -> np.ndarray:
    """Return points uniform in the unit ball, shape [count, 3]."""
    direction = generator.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * generator.uniform(size=(count, 1)) ** (1 / 3)
