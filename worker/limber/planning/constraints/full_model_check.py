"""Check of a planned motion on the full model, and the samples gained if it fails."""

import numpy as np

from limber.core.errors import NoPathError
from limber.core.progress import Progress
from limber.planning.constraints.limits import Limits
from limber.planning.field.energy_field import EnergyField, knowing
from limber.planning.field.grasp_model import GraspModel
from limber.planning.field.grasp_samples import GraspSamples
from limber.planning.field.sampling import displacements_at
from limber.planning.goals.goal import Goal
from limber.planning.path_on_full_model import ResolvedPath, SolvedPoses

_APART = 0.01  # [m] between states of a path that become samples
_MOST_LEARNT = 12  # most of them in a round
_NONE = np.empty((0, 3))
_ROUND_OFF = 1e-12  # fraction of the samples' largest energy
_SLACK = 1e-3  # fraction of the goal's tolerance that is rounding


def broken_on_full_model(path: ResolvedPath, limits: Limits, goal: Goal, nodes: np.ndarray,
                         ) -> list[str]:
    """Return the violations of a motion, each with its position; empty if it is allowed.

    Every pose of approach and path must have an acceptable solution within the limits and keep the
    constraints, and the end must be in the goal region. The return path takes the same states.

    Args:
        path: Solved on the full model.
        limits: As requested, without margins.
        goal: Where it must end.
        nodes: Nodes of the mesh at rest [m], shape [n, 3].
    """
    faults = []
    for position, reason in zip(path.unsolved, path.reasons, strict=True):
        point_text = ", ".join(f"{x:.3f}" for x in position)
        faults.append(f"no acceptable solution ({reason}) at ({point_text}) m")
    faults = faults[:1] + ([f"and at {len(faults) - 1} more poses"] if len(faults) > 1 else [])
    whole = path.approach.joined(path.solved)
    faults += [str(broken) for broken in limits.broken(whole)]
    if path.is_whole:
        off = goal.missed_by(path.solved)
        if off > goal.tolerance * _SLACK:
            faults.append(f"{goal.what} ends {1e3 * off:.1f} mm outside its goal")
    return faults + limits.met(whole.poses[:, :3], nodes + whole.displacements)


def field_error(field: EnergyField, states: SolvedPoses) -> float:
    """Return the error of the field's energy against states, relative root mean square."""
    size = float(np.sqrt(np.mean(states.energies**2)))
    off = field.energy(states.poses[:, :3]) - np.maximum(states.energies, 0.0)
    # At rest there is only round-off.
    felt = size > _ROUND_OFF * field.samples.energies.max()
    return float(np.sqrt(np.mean(off**2))) / size if felt else 0.0


def learnt(field: EnergyField, grasp_model: GraspModel, path: ResolvedPath, limits: Limits,
           ) -> GraspSamples:
    """Return states of a rejected path as samples: its end, where limits are broken, and where the
    field's error is largest; and poses without a solution as rejected ones.
    """
    whole = path.approach.joined(path.solved)
    off = np.abs(field.energy(whole.poses[:, :3]) - whole.energies)
    added = limits.values(whole.poses[:, :3], grasp_model.mesh.nodes + whole.displacements)
    over = [added[each.name] > each.limit for each in limits.constraints]
    broken = np.flatnonzero(np.logical_or.reduce([~limits.kept(whole), *over]))
    order = np.concatenate([[len(off) - 1], broken[:: max(1, 2 * len(broken) // _MOST_LEARNT)],
                            np.argsort(-off)])
    chosen: list[int] = []
    known = field.samples.positions
    for index in order:
        position = whole.poses[index, :3]
        others = np.concatenate([known, whole.poses[chosen, :3]])
        if len(chosen) < _MOST_LEARNT and (
                np.linalg.norm(others - position, axis=1).min() > 0.5 * _APART):
            chosen.append(int(index))
    return as_samples(grasp_model, whole.take(np.array(chosen, int)), field.samples, limits,
                      path.unsolved)


def as_samples(grasp_model: GraspModel, states: SolvedPoses, like: GraspSamples, limits: Limits,
               unsolved: np.ndarray = _NONE) -> GraspSamples:
    """Return states as samples with what those ``like`` them have, and the quantities of the
    ``limits``' constraints; ``unsolved`` grasp positions [q, 3] as rejected ones.
    """
    names = ("targets", "torques", "strain_places", "stresses", "axial_forces")
    optional = {name: getattr(states, name) for name in names if getattr(like, name) is not None}
    if like.shape_slopes is not None:
        slopes = [grasp_model.shape_slopes(moved) for moved in states.displacements]
        optional["shape_slopes"] = np.reshape(slopes, (-1, *like.shape_slopes.shape[1:]))
    added = limits.values(states.poses[:, :3], grasp_model.mesh.nodes + states.displacements)
    return GraspSamples(states.poses, states.energies, states.forces, states.tips,
                        states.min_det_f, np.hstack([unsolved, np.zeros_like(unsolved)]),
                        states.strains, added=added, **optional)


def with_constraints(field: EnergyField, grasp_model: GraspModel, limits: Limits,
                     workers: int | None, progress: Progress) -> EnergyField:
    """Return the field with the constraints' quantities as loads.

    Raises:
        NoPathError: one is broken where the branch hangs.
    """
    nodes, rest = grasp_model.mesh.nodes, grasp_model.rest.displacement
    if met := limits.met(field.rest[None], nodes + rest[None]):
        raise NoPathError(f"The branch breaks a limit at its rest pose: {'; '.join(met)}.",
                          "No path can start there.",
                          "Correct the obstacles in the cell file, or the limit.")
    grasps = field.samples.positions
    displacements = displacements_at(grasp_model, grasps, workers=workers,
                                     progress=progress.part(0.0, 0.1))
    return knowing(field, limits.values(grasps, nodes + displacements))
