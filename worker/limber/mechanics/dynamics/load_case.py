"""A load case: what holds and pulls a branch, and the resulting motion."""

from dataclasses import dataclass

import numpy as np

from limber.core.not_none import present
from limber.core.progress import Progress
from limber.mechanics.dynamics.integration import MotionSettings, simulate_dynamics
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.mechanics.statics.result import StaticResult
from limber.mechanics.statics.solve import solve_static


@dataclass(frozen=True)
class LoadCase:
    """Loads and constraints over the frames of a pull.

    Attributes:
        model: The branch, with its added masses.
        start: Equilibrium before the pull, with grippers attached and without force.
        grasp: The gripper that pulls.
        follows_pose: Whether it follows poses; otherwise it exerts ``grasp_force``.
        holds: Other grippers and ties; they stay in their initial positions.
        poses_along: Poses of the gripper [m, rad], shape [frames, 6]; unused if it exerts a force.
        grasp_force: Force at the end of the pull [N], shape [3].
        loads: Other forces on the nodes at the end of the pull [N], shape [node_count, 3].
        times: Times of the frames [s], shape [frames].
        part: Fraction of the pull's forces at each frame, shape [frames].
    """

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
        """Split the reactions of held patches into the gripper's and those of the holds.

        Args:
            reactions: Reactions of the grasps in :attr:`held`, shape [frames, held, 3].

        Returns:
            Shapes [frames, 3] and [frames, holds, 3].
        """
        if self.follows_pose:
            return reactions[:, 0], reactions[:, 1:]
        return np.zeros((len(reactions), 3)), reactions


@dataclass(frozen=True)
class SimulatedMotion:
    """Frames of a motion; fewer than the pull's if the branch could not follow.

    Attributes:
        times: [s], shape [frames].
        displacement: Displacement of all nodes from the rest shape [m], shape [frames, node_count,
        3].
        energy, kinetic_energy: [J], shape [frames]; energy: the potential of strain and weight
            above the first state of the pull, before any pulling force acts.
        grasp_force, grasp_torque: Force and torque of the gripper on the branch [N, Nm], shape
        [frames, 3].
        hold_forces: Forces of the other holds [N], shape [frames, holds, 3].
        min_det_f: Smallest det F, shape [frames].
        converged: Whether all frames were reached; ``message`` states why not.
        warnings: Warnings for the user.
    """

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
