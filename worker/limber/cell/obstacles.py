"""Obstacles in a cell: boxes, closed surfaces, and rods."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from limber.cell.cell_file import BoxEntry, Cell
from limber.core.errors import InputError
from limber.core.numerics.rigid import matrices
from limber.geometry.io.surfaces import SURFACES, usable_surface
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.surface.surface import Surface, distance_to_surface

# Constraints on a plan in addition to the limits on energy, force and loads.
#
# A constraint returns its limited quantity for a state of the full model. The energy field learns
# it at its samples (:func:`~limber.planning.field.energy_field.knowing`), and with it the gradient
# and the error that margins and proofs use. An external constraint is made from settings by a
# function in :data:`~limber.planning.constraints.limits.CONSTRAINTS`.






_LARGE = 20.0  # [m] a larger obstacle is in another unit
_CHUNK = 2_000_000  # point and face pairs whose solid angles are summed together


class Obstacle(Protocol):
    """A body in the branch frame."""

    @property
    def name(self) -> str: ...

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
            distance[part] *= np.where(np.abs(self.surface.winding(points[part])) > 0.5, -1, 1)
        return distance




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


class Limbs:
    """Rods, an :class:`.Obstacle`: the axes of a branch, or an arm's links."""

    name = "the branch"

    def __init__(self, starts: np.ndarray, ends: np.ndarray, radii: np.ndarray):
        self._starts, self._vectors, self._radii = starts, ends - starts, radii
        self._squares = np.maximum((self._vectors**2).sum(axis=1), 1e-18)

    @classmethod
    def of(cls, skeleton: Skeleton) -> "Limbs":
        """Return the rods of a skeleton."""
        child = np.flatnonzero(np.asarray(skeleton.parent) >= 0)
        parent = np.asarray(skeleton.parent)[child]
        return cls(skeleton.nodes[parent], skeleton.nodes[child],
                   np.maximum(skeleton.radius[child], skeleton.radius[parent]))

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of ``points`` [n, 3] outside the surface [m], shape [n]."""
        found = np.full(len(points), np.inf)
        for start, vector, square, radius in zip(self._starts, self._vectors, self._squares,
                                                 self._radii, strict=True):
            off = points - start
            part = np.clip(off @ vector / square, 0.0, 1.0)
            found = np.minimum(found, np.linalg.norm(off - part[:, None] * vector, axis=1) - radius)
        return found


def cell_obstacles(cell: Cell, folder: Path) -> tuple[Obstacle, ...]:
    """Return the cell's obstacles; mesh files are in ``folder``. InputError if a mesh cannot be
    read, has holes, or is in another unit."""
    found: list[Obstacle] = []
    for number, entry in enumerate(cell.obstacles):
        name = entry.name or f"obstacle {number + 1}"
        if isinstance(entry, BoxEntry):
            frame = matrices(np.array(entry.pose))
            found.append(Box(name, 0.5 * np.array(entry.size_m), frame[:3, 3], frame[:3, :3].T))
            continue
        path = folder / entry.file
        surface, _ = usable_surface(SURFACES.read(path, scale=entry.scale), path)
        size = float(np.ptp(surface.vertices, axis=0).max())
        if size > _LARGE:
            raise InputError(f"The obstacle {path} is {size:.0f} m long.",
                             "No cell is that large, so the file has another unit.",
                             "State unit = \"mm\" or \"cm\" in the cell file.")
        found.append(Solid(name, surface))
    return tuple(found)
