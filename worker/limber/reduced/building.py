"""Construction of a reduced model: full solutions at training grasps, and their span."""

import numpy as np

from limber.core.progress import SILENT, Progress
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.reduced.basis import make_basis
from limber.reduced.reduced_model import ReducedModel
from limber.reduced.state import ReducedSettings
from limber.reduced.strain_polynomial import make_polynomial, reduced_mass
from limber.reduced.training import Snapshots, Trainer, sample_poses, sample_young

_DEFAULT = ReducedSettings()


def build_reduced(model: BranchModel, grasp: Grasp, weights: np.ndarray,
                  control_young: np.ndarray,
                  settings: ReducedSettings = _DEFAULT,
                  progress: Progress = SILENT) -> tuple[ReducedModel, Snapshots]:
    """Solve the full model at training grasps and make the reduced model of them.

    Args:
        model: The branch (St. Venant-Kirchhoff).
        grasp: The patch that is held, clamped or pinned.
        weights: From control points to tetrahedra, shape [tet_count, K]
            (limber.mechanics.young_weights).
        control_young: Young's modulus at the control points [Pa], shape [K].

    Raises:
        ConvergenceError: no training grasp has an equilibrium. InputError: other materials.
    """
    training = settings.training
    rng = np.random.default_rng(training.seed)
    trainer = Trainer(model, grasp, weights, control_young,
                      young_tangents=training.young_spread > 1)
    poses = sample_poses(model, grasp, training.grasp_count, rng, training)
    young = sample_young(control_young, len(poses), rng, training.young_spread)
    snapshots = trainer.take(poses, young, vibration_every=training.vibration_every,
                             vibration_count=training.vibration_count,
                             progress=progress.part(0.0, 0.9))
    progress(0.9, "reducing", snapshots=len(snapshots))
    reduced = reduce_snapshots(model, grasp, weights, control_young, snapshots, settings,
                               keeps_strain=True)
    progress(1.0, "reduced model ready", size=reduced.size)
    return reduced, snapshots


def reduce_snapshots(model: BranchModel, grasp: Grasp, weights: np.ndarray,
                     control_young: np.ndarray, snapshots: Snapshots,
                     settings: ReducedSettings, *, keeps_strain: bool = False) -> ReducedModel:
    """Return the reduced model of given full solutions; arguments as in :func:`build_reduced`.

    ``keeps_strain``: Whether :meth:`ReducedModel.strains` is needed, which doubles its size.
    """
    control_young = np.asarray(control_young, float)
    if not settings.vibration_count:
        snapshots = snapshots.without_vibrations()
    basis = make_basis(model, grasp, snapshots, settings.size,
                       settings.vibration_count if len(snapshots.vibrations) else 0)
    polynomial, fields = make_polynomial(model, basis, weights, control_young, snapshots,
                                         settings.field_count, keeps_fields=keeps_strain)
    flat = basis.columns.reshape(basis.size, -1)
    spread = float(np.exp(np.abs(np.log(snapshots.young / control_young)).max()))
    weight = model.weight_stiffness
    carried = np.zeros((basis.size, basis.size)) if weight is None else flat @ np.array(
        [weight @ column for column in basis.columns]).reshape(basis.size, -1).T
    return ReducedModel(
        grasp, model.mesh.nodes, basis, polynomial, flat @ model.weight_force.ravel(), carried,
        reduced_mass(model, basis), model.damping, control_young, snapshots.poses,
        snapshots.young, snapshots.energy, max(spread, 1.0), model.extent, strain_fields=fields)


def as_control_points(model: BranchModel) -> tuple[np.ndarray, np.ndarray]:
    """Return weights [tet_count, K] and moduli [K] that give the model's Young's modulus.

    Control points are the mesh's. If they cannot represent the field (or there are none), it
    becomes one region with its own pattern, and only its level can change.
    """
    from limber.mechanics.materials.young_field import young_weights

    marks = model.mesh.point_data.get("control_point")
    if marks is not None and (marks >= 0).any():
        order = np.argsort(marks[marks >= 0])
        points = model.mesh.nodes[np.flatnonzero(marks >= 0)[order]]
        weights = young_weights(model.mesh, points)
        young = np.linalg.lstsq(weights, model.young, rcond=None)[0]
        if (young > 0).all() and np.abs(weights @ young / model.young - 1).max() < 1e-6:
            return weights, young
    level = float(model.young.mean())
    return (model.young / level)[:, None], np.array([level])
