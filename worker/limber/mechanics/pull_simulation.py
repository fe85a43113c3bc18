"""A pull as described by settings: the loaded branch, the grasp and its motion."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from limber.core.errors import InputError, Option
from limber.core.not_none import present
from limber.core.numerics.rigid import any_normal, composed
from limber.core.progress import SILENT, Progress
from limber.mechanics.added_masses import PointMass
from limber.mechanics.dynamics.drive import PoseTable
from limber.mechanics.dynamics.integration import simulate_dynamics
from limber.mechanics.dynamics.motion import EnergyMomentumSettings, MotionSettings, NewmarkSettings
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.mechanics.settings import FRAME_RATE, GRASP_RADIUS_M, Point, SimulateSettings
from limber.mechanics.statics.result import StaticResult
from limber.mechanics.statics.solve import solve_static

# A load case: what holds and pulls a branch, and the resulting motion.


@dataclass(frozen=True)
class LoadCase:
    """Loads over a pull's frames from ``start``, with grippers attached and no force. The grasp
    follows ``poses_along`` [frames, 6] [m, rad] or exerts ``grasp_force``; ``holds`` stay. This
    force and ``loads`` [node_count, 3] [N] are those of the end, ``part`` [frames] of them acts."""

    model: BranchModel
    start: StaticResult
    grasp: Grasp
    follows_pose: bool
    holds: tuple[Grasp, ...]
    poses_along: np.ndarray
    grasp_force: np.ndarray
    loads: np.ndarray
    times: np.ndarray
    part: np.ndarray

    @property
    def held(self) -> list[Grasp]:
        """All grasps that follow a pose; the gripper first, if it does."""
        return [self.grasp, *self.holds] if self.follows_pose else list(self.holds)

    def poses(self) -> np.ndarray:
        """Poses of the grasps in :attr:`held` [m, rad], shape [frames, held, 6]."""
        pose = present(self.start.pose, "pose of the grasps")
        still = np.tile(pose[1:], (len(self.times), 1, 1))
        return np.concatenate([self.poses_along[:, None], still],
                              axis=1) if self.follows_pose else still

    def nodal_forces(self) -> np.ndarray:
        """All forces at the end of the pull [N], shape [node_count, 3]."""
        forces = self.loads.copy()
        if not self.follows_pose:
            forces[self.grasp.nodes] += self.grasp.weights[:, None] * self.grasp_force
        return forces

    def at_grippers(self, reactions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Split reactions [frames, held, 3] of :attr:`held` patches into the gripper's [frames, 3]
        and the holds' [frames, holds, 3]."""
        if self.follows_pose:
            return reactions[:, 0], reactions[:, 1:]
        return np.zeros((len(reactions), 3)), reactions


@dataclass(frozen=True)
class SimulatedMotion:
    """Frames of a motion, fewer than the pull's if the branch could not follow (``message``):
    displacement from rest [frames, node_count, 3], and the gripper's and holds' force on the
    branch. ``energy`` [J], of strain and weight, is above the state before any pulling force."""

    times: np.ndarray
    displacement: np.ndarray
    energy: np.ndarray
    kinetic_energy: np.ndarray
    grasp_force: np.ndarray
    grasp_torque: np.ndarray
    hold_forces: np.ndarray
    min_det_f: np.ndarray
    converged: bool
    message: str
    warnings: list[str]


def static_motion(case: LoadCase, progress: Progress) -> SimulatedMotion:
    """Follow a pull through equilibria, up to the first frame without one."""
    held, poses, forces = case.held, case.poses(), case.nodal_forces()
    results: list[StaticResult] = []
    for number, part in enumerate(case.part):
        progress(number / len(case.part), "following the pull", frame=number)
        results.append(solve_static(
            case.model, grasp=held or None, pose=poses[number] if held else None,
            nodal_forces=part * forces, start=results[-1] if results else case.start))
        if not results[-1].converged:
            break
    last, count = results[-1], len(results)
    reactions = np.array([r.reaction_force for r in results]).reshape(count, -1, 3)
    torques = np.array([r.reaction_torque for r in results]).reshape(count, -1, 3)
    force, hold_forces = _forces(case, reactions)
    return SimulatedMotion(
        times=case.times[:count], displacement=np.array([r.displacement for r in results]),
        energy=np.array([r.energy for r in results]) - case.start.energy,
        kinetic_energy=np.zeros(count), grasp_force=force,
        grasp_torque=case.at_grippers(torques)[0], hold_forces=hold_forces,
        min_det_f=np.array([r.min_det_f for r in results]), converged=last.converged,
        message=last.message, warnings=last.warnings)


def dynamic_motion(case: LoadCase, settings: MotionSettings,
                   progress: Progress) -> SimulatedMotion:
    """Compute a pull in time, with inertia and damping."""
    held, forces = case.held, case.nodal_forces()
    found = simulate_dynamics(
        case.model, grasp=held or None, poses=case.poses() if held else None,
        nodal_forces=case.part[:, None, None] * forces if forces.any() else None,
        times=case.times, start=case.start, settings=settings, progress=progress)
    count = len(found.times)
    force, hold_forces = _forces(case, found.reaction_force.reshape(count, -1, 3))
    return SimulatedMotion(
        times=found.times, displacement=found.displacement,
        energy=found.energy - case.start.energy,
        kinetic_energy=found.kinetic_energy, grasp_force=force,
        grasp_torque=case.at_grippers(found.reaction_torque.reshape(count, -1, 3))[0],
        hold_forces=hold_forces, min_det_f=found.min_det_f, converged=found.converged,
        message=found.message, warnings=found.warnings)


def _forces(case: LoadCase, reactions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the gripper's forces [frames, 3] and those of the holds [frames, holds, 3]."""
    force, hold_forces = case.at_grippers(reactions[:, :len(case.held)])
    if not case.follows_pose:
        force = case.part[:len(reactions), None] * case.grasp_force
    return force, hold_forces


_PROBE = 1e-6
"""Force [N] small enough that the branch responds linearly."""
_DEFAULT_BEND = 0.2
"""Default bending, as a fraction of the distance from base to grasp. Chosen, not measured."""


def bending_force(model: BranchModel, grasp: Grasp) -> np.ndarray:
    """Return the transverse force [3] [N] that bends a branch by a fifth of its reach, by its
    stiffness at rest. A motion along any line in space would buckle or stretch it."""
    axis = grasp.centre - model.mesh.nodes[model.fixed].mean(axis=0)
    across = any_normal(axis)
    weightless = model.with_parameters(gravity=(0.0, 0.0, 0.0))
    probe = solve_static(weightless, grasp=grasp, grasp_force=_PROBE * across).require()
    moved = np.linalg.norm(grasp.weights @ probe.displacement[grasp.nodes])
    return _PROBE * _DEFAULT_BEND * np.linalg.norm(axis) / moved * across


def load_case_of(model: BranchModel, settings: SimulateSettings, along: PoseTable | None = None,
                 grasp_point: np.ndarray | Sequence[float] | None = None, *,
                 grasp_radius: float = GRASP_RADIUS_M, frame_rate: float = FRAME_RATE,
                 ) -> LoadCase:
    """Return the load case that settings request, or a path instead of their motion.
    ``grasp_point`` [m] None is the patch's centre. InputError if options do not fit,
    ConvergenceError if the branch has no equilibrium."""
    def patch(point: Point, mode: Literal["rigid", "point"]) -> Grasp:
        if mode == "rigid":
            return Grasp.gripping(model.mesh, np.array(point), grasp_radius)
        return Grasp.at(model.mesh, np.array(point), grasp_radius, mode)

    grasp = (Grasp.from_mesh(model.mesh, settings.grasp_mode, grasp_point)
             if settings.grasp_point is None else patch(settings.grasp_point, settings.grasp_mode))
    holds = tuple(patch(point, settings.grasp_mode) for point in settings.hold_at)
    model = model.gripped(grasp, *holds)
    loads = np.zeros_like(model.mesh.nodes)
    for point in settings.load_at:
        loaded = patch(point[:3], "point")
        loads[loaded.nodes] += loaded.weights[:, None] * np.array(point[3:])
    follows_pose = along is not None or settings.move is not None or settings.turn is not None
    force = np.array(settings.grasp_force or (0.0, 0.0, 0.0))
    if not (follows_pose or settings.grasp_force is not None or settings.load_at):
        force = bending_force(model, grasp)
    start = solve_static(model, grasp=[grasp, *holds],
                         grasp_force=np.zeros((1 + len(holds), 3))).require()
    times, part = _ramp(settings, along.duration if along else settings.duration, frame_rate)
    changes = along.changes(times) if along else part[:, None] * np.concatenate(
        [settings.move or (0.0, 0, 0), settings.turn or (0.0, 0, 0)])
    first = present(start.pose, "pose of the grasps")[0]
    return LoadCase(model, start, grasp, follows_pose, holds,
                    _prescribed_path(first, changes, settings.grasp_mode), force, loads, times,
                    part)


def with_masses(model: BranchModel, settings: SimulateSettings) -> BranchModel:
    """Return the model with the added masses of the settings."""
    return model.with_point_masses([PointMass(entry[:3], entry[3]) for entry in settings.mass_at])


def require_one_drive(settings: SimulateSettings, along: PoseTable | None) -> None:
    """Reject more than one of a motion, a path and a force. InputError if there are more."""
    moves = settings.move is not None or settings.turn is not None
    if (settings.grasp_force is not None) + moves + (along is not None) > 1:
        raise InputError("More than one of a motion, a path and a force is given.",
                         "A grasp follows poses or exerts a force.",
                         "Give ", Option("move"), " and ", Option("turn"), ", or ", Option("along"),
                         ", or ", Option("grasp_force"), ".")


def motion_of(case: LoadCase, settings: SimulateSettings,
              progress: Progress = SILENT) -> SimulatedMotion:
    """Pull, quasi-statically or in time."""
    if settings.kind == "static":
        return static_motion(case, progress)
    scheme: MotionSettings = EnergyMomentumSettings(max_step=settings.step)
    if settings.newmark is not None:
        beta, gamma = settings.newmark
        scheme = NewmarkSettings(max_step=settings.step, beta=beta, gamma=gamma)
    return dynamic_motion(case, scheme, progress)


def _ramp(settings: SimulateSettings, duration: float, frame_rate: float,
          ) -> tuple[np.ndarray, np.ndarray]:
    """Return times [s] and the fraction of the pull at each. In motion it starts and ends at rest,
    and the end pose is held."""
    hold = settings.hold if settings.kind == "dynamic" else 0.0
    count = max(2, round((duration + hold) * frame_rate) + 1)
    times = np.arange(count) / frame_rate
    part = np.clip(times / duration, 0, 1)
    return times, part**2 * (3 - 2 * part) if settings.kind == "dynamic" else part


def _prescribed_path(pose: np.ndarray, changes: np.ndarray, mode: str) -> np.ndarray:
    """Return the grasp's poses [frames, 6], starting at its pose on the loaded branch."""
    if mode == "point":
        pose = np.concatenate([pose[:3], np.zeros(3)])
    return np.hstack([pose[:3] + changes[:, :3], composed(changes[:, 3:], pose[3:])])
