"""What a fit cannot see of its own error: the branch's thickness, and the mesh.

Residuals tell how well the data fix Young's modulus of the model. If the model is too thick, or
its mesh too stiff, the fit is as good and the modulus wrong. Both are known otherwise: the scan
says how sure each radius is, and a finer mesh how much stiffer this one is than the body.
"""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from limber.errors import WorkError
from limber.geometry.tet_mesh import TetMesh
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.mechanics.statics import solve_static

RADIUS_POWER = 4.0
"""Bending stiffness is Young's modulus times radius to the fourth: one can stand for the other."""
REFINED_LIMIT = 60_000
"""Tetrahedra of a refined mesh from which its check is left out: it would take minutes."""
REMAINING = 4 / 3
"""Error over its drop when edges are halved, at second order. Singular corners converge slower."""


@dataclass(frozen=True)
class ModelError:
    """Relative standard deviations of Young's modulus that no residual shows.

    Attributes:
        geometry: At the control points, from the radii's deviation, shape [K]; None where the
            branch's radii came without one.
        mesh: From the mesh, alike everywhere; None where it was not measured.
    """

    geometry: np.ndarray | None = None
    mesh: float | None = None

    def total(self, sensor: np.ndarray) -> np.ndarray:
        """Standard deviation of log E with that of the sensors, shape [K]."""
        square = np.asarray(sensor)**2
        if self.geometry is not None:
            square = square + self.geometry**2
        return np.sqrt(square + (self.mesh or 0.0)**2)


def geometry_error(cylinders: Path, mesh: TetMesh, weights: np.ndarray) -> np.ndarray | None:
    """Relative standard deviation of E at the control points from that of the radii.

    Errors of neighbouring radii come from the same side of the same scan: within a control
    point's part of the branch they are taken to be the same, not to average out.

    Args:
        cylinders: ``skeleton.csv`` of a branch folder.
        mesh: The branch's tetrahedra.
        weights: Part of each control point in each tetrahedron, shape [tet_count, K].

    Returns:
        Shape [K], or None where no radius has a deviation.
    """
    with open(cylinders, newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    if not rows or "radius_sigma" not in rows[0]:
        return None
    columns = np.array([[float(row[name]) for name in
                         ("sx", "sy", "sz", "ex", "ey", "ez", "radius", "radius_sigma")]
                        for row in rows])
    relative = columns[:, 7] / np.maximum(columns[:, 6], 1e-12)
    if not np.any(relative > 0):
        return None
    middle = (columns[:, :3] + columns[:, 3:6]) / 2
    nearest = cKDTree(middle).query(mesh.centroids)[1]
    share = weights * np.abs(mesh.volumes)[:, None]
    return RADIUS_POWER * (share.T @ relative[nearest]) / share.sum(axis=0)


def mesh_error(model: BranchModel, grasp: Grasp, operator: object, young: np.ndarray,
               ) -> float | None:
    """Relative standard deviation of E from the mesh: how much farther a finer one bends.

    Args:
        model: The branch with its modulus; gravity is left out.
        grasp: Where a small force acts.
        operator: Displacement of points inside from the nodes', shape [3 m, 3 n]; sparse.
        young: Of the tetrahedra [Pa], shape [tet_count].

    Returns:
        None where the refined mesh is too large, or gives no answer.
    """
    mesh = model.mesh
    if 8 * mesh.tet_count > REFINED_LIMIT or not mesh.is_quadratic:
        return None
    weightless = model.with_parameters(young=young, gravity=(0.0, 0.0, 0.0))
    axis = grasp.centre - mesh.nodes[weightless.fixed].mean(axis=0)
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    fine_mesh = refined(mesh)
    fine = BranchModel(fine_mesh, young=np.repeat(young, 8),
                       poisson=np.repeat(weightless.poisson, 8), density=900.0, gravity=None)
    free = Grasp(grasp.nodes, grasp.weights, grasp.centre, "pinned")
    try:
        coarse_moved, fine_moved = (
            solve_static(each, grasp=free, grasp_force=1e-6 * across).require().displacement
            for each in (weightless, fine))
    except WorkError:
        return None
    # The refined mesh has the coarse one's nodes first.
    points = operator @ coarse_moved.ravel()
    ratio = (operator @ fine_moved[:mesh.node_count].ravel()) @ points / (points @ points)
    return float(REMAINING * abs(np.log(ratio))) if ratio > 0 else None


def refined(mesh: TetMesh) -> TetMesh:
    """Cut each quadratic tetrahedron in eight; its nodes keep their indices."""
    # Corners of the children among the parent's ten nodes; the inner octahedron is cut along 4-9.
    children = np.array([[0, 4, 6, 7], [4, 1, 5, 8], [6, 5, 2, 9], [7, 8, 9, 3],
                         [4, 9, 5, 6], [4, 9, 6, 7], [4, 9, 7, 8], [4, 9, 8, 5]])
    tets = mesh.tets[:, children].reshape(-1, 4)
    flags = {name: values for name, values in mesh.point_data.items() if name == "fixed"}
    return TetMesh(mesh.nodes, tets, point_data=flags).oriented().quadratic()


def total_interval(young: np.ndarray, sensor: np.ndarray, error: ModelError) -> np.ndarray:
    """95 % interval [Pa] of all parts together, shape [K, 2].

    Args:
        young: Estimated [Pa], shape [K].
        sensor: 95 % interval from the sensors alone [Pa], shape [K, 2].
        error: What the fit does not see.
    """
    other = 1.96 * error.total(np.zeros(len(young)))
    middle, low, high = (np.log(values) for values in (young, *sensor.T))
    # The sensors' part may be one-sided, where a bound of the modulus cuts it.
    return np.exp(np.column_stack([middle - np.hypot(middle - low, other),
                                   middle + np.hypot(high - middle, other)]))
