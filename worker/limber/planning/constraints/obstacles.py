"""Obstacles to branch and gripper: boxes and closed surfaces."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from limber.geometry.surface.distance import distance_to_surface
from limber.geometry.surface.surface import Surface

# Constraints on a plan in addition to the limits on energy, force and loads.
#
# A constraint returns its limited quantity for a state of the full model. The energy field learns
# it at its samples (:func:`~limber.planning.field.energy_field.knowing`), and with it the gradient
# and the error that margins and proofs use. An external constraint is made from settings by a
# function in :data:`~limber.planning.constraints.limits.CONSTRAINTS`.


@dataclass(frozen=True)
class Broken:
    """A limit that a state of the full model breaks.

    Attributes:
        name: Name of the limit, with its unit.
        value, limit: The state's value and the requested limit.
        position: Position of the grasp there [m], shape [3].
    """

    name: str
    value: float
    limit: float
    position: np.ndarray

    def __str__(self) -> str:
        position = ", ".join(f"{x:.3f}" for x in self.position)
        return f"{self.name} {self.value:.4g} exceeds the limit {self.limit:.4g} at ({position}) m"


class Constraint(Protocol):
    """A limit on the grasp's position and the branch's shape.

    Attributes:
        name: Unique, in small letters and underscores.
        limit: Largest allowed value, above 0.
    """

    name: str
    limit: float

    def values(self, grasps: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """Return the limited quantity of states with the grasp at ``grasps`` [k, 3] and the nodes
        at ``nodes`` [k, n, 3], both in m: never below 0, and smooth, shape [k].
        """
        ...

    def tightened(self, factor: float) -> "Constraint":
        """Return it with its limit divided by ``factor``."""
        ...

    def broken(self, grasps: np.ndarray, nodes: np.ndarray) -> str | None:
        """Describe where states break it most; None if they keep it."""
        values = self.values(grasps, nodes)
        worst = int(values.argmax())
        return str(Broken(self.name.replace("_", " "), float(values[worst]), self.limit,
                          grasps[worst])) if values[worst] > self.limit else None


_SCALE = 0.1  # [m] in which closeness falls to a third
_CHUNK = 2_000_000  # point and face pairs whose solid angles are summed together


class Obstacle(Protocol):
    """A body in the branch frame."""

    name: str

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of ``points`` [n, 3] outside it [m], negative inside, shape [n]."""
        ...


@dataclass(frozen=True)
class Box:
    """A box of ``half`` edge lengths [m]; ``centre`` [m] and unit rows ``axes`` [3, 3]."""

    name: str
    half: np.ndarray
    centre: np.ndarray
    axes: np.ndarray

    def clearance(self, points: np.ndarray) -> np.ndarray:
        beyond = np.abs((points - self.centre) @ self.axes.T) - self.half
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        return outside + np.minimum(beyond.max(axis=1), 0.0)


@dataclass(frozen=True)
class Solid:
    """The volume enclosed by a closed surface."""

    name: str
    surface: Surface

    def clearance(self, points: np.ndarray) -> np.ndarray:
        distance = distance_to_surface(points, self.surface)
        low, high = self.surface.vertices.min(axis=0), self.surface.vertices.max(axis=0)
        near = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
        for part in np.array_split(near, 1 + len(near) * len(self.surface.faces) // _CHUNK):
            distance[part] *= np.where(np.abs(_winding(self.surface, points[part])) > 0.5, -1, 1)
        return distance


@dataclass(frozen=True)
class Obstacles(Constraint):
    """Bodies that the branch must not touch.

    The limited quantity is the closeness, ``exp(-d / 0.1 m)`` of the clearance d: 1 where the
    branch touches a body, more inside; smooth for a planner's field.
    """

    @classmethod
    def keeping(cls, bodies: tuple[Obstacle, ...], clearance: float) -> "Obstacles":
        """Return the constraint to stay ``clearance`` [m] away from bodies."""
        return cls(bodies, float(np.exp(-clearance / _SCALE)))

    @property
    def clearance(self) -> float:
        """Clearance kept from the bodies [m]."""
        return -_SCALE * float(np.log(self.limit))

    bodies: tuple[Obstacle, ...]
    limit: float = 1.0
    name = "closeness"

    def values(self, grasps: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        return np.array([np.exp(-min(float(body.clearance(each).min()) for body in self.bodies)
                                / _SCALE) for each in nodes])

    def tightened(self, factor: float) -> "Obstacles":
        return replace(self, limit=self.limit / factor)

    def broken(self, grasps: np.ndarray, nodes: np.ndarray) -> str | None:
        kept = self.clearance
        if (hit := closest(self.bodies, nodes.reshape(-1, 3), kept)) is None:
            return None
        name, depth, where = hit
        position = ", ".join(f"{x:.3f}" for x in where)
        if depth < kept:
            return (f"the branch is {1e3 * (kept - depth):.1f} mm away from {name} at ({position}) "
                    f"m, less than the clearance of {1e3 * kept:.1f} mm")
        return f"the branch is {1e3 * (depth - kept):.1f} mm inside {name} at ({position}) m"


def closest(obstacles: tuple[Obstacle, ...], points: np.ndarray, radius: float = 0.0,
            ) -> tuple[str, float, np.ndarray] | None:
    """Return the obstacle that bodies of ``radius`` [m] at ``points`` [n, 3] penetrate deepest, the
    depth [m] and its position [m]; None if they penetrate none.
    """
    worst = None
    for obstacle in obstacles:
        depth = radius - obstacle.clearance(points)
        index = int(depth.argmax())
        if depth[index] > 0.0 and (worst is None or depth[index] > worst[1]):
            worst = obstacle.name, float(depth[index]), points[index]
    return worst


def _winding(surface: Surface, points: np.ndarray) -> np.ndarray:
    """Winding number of a surface around points [n, 3] (Van Oosterom and Strackee 1983), [n]."""
    a, b, c = (surface.vertices[surface.faces[:, k]][None] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    over = np.einsum("nij,nij->ni", a, np.cross(b, c))
    under = (la * lb * lc + np.einsum("nij,nij->ni", a, b) * lc
             + np.einsum("nij,nij->ni", b, c) * la + np.einsum("nij,nij->ni", c, a) * lb)
    return np.arctan2(over, under).sum(axis=1) / (2 * np.pi)
