"""Errors that the residuals of a fit do not show: the branch's shape and the mesh.

Residuals show how well the data determine Young's modulus of the model. If the model is too thick
or its mesh too stiff, the fit is as good and the modulus wrong. Both errors are known from
elsewhere: the scan gives the uncertainty of each radius, and a finer mesh the excess stiffness of
this one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from limber.core.files.tables import read_columns
from limber.core.numerics.rigid import any_normal, composed, rotated
from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.forward.forward_model import Forward
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.mechanics.points import point_operator
from limber.mechanics.sensitivities import ParameterSet, explicit_forces
from limber.recordings.recording import CalibrationEntry, calibration_of

RADIUS_POWER = 4.0
"""Bending stiffness is Young's modulus times the radius to the fourth power."""
REFINED_LIMIT = 60_000
"""Tetrahedra of a refined mesh above which its check is left out: it would take minutes."""
SMALL = 1e-6
"""Displacement over the length of an element at which the response is linear."""
REMAINING = 4 / 3
"""Error over its decrease when edges are halved, at second order."""
UNSURE = 1 / 3
"""Uncertainty of the remaining error as a fraction of that drop: singular corners converge more
slowly.
"""


@dataclass(frozen=True)
class ModelError:
    """Relative deviations [K] of E that no residual shows, by their names in OTHER_CAUSES: those
    that exist and were measured. ``bending`` is what is left of ``geometry`` in E I, 0 if radii err
    alike over a section; if ``axis_is_exact``, geometry is of radii alone. ``mesh_factor`` is the
    material's modulus over the model's."""

    parts: dict[str, np.ndarray] = field(default_factory=dict)
    bending: np.ndarray | float = 0.0
    axis_is_exact: bool = True
    mesh_factor: np.ndarray | float = 1.0

    def having(self, **parts: np.ndarray | None) -> "ModelError":
        """Return it with other parts; None: without that one."""
        return replace(self, parts={name: part for name, part in (self.parts | parts).items()
                                    if part is not None})

    def total(self, sensor: np.ndarray) -> np.ndarray:
        """Standard deviation of log E with that of the sensors, shape [K]."""
        return np.sqrt(np.sum(np.square([sensor, *self.parts.values()]), axis=0))

    def total_of_bending(self, sensor: np.ndarray) -> np.ndarray:
        """Standard deviation of log E I with that of the sensors, shape [K]."""
        return self.having(geometry=self.bending + np.zeros(len(sensor))).total(sensor)


def geometry_error(cylinders: Path, mesh: TetMesh, weights: np.ndarray) -> np.ndarray | None:
    """Relative deviation of E [K] from radii of ``skeleton.csv``, None if they have none.
    Neighbours err alike, from one side of one scan: they do not average out within a section."""
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
    """Excess stiffness of a mesh: factor [K] of the material's modulus over that with which the
    mesh bends alike, and its relative deviation [K]."""

    factor: np.ndarray
    deviation: np.ndarray


@dataclass(frozen=True)
class SmallLoad:
    """Small loads on a branch: a force at the grasp [3], and weight [3]."""

    force: np.ndarray
    gravity: np.ndarray


def mesh_error(model: BranchModel, grasp: Grasp, operator: object, weights: np.ndarray,
               young: np.ndarray, loads: Sequence[SmallLoad] = ()) -> MeshStiffness | None:
    """Find the excess stiffness of the mesh from moduli for which it bends as a refined one does,
    at the observations and loads of the fit: the error is mostly at the clamp, and varies by load.
    No ``loads``: two across. None if the refined mesh is too large or gives no result."""
    mesh = model.mesh
    if 8 * mesh.tet_count > REFINED_LIMIT or not mesh.is_quadratic:
        return None
    coarse = model.with_parameters(young=weights @ young, gravity=(0.0, 0.0, 0.0))
    fine = BranchModel(refined(mesh), young=np.repeat(weights @ young, 8),
                       poisson=np.repeat(coarse.poisson, 8), density=np.repeat(coarse.density, 8),
                       gravity=None, point_masses=coarse.point_masses)
    parameters = ParameterSet(("log_young",), weights, young)
    try:
        own_tangent, finer_tangent = (each.equations().tangent(each, np.zeros_like(each.mesh.nodes))
                                      for each in (coarse, fine))
    except NotPositiveDefiniteError:
        return None
    missing, slopes = [], []
    for load in loads or [SmallLoad(across, np.zeros(3)) for across in _across(
            grasp, mesh.nodes[coarse.fixed])]:
        moved, more = (tangent.solve(_nodal(each, grasp, load)) for each, tangent in (
            (coarse, own_tangent), (fine, finer_tangent)))
        size = np.linalg.norm(operator @ moved.ravel())
        if size == 0:
            continue
        # The refined mesh has the coarse one's nodes first.
        missing.append(operator @ (more[:mesh.node_count] - moved).ravel() / size)
        # Small enough that the force is linear in it.
        little = SMALL * model.mean_edge / np.abs(moved).max()
        slopes.append(np.column_stack([
            operator @ own_tangent.solve(-partial).ravel()
            for partial in explicit_forces(coarse, parameters, little * moved)]) / (size * little))
    if not missing:
        return None
    lacking, slope = np.concatenate(missing), np.vstack(slopes)
    together = slope.sum(axis=1)
    alike = float(lacking @ together / (together @ together))
    # Beside the common change, as far as the response distinguishes the moduli.
    correction = np.linalg.lstsq(slope, lacking - alike * together, rcond=0.03)[0]
    # The common part is well determined and corrected; the rest, the uneven error of the mesh,
    # stays in the uncertainty.
    count = len(young)
    return MeshStiffness(np.full(count, np.exp(-REMAINING * alike)),
                         np.hypot(UNSURE * alike, REMAINING * correction) * np.ones(count))


def observer(mesh: TetMesh, forwards: Sequence[Forward], grasp: Grasp, points: np.ndarray,
             ) -> sparse.csr_matrix:
    """Displacement [3 m, 3 n] of pulls' observations from nodes': points (``points`` if no pull has
    any), and the gripper if path and force were measured together."""
    rest_points = [forward.rest_points for forward in forwards if len(forward.rest_points)]
    rows = [point_operator(mesh, np.unique(np.vstack(rest_points), axis=0) if rest_points
                           else points)]
    if any(not forward.force_is_stated for forward in forwards):
        mean = sparse.csr_matrix((grasp.weights, (np.zeros(len(grasp.nodes), int), grasp.nodes)),
                                 shape=(1, mesh.node_count))
        rows.append(sparse.kron(mean, sparse.identity(3)))
    return sparse.vstack(rows, format="csr")


def steady_loads(forwards: Sequence[Forward]) -> list[SmallLoad]:
    """The stated loads of pulls without a robot, and the weight if it bent the branch as well."""
    return [SmallLoad(forward.frames.wrenches[-1, :3],
                      np.array(forward.entry.gravity_m_s2 or (0.0, 0.0, 0.0)))
            for forward in forwards if forward.force_is_stated]


def _nodal(model: BranchModel, grasp: Grasp, load: SmallLoad) -> np.ndarray:
    """Forces on the nodes [N], shape [n, 3]."""
    forces = model.mass_load[:, None] * load.gravity
    forces[grasp.nodes] += grasp.weights[:, None] * load.force
    return forces


def _across(grasp: Grasp, base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors perpendicular to the line from base to grasp."""
    axis = grasp.centre - base.mean(axis=0)
    first = any_normal(axis)
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
    """95 % interval [K, 2] [Pa] of the material's modulus, all parts combined, from that on the
    mesh by sensors alone."""
    return _interval(young, sensor, error.total(np.zeros(len(young))), error.mesh_factor)


def bending_interval(young: np.ndarray, sensor: np.ndarray, error: ModelError) -> np.ndarray:
    """95 % interval of E I over the I of the skeleton [Pa], shape [K, 2]. Arguments as for
    :func:`total_interval`."""
    return _interval(young, sensor, error.total_of_bending(np.zeros(len(young))),
                     error.mesh_factor)


def _interval(young: np.ndarray, sensor: np.ndarray, deviation: np.ndarray,
              factor: np.ndarray | float) -> np.ndarray:
    other = 1.96 * deviation
    middle, low, high = (np.log(values) for values in (young, *sensor.T))
    # The sensors' part may be one-sided if a bound of the modulus truncates it.
    spread = np.column_stack([middle - np.hypot(middle - low, other),
                              middle + np.hypot(high - middle, other)])
    return np.exp(spread) * np.reshape(factor, (-1, 1))


# Uncertainty of Young's modulus from the gripper's frame if its path is prescribed.
#
# If the force drives the pull, the gripper's frame is an unknown of the fit
# (:mod:`limber.estimation.fitting.nuisances`). If the recorded path drives it (no force, or no
# torque for a clamped grasp; on request; a fast pull; a reduced model), the branch is held at the
# recorded path. The fit would have attributed the effect of a small displacement of the frame on
# the pull to the moduli.

STEP = 0.1
"""Fraction of its deviation by which the frame is moved: a slender branch, stretched by the whole
deviation, would respond far from linearly.
"""
WIDEST = 35.0
"""Standard deviation of log E that means unknown."""


def path_prescribed(forwards: Sequence[Forward]) -> list[Forward]:
    """Return the pulls with a prescribed path and an uncertain gripper frame."""
    return [forward for forward in forwards if forward.drive == "pose" and (
        calibration_of(forward.entry).pose_sigma_m > 0
        or calibration_of(forward.entry).pose_sigma_rad > 0)]


def path_error(evaluation: Evaluation, objective: Objective) -> np.ndarray | None:
    """Return the relative deviation of E [K] from the gripper's frame: d log E = -(J^T J)^-1 J^T dr
    for its six errors, of the calibration's deviation. None if a pull has no equilibrium."""
    slopes = path_slopes(evaluation, objective)
    if slopes is None:
        return None
    steps = np.linalg.lstsq(*slopes, rcond=1e-9)[0]
    groups = list(objective.space.groups)
    return np.minimum(np.linalg.norm(steps[groups], axis=1), WIDEST)


def path_slopes(evaluation: Evaluation, objective: Objective,
                ) -> tuple[np.ndarray, np.ndarray] | None:
    """Slopes of residuals to the free vector [r, p] and to errors of the gripper's frame in
    deviations [r, S]; None: no equilibrium."""
    known = {calibration_of(forward.entry): np.array(forward.entry.grasp.point_m)
             for forward in reversed(path_prescribed(objective.forwards))}
    base = _evaluated(evaluation, objective, [forward.with_prescribed_poses(forward.frames.poses)
                                              for forward in objective.forwards], jacobian=True)
    if base is None:
        return None
    changes = []
    for calibration, pivot in known.items():
        for error in range(6):
            if (calibration.pose_sigma_m, calibration.pose_sigma_rad)[error // 3] == 0:
                continue
            moved = [forward.with_prescribed_poses(
                _aside(forward.frames.poses, calibration, pivot, error)
                if forward.drive == "pose" and calibration_of(forward.entry) == calibration
                else forward.frames.poses) for forward in objective.forwards]
            found = _evaluated(evaluation, objective, moved)
            if found is None:
                return None
            changes.append((found.residual - base.residual) / STEP)
    return base.slopes, np.reshape(changes, (-1, len(base.residual))).T


def _aside(poses: np.ndarray, calibration: CalibrationEntry, pivot: np.ndarray,
           error: int) -> np.ndarray:
    """Poses [m, rad], shape [f, 6], with the frame moved or rotated about the grasp at rest."""
    moved = poses.copy()
    if error < 3:
        moved[:, error] += STEP * calibration.pose_sigma_m
        return moved
    turn = STEP * calibration.pose_sigma_rad * np.eye(3)[error - 3]
    moved[:, :3] = pivot + rotated(turn, poses[:, :3] - pivot)
    moved[:, 3:] = composed(turn, poses[:, 3:])
    return moved


def _evaluated(evaluation: Evaluation, objective: Objective, forwards: list[Forward], *,
               jacobian: bool = False) -> Evaluation | None:
    alone = Objective(forwards, objective.space, force_sigma=objective.force_sigma)
    # A force with errors of its own is eliminated by its response, which is computed with the
    # derivatives.
    linearised = any(forward.has_force_unknowns and not forward.watches_pose
                     for forward in forwards)
    return alone.evaluate(evaluation.free, jacobian=jacobian or linearised)
