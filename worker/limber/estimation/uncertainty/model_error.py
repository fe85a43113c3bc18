"""What a fit cannot see of its own error: the branch's shape, and the mesh.

Residuals tell how well the data fix Young's modulus of the model. If the model is too thick, or
its mesh too stiff, the fit is as good and the modulus wrong. Both are known otherwise: the scan
says how sure each radius is, and a finer mesh how much stiffer this one is than the body.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from limber.core.files.reading import read_columns
from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.estimation.forward.forward_model import Forward
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.mechanics.points import point_operator
from limber.mechanics.sensitivities import ParameterSet, explicit_forces

RADIUS_POWER = 4.0
"""Bending stiffness is Young's modulus times radius to the fourth: one can stand for the other."""
REFINED_LIMIT = 60_000
"""Tetrahedra of a refined mesh from which its check is left out: it would take minutes."""
SMALL = 1e-6
"""Displacement over the length of an element at which the response is linear."""
REMAINING = 4 / 3
"""Error over its drop when edges are halved, at second order."""
UNSURE = 1 / 3
"""Part of that drop by which the error may be another: singular corners converge slower."""


@dataclass(frozen=True)
class ModelError:
    """Relative standard deviations of Young's modulus that no residual shows.

    Attributes:
        geometry: At the control points, from what the scan leaves open, shape [K]; None where
            the branch's radii came without a deviation.
        bending: What of ``geometry`` is left in bending stiffness E I, shape [K]; 0 where an error
            of the radii is the same all over a control point's part of the branch.
        mesh: From the mesh, shape [K]; None where it was not measured.
        axis_is_exact: Whether ``geometry`` is of the radii alone (:func:`geometry_error`), not
            of axis and radii (:func:`limber.estimation.uncertainty.shape_error.shape_error`).
        mesh_factor: Young's modulus of the material over that of the model on its mesh, which is
            too stiff by as much; shape [K]. ``mesh`` is what that leaves open.
        path: From the gripper's frame where its path leads the fit, shape [K]; None where none
            does (:func:`limber.estimation.uncertainty.path_error.path_error`).
        hung: From the mass of twigs and leaves beside the mesh, shape [K]; None where there are
            none (:func:`limber.estimation.uncertainty.shape_error.hung_error`).
        grip: From the length of the piece in a clamping gripper, shape [K]; None where none clamps
            (:func:`limber.estimation.uncertainty.grip_error.grip_error`).
    """

    geometry: np.ndarray | None = None
    bending: np.ndarray | float = 0.0
    mesh: np.ndarray | None = None
    axis_is_exact: bool = True
    mesh_factor: np.ndarray | float = 1.0
    path: np.ndarray | None = None
    hung: np.ndarray | None = None
    grip: np.ndarray | None = None

    def total(self, sensor: np.ndarray) -> np.ndarray:
        """Standard deviation of log E with that of the sensors, shape [K]."""
        parts = [part for part in (sensor, self.geometry, self.mesh, self.path, self.hung,
                                   self.grip) if part is not None]
        return np.sqrt(np.sum(np.square(parts), axis=0))

    def total_of_bending(self, sensor: np.ndarray) -> np.ndarray:
        """Standard deviation of log E I with that of the sensors, shape [K]."""
        return replace(self, geometry=self.bending + np.zeros(len(sensor))).total(sensor)


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
    names = ("sx", "sy", "sz", "ex", "ey", "ez", "radius")
    table = read_columns(cylinders, names, "a cylinder model")
    if "radius_sigma" not in table:
        return None
    columns = np.column_stack([table[name] for name in (*names, "radius_sigma")])
    relative = columns[:, 7] / np.maximum(columns[:, 6], 1e-12)
    if not np.any(relative > 0):
        return None
    middle = (columns[:, :3] + columns[:, 3:6]) / 2
    nearest = cKDTree(middle).query(mesh.centroids)[1]
    share = weights * np.abs(mesh.volumes)[:, None]
    return RADIUS_POWER * (share.T @ relative[nearest]) / share.sum(axis=0)


@dataclass(frozen=True)
class MeshStiffness:
    """How much a mesh is too stiff.

    Attributes:
        factor: Young's modulus of the material over that with which the mesh bends as the
            material does, at the control points, shape [K].
        deviation: Relative standard deviation of that factor, shape [K].
    """

    factor: np.ndarray
    deviation: np.ndarray


@dataclass(frozen=True)
class SmallLoad:
    """What bends a branch a little: a force at the grasp, and weight.

    Attributes:
        force: Shape [3].
        gravity: Shape [3].
    """

    force: np.ndarray
    gravity: np.ndarray


def mesh_error(model: BranchModel, grasp: Grasp, operator: object, weights: np.ndarray,
               young: np.ndarray, loads: Sequence[SmallLoad] = ()) -> MeshStiffness | None:
    """Find how much the mesh is too stiff.

    Loads bend the branch a little on this mesh and on a refined one; the moduli that make this
    one bend like the refined one differ by the mesh's error. That is not the same everywhere (most
    of it stands at the clamp), nor for every load: it is looked at where the fit looked.

    Args:
        model: The branch; its own gravity is left out.
        grasp: Where a force acts.
        operator: Displacement of what was observed from the nodes', shape [3 m, 3 n]; sparse.
        weights: Part of each control point in each tetrahedron, shape [tet_count, K].
        young: At the control points [Pa], shape [K].
        loads: Of any size; without them two forces across the branch.

    Returns:
        None where the refined mesh is too large, or gives no answer.
    """
    mesh = model.mesh
    if 8 * mesh.tet_count > REFINED_LIMIT or not mesh.is_quadratic:
        return None
    coarse = model.with_parameters(young=weights @ young, gravity=(0.0, 0.0, 0.0))
    fine = BranchModel(refined(mesh), young=np.repeat(weights @ young, 8),
                       poisson=np.repeat(coarse.poisson, 8), density=np.repeat(coarse.density, 8),
                       gravity=None, point_masses=coarse.point_masses)
    wanted = ParameterSet(("log_young",), weights, young)
    try:
        ours, theirs = (each.equations().tangent(each, np.zeros_like(each.mesh.nodes))
                        for each in (coarse, fine))
    except NotPositiveDefiniteError:
        return None
    missing, slopes = [], []
    for load in loads or [SmallLoad(across, np.zeros(3)) for across in _across(
            grasp, mesh.nodes[coarse.fixed])]:
        moved, more = (tangent.solve(_nodal(each, grasp, load)) for each, tangent in (
            (coarse, ours), (fine, theirs)))
        size = np.linalg.norm(operator @ moved.ravel())
        if size == 0:
            continue
        # The refined mesh has the coarse one's nodes first.
        missing.append(operator @ (more[:mesh.node_count] - moved).ravel() / size)
        # So little that the force is linear in it.
        little = SMALL * model.mean_edge / np.abs(moved).max()
        slopes.append(np.column_stack([
            operator @ ours.solve(-partial).ravel()
            for partial in explicit_forces(coarse, wanted, little * moved)]) / (size * little))
    if not missing:
        return None
    lacking, slope = np.concatenate(missing), np.vstack(slopes)
    together = slope.sum(axis=1)
    alike = float(lacking @ together / (together @ together))
    # Around the change alike everywhere, as far as the response tells the moduli apart.
    apart = np.linalg.lstsq(slope, lacking - alike * together, rcond=0.03)[0]
    # What all moduli have in common is told well and corrected; the rest shows how unevenly the
    # mesh errs, and is left open.
    count = len(young)
    return MeshStiffness(np.full(count, np.exp(-REMAINING * alike)),
                         np.hypot(UNSURE * alike, REMAINING * apart) * np.ones(count))


def observer(mesh: TetMesh, forwards: Sequence[Forward], grasp: Grasp, points: np.ndarray,
             ) -> sparse.csr_matrix:
    """Displacement of what pulls observed from that of the nodes, shape [3 m, 3 n].

    The points; and the gripper, where its path and force were measured together.

    Args:
        points: Taken where no pull observes any [m], shape [k, 3].
    """
    places = [forward.rest_points for forward in forwards if len(forward.rest_points)]
    rows = [point_operator(mesh, np.unique(np.vstack(places), axis=0) if places else points)]
    if any(not forward.force_is_stated for forward in forwards):
        mean = sparse.csr_matrix((grasp.weights, (np.zeros(len(grasp.nodes), int), grasp.nodes)),
                                 shape=(1, mesh.node_count))
        rows.append(sparse.kron(mean, sparse.identity(3)))
    return sparse.vstack(rows, format="csr")


def steady_loads(forwards: Sequence[Forward]) -> list[SmallLoad]:
    """The stated loads of pulls without a robot, with the weight that bent the branch as well."""
    return [SmallLoad(forward.frames.wrenches[-1, :3],
                      np.array(forward.entry.gravity_m_s2 or (0.0, 0.0, 0.0)))
            for forward in forwards if forward.force_is_stated]


def _nodal(model: BranchModel, grasp: Grasp, load: SmallLoad) -> np.ndarray:
    """Forces on the nodes [N], shape [n, 3]."""
    forces = model.mass_load[:, None] * load.gravity
    forces[grasp.nodes] += grasp.weights[:, None] * load.force
    return forces


def _across(grasp: Grasp, base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across the way from base to grasp."""
    axis = grasp.centre - base.mean(axis=0)
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    return first, np.cross(axis, first) / np.linalg.norm(axis)


def refined(mesh: TetMesh) -> TetMesh:
    """Cut each quadratic tetrahedron in eight; its nodes keep their indices."""
    # Corners of the children among the parent's ten nodes; the inner octahedron is cut along 4-9.
    children = np.array([[0, 4, 6, 7], [4, 1, 5, 8], [6, 5, 2, 9], [7, 8, 9, 3],
                         [4, 9, 5, 6], [4, 9, 6, 7], [4, 9, 7, 8], [4, 9, 8, 5]])
    tets = mesh.tets[:, children].reshape(-1, 4)
    flags = {name: values for name, values in mesh.point_data.items() if name == "fixed"}
    return TetMesh(mesh.nodes, tets, point_data=flags).oriented().quadratic()


def total_interval(young: np.ndarray, sensor: np.ndarray, error: ModelError) -> np.ndarray:
    """95 % interval [Pa] of the material's modulus, all parts together, shape [K, 2].

    Args:
        young: Estimated on the mesh [Pa], shape [K].
        sensor: 95 % interval from the sensors alone [Pa], shape [K, 2].
        error: What the fit does not see.
    """
    return _interval(young, sensor, error.total(np.zeros(len(young))), error.mesh_factor)


def bending_interval(young: np.ndarray, sensor: np.ndarray, error: ModelError) -> np.ndarray:
    """95 % interval of E I over the I of the skeleton [Pa], shape [K, 2].

    Arguments as of :func:`total_interval`.
    """
    return _interval(young, sensor, error.total_of_bending(np.zeros(len(young))),
                     error.mesh_factor)


def _interval(young: np.ndarray, sensor: np.ndarray, deviation: np.ndarray,
              factor: np.ndarray | float) -> np.ndarray:
    other = 1.96 * deviation
    middle, low, high = (np.log(values) for values in (young, *sensor.T))
    # The sensors' part may be one-sided, where a bound of the modulus cuts it.
    spread = np.column_stack([middle - np.hypot(middle - low, other),
                              middle + np.hypot(high - middle, other)])
    return np.exp(spread) * np.reshape(factor, (-1, 1))
