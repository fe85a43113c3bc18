"""Obstacles of an arm's own motion: cell, branch and its own links."""

from itertools import combinations

import numpy as np

from limber.core.numerics.rigid import matrices
from limber.geometry.skeleton.skeleton import Skeleton
from limber.planning.constraints.obstacles import Obstacle
from limber.robot.cell.cell import Cell

_CLEAR_M = 0.02  # m kept between the arm and everything else
_SPACING_M, _FINE_M = 0.03, 0.005  # m between points along a rod; where its distance is reported


class ArmSurroundings:
    """Computes the distance of an arm with its gripper from all obstacles.

    Args:
        cell: Arm, gripper and base.
        obstacles: Obstacles of the cell, branch frame.
        branch: The branch, also an obstacle; None: there is none.
    """

    def __init__(self, cell: Cell, obstacles: tuple[Obstacle, ...], branch: Skeleton | None):
        self._cell, self._obstacles = cell, obstacles
        self._base = matrices(np.array(cell.base.pose))
        self._branch = None if branch is None else Limbs.of(branch)
        rods = self._rods(np.array(cell.arm.home)[None])
        # Neighbours overlap by their shape; so do links that touch in the home pose.
        self._pairs = [pair for pair in combinations(range(rods[0].shape[1]), 2)
                       if pair[1] - pair[0] > 1 and _apart(rods, *pair)[0] > 0.0]

    def free(self, joints: np.ndarray) -> np.ndarray:
        """Return whether joint angles [n, joints] keep the clearance :data:`_CLEAR_M`, shape [n].
        """
        return self.clearance(joints) > _CLEAR_M

    def clearance(self, joints: np.ndarray) -> np.ndarray:
        """Return the smallest distance to any obstacle at joint angles [n, joints] [m], shape [n].
        """
        rods = self._rods(joints)
        # Links of one arm may come closer to each other than to objects with uncertain positions.
        found = np.minimum(self._from_itself(rods) + _CLEAR_M, self._from_obstacles(rods))
        return np.minimum(found, self.from_branch(joints))

    def least_distances(self, joints: np.ndarray) -> dict[str, float | None]:
        """Return the smallest distances at joint angles [n, joints] of the arm with its gripper
        from itself and from obstacles [m], as plain data; None: there is nothing.
        """
        rods = self._rods(joints)
        found = {"self_distance_m": self._from_itself(rods),
                 "obstacle_distance_m": self._from_obstacles(rods, _FINE_M)}
        return {name: float(least) if np.isfinite(least := far.min()) else None
                for name, far in found.items()}

    def links_from(self, joints: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the smallest distance of the arm's links, without the gripper, from ``points``
        [n, k, 3] of the branch frame at joint angles [n, joints] [m], shape [n].
        """
        arm, found = self._cell.arm.rods(joints), np.full(len(joints), np.inf)
        for n, own in enumerate((points - self._base[:3, 3]) @ self._base[:3, :3]):
            links = Limbs(arm.starts[n], arm.ends[n], np.asarray(arm.radii, float))
            found[n] = links.clearance(own).min()
        return found

    def _from_itself(self, rods: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
        found = np.full(len(rods[0]), np.inf)
        for pair in self._pairs:
            found = np.minimum(found, _apart(rods, *pair))
        return found

    def _from_obstacles(self, rods: tuple[np.ndarray, np.ndarray, np.ndarray],
                        spacing: float = _SPACING_M) -> np.ndarray:
        found = np.full(len(rods[0]), np.inf)
        places, radii = self._rod_points(rods, spacing)
        for obstacle in self._obstacles:
            far = obstacle.clearance(places.reshape(-1, 3)).reshape(len(found), -1) - radii
            found = np.minimum(found, far.min(axis=1))
        return found

    def from_branch(self, joints: np.ndarray) -> np.ndarray:
        """Return the smallest distance to the branch at joint angles [n, joints] [m], shape [n]."""
        if self._branch is None:
            return np.full(len(joints), np.inf)
        points, radii = self._rod_points(self._rods(joints))
        far = self._branch.clearance(points.reshape(-1, 3)).reshape(len(joints), -1) - radii
        return far.min(axis=1)

    def _rods(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Starts and ends [n, rods, 3] of links and gripper in the base frame, and radii."""
        arm, flange = self._cell.arm.rods(joints), self._cell.arm.forward(joints)
        starts, ends, radii = [arm.starts], [arm.ends], [np.asarray(arm.radii, float)]
        for part in self._cell.tool.parts:
            for found, end in ((starts, part.start_m), (ends, part.end_m)):
                found.append((flange[:, :3, :3] @ np.array(end) + flange[:, :3, 3])[:, None])
            radii.append(np.array([part.radius_m]))
        return np.concatenate(starts, axis=1), np.concatenate(ends, axis=1), np.concatenate(radii)

    def _rod_points(self, rods: tuple[np.ndarray, np.ndarray, np.ndarray],
                    spacing: float = _SPACING_M) -> tuple[np.ndarray, np.ndarray]:
        """Points along the rods, branch frame, shape [n, k, 3], and the radius at each, [k]; larger
        by half the ``spacing`` [m] for what is between them.
        """
        starts, ends, radii = rods
        points, thick = [], []
        for k, radius in enumerate(radii):
            length = float(np.linalg.norm(ends[0, k] - starts[0, k]))
            share = np.linspace(0.0, 1.0, int(np.ceil(length / spacing)) + 1)[:, None]
            points.append(starts[:, None, k] + share * (ends[:, None, k] - starts[:, None, k]))
            thick.append(np.full(len(share), radius + 0.5 * spacing))
        found = np.concatenate(points, axis=1) @ self._base[:3, :3].T + self._base[:3, 3]
        return found, np.concatenate(thick)


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


def _apart(rods: tuple[np.ndarray, np.ndarray, np.ndarray], first: int, second: int) -> np.ndarray:
    """Distance of two rods [m], shape [n], from points along one to the other."""
    starts, ends, radii = rods
    vectors = ends[:, second] - starts[:, second]
    square = np.maximum((vectors**2).sum(axis=1), 1e-18)
    found = np.full(len(vectors), np.inf)
    for share in np.linspace(0.0, 1.0, 9):
        off = (starts[:, first] + share * (ends[:, first] - starts[:, first])) - starts[:, second]
        part = np.clip((off * vectors).sum(axis=1) / square, 0.0, 1.0)
        found = np.minimum(found, np.linalg.norm(off - part[:, None] * vectors, axis=1))
    return found - radii[first] - radii[second]
