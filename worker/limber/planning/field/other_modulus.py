"""A field for another Young's modulus, made from one that is known.

The rod (:mod:`limber.planning.field.rod`) says in milliseconds how each state changes with the
modulus. What the full model adds to the rod hardly depends on it:

    state = rod + g (known state - known rod),

where ``g`` is the growth of the stiffness at the grasp for energies, forces and stresses, and 1 for
shapes and strains. The full model is solved at some of the poses. They replace what was corrected,
and the field's error is told by them alone: that of the correction is in it.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from limber.core.files.reading import read_arrays
from limber.core.not_none import present
from limber.core.numerics.rigid import composed, rotated
from limber.core.progress import SILENT, Progress
from limber.mechanics.materials.laws import MULTIPLICITY, hooke_stress
from limber.mechanics.strain import carried_strain
from limber.planning.field.energy_field import WHAT, EnergyField, as_before
from limber.planning.field.grasp_model import GraspModel
from limber.planning.field.rod import RodState
from limber.planning.field.rod_kernels import known_at
from limber.planning.field.sampling import grown, other_shapes, solved_from
from limber.planning.field.stored_states import States

_SOLVED = 48  # poses that the full model solves again, evenly among all
_GROWING = ("energies", "forces", "stresses", "axial_forces")
_TURN = 1e-6  # [rad] of a rotation's differences


def material_of(grasp_model: GraspModel) -> np.ndarray:
    """Return what a field's file keeps of the branch: modulus [Pa], Poisson's ratio and density
    [kg/m^3], [3, tet_count]."""
    model = grasp_model.model
    return np.stack(np.broadcast_arrays(model.young, model.poisson, model.density))


def corrected_field(path: Path, after: GraspModel, progress: Progress) -> EnergyField | None:
    """Return the field of a file for the branch ``after`` its modulus changed; None if the file
    does not tell the modulus, or more of the material has changed."""
    now = material_of(after)
    known = read_arrays(path, WHAT).get("material", now[:0])
    if known.shape != now.shape or (known[1:] != now[1:]).any():
        return None
    before = replace(after, branch=after.branch.with_young(known[0]))
    return with_modulus(EnergyField.read(path), before, after, progress=progress)


def with_modulus(known: EnergyField, before: GraspModel, after: GraspModel, *,
                 workers: int | None = None, progress: Progress = SILENT) -> EnergyField:
    """Return the field of the branch ``after`` its modulus changed, from the field ``known``
    ``before``. A pose that is not reached, or in another shape than foretold, is refused."""
    places = known.samples.positions[1:]
    then, now = (grown(one.rod, places, [one.rod.rest], progress.part(*part))
                 for one, part in ((before, (0.0, 0.2)), (after, (0.2, 0.4))))
    both = np.array([k for k in range(len(places)) if then[k] and now[k]], int)
    asked = np.linspace(0, len(both) - 1, min(_SOLVED, len(both))).astype(int)
    solved = solved_from(after, places[both[asked]], [now[k] for k in both[asked]], workers,
                         progress.part(0.5, 1.0))
    samples = _corrected(known.samples.take(1 + both), before, [then[k] for k in both],
                         after, [now[k] for k in both])
    held = [one for one in solved if not one.trouble]
    is_other = other_shapes(after, [one.state for one in held],
                            [samples.shape[asked[one.target], 3:] for one in held])
    good = [one for one, is_off in zip(held, is_other, strict=True) if not is_off]
    lost = np.concatenate([np.setdiff1d(np.arange(len(places)), both), np.setdiff1d(
        both[asked], [both[asked[one.target]] for one in good])]).astype(int)
    return as_before(known, replace(
        States.of(after, [after.rest], sloped=True).joined(
            *(one.state for one in good), samples.take(np.setdiff1d(np.arange(len(both)), asked))),
        rejected_poses=np.concatenate([known.samples.rejected_poses,
                                       known.samples.poses[1 + lost]])))


def _corrected(known: States, before: GraspModel, then: Sequence[RodState],
               after: GraspModel, now: Sequence[RodState]) -> States:
    """Return the ``known`` states with another modulus, from the rod's ``then`` and ``now``."""
    old, new = _of_rod(before, then), _of_rod(after, now)
    stiff, was = (np.trace(one.rod.held(one.rod.rest)[1]) for one in (after, before))
    columns = {name: column + (stiff / was if name in _GROWING else 1.0) * (
        getattr(known, name) - getattr(old, name))
        for name, column in vars(new).items() if name in _GROWING or name in (
            "poses", "tips", "targets", "shape_slopes", "strains")}
    return replace(known, added={}, torques=stiff / was * known.torques,
                   solved=np.zeros(len(known.poses), bool), **columns)


def _of_rod(grasp_model: GraspModel, states: Sequence[RodState]) -> States:
    """Return the branch's states as the rod has them."""
    model, rod = grasp_model.model, grasp_model.rod
    still = np.zeros_like(grasp_model.mesh.nodes)
    points = rod.points(np.concatenate([grasp_model.tip(still)[None],
                                        grasp_model.branch.target_positions(still)]))
    part = model.weights / model.weights.sum(axis=1, keepdims=True)
    carried = carried_strain(model)
    hanging, rows = known_at(*rod.rest, rod.arrays)[0], []
    for state in states:
        energy, force, _, changes, _ = known_at(*state, rod.arrays)
        turned = Rotation.from_quat(np.roll(state.turns[-1], -1)).as_rotvec()
        turns = (composed(_TURN * changes[-6:-3].T, np.tile(turned, (3, 1))) - turned) / _TURN
        strain = np.einsum("eq,eqk->ek", part, present(rod.lifted(state).strain, "strain"))
        strain = strain if carried is None else strain + carried
        stress = hooke_stress(strain, model.lame_lambda, model.lame_mu)
        places, slopes = rod.moved(state, points)
        rows.append((np.concatenate([state.places[-1], turned]), energy - hanging, force, places[0],
                     places[1:], np.hstack([turns, slopes.reshape(3, -1)]), _peak(strain),
                     _peak(stress), rotated(turned, grasp_model.reach.axis) @ force))
    poses, energies, forces, tips, targets, slopes, strains, stresses, axial = map(
        np.array, zip(*rows, strict=True))
    return States(poses, energies, forces, tips, np.ones(len(poses)), strains=strains,
                  targets=targets, stresses=stresses, shape_slopes=slopes, axial_forces=axial)


def _peak(tensors: np.ndarray) -> float:
    """Return the largest principal value by magnitude of symmetric tensors [n, 6]."""
    size = tensors**2 @ MULTIPLICITY
    # It is at least the norm over root 3.
    large = tensors[size >= size.max() / 3.0]
    return float(np.abs(np.linalg.eigvalsh(large[:, [[0, 3, 4], [3, 1, 5], [4, 5, 2]]])).max())
