"""Direction of the branch at its observed points, at rest and in a deformed state.

An observed point may be off its control point along the branch: the scan's tip is short, or a
camera follows another place. It then moves with the branch at that place. To first order the
measurements show the simulated point plus the distance times the direction of the branch there.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.points import point_operator

SLENDER = 3.0
"""Extent along the axis over that across it at which nearby tetrahedra show the axis: to 0.1
degrees on the paper's branches, meshed coarsely and finely; with 2 to 0.6.
"""
FEWEST_TETS = 12
GROWTH = 1.25
STEP = 0.25
"""Distance to both sides over which the change of the direction is measured, over that extent."""


@dataclass(frozen=True)
class PointDirections:
    """Directions of the branch at m points.

    Attributes:
        rest: Unit vectors at rest, away from the base, shape [m, 3].
        operator: Their change by nodal displacements, shape [3 m, 3 n].
    """

    rest: np.ndarray
    operator: sparse.csr_matrix

    @classmethod
    def at(cls, mesh: TetMesh, points: np.ndarray) -> "PointDirections":
        """Return the directions at points [m], shape [m, 3]."""
        base = mesh.nodes[mesh.point_data["fixed"].astype(bool)].mean(axis=0)
        found = [_axis(mesh, point, base) for point in points]
        rest = np.array([axis for axis, _ in found]).reshape(-1, 3)
        step = STEP * np.array([extent for _, extent in found])[:, None]
        ahead, behind = (point_operator(mesh, points + sign * step * rest) for sign in (1, -1))
        scale = sparse.diags(np.repeat(0.5 / step[:, 0], 3))
        return cls(rest, sparse.csr_matrix(scale @ (ahead - behind)))

    def changed(self, change: np.ndarray) -> np.ndarray:
        """Return unit vectors after a change, as ``operator`` gives it, shape [3 m]."""
        moved = self.rest + change.reshape(-1, 3)
        return moved / np.linalg.norm(moved, axis=1, keepdims=True)

    def bent(self, displacement: np.ndarray) -> np.ndarray:
        """Return unit vectors under nodal displacements [m], shape [n, 3]."""
        return self.changed(self.operator @ displacement.ravel())


def _axis(mesh: TetMesh, point: np.ndarray, base: np.ndarray) -> tuple[np.ndarray, float]:
    """Direction of the branch near a point, and the radius of the ball that shows it [m].

    The ball grows until the tetrahedra in it extend along the branch more than across. They count
    less towards its edge: cut off sharply, a coarse mesh tilted the direction by up to 15 degrees.
    """
    centres, volumes = mesh.centroids, np.abs(mesh.volumes)
    away = np.linalg.norm(centres - point, axis=1)
    extent = float(np.sort(away)[min(FEWEST_TETS, len(away) - 1)])
    while True:
        near = away <= extent
        weights = volumes[near] * (1 - (away[near] / extent)**2)**2
        middle = weights @ centres[near] / weights.sum()
        spread = (centres[near] - middle) * np.sqrt(weights)[:, None]
        _, sizes, axes = np.linalg.svd(spread, full_matrices=False)
        if sizes[0] > SLENDER * sizes[1] or near.all():
            break
        extent *= GROWTH
    return axes[0] * (np.sign(axes[0] @ (middle - base)) or 1.0), extent
