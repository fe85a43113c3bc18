"""A static problem: constraints, loads, target, and the reactions at its end."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Required, TypedDict, Unpack

import numpy as np

from limber.core.errors import InputError
from limber.mechanics.grasp import Grasp, check_pose
from limber.mechanics.internal_state import InternalState
from limber.mechanics.linear.equations import Equations
from limber.mechanics.model import BranchModel
from limber.mechanics.solve_status import Status
from limber.mechanics.statics.result import StaticResult, StaticSettings
from limber.mechanics.strain import Place


@dataclass(frozen=True)
class Target:
    """The target of a solve: held nodes, means of pinned patches, loads.

    Attributes:
        held: Displacement of held nodes [m] (others unused), shape [node_count, 3].
        pins: Displacement of the pinned means [m], shape [pinned, 3].
        load: Forces on the nodes [N], shape [node_count, 3].
    """

    held: np.ndarray
    pins: np.ndarray
    load: np.ndarray


class StaticProblem:
    """One set of constraints; solves for a target from a start."""

    def __init__(self, model: BranchModel, grasp: Grasp | Sequence[Grasp] | None,
                 is_held: bool, settings: StaticSettings):
        self.model, self.settings = model, settings
        self.grasps = ([] if grasp is None else [grasp] if isinstance(grasp, Grasp)
                       else list(grasp))
        self.single = isinstance(grasp, Grasp)
        if is_held and not self.grasps:
            raise InputError("A pose is given without a grasp.", "No node would follow it.",
                             "Also give the grasp.")
        self.is_held = is_held
        self.equations: Equations = model.equations(self.grasps if is_held else ())
        self.mixed = settings.mixed and model.material.has_cubic_force

    def poses(self, pose: np.ndarray) -> list[np.ndarray]:
        poses = np.asarray(pose, float).reshape(-1, 6) if np.size(pose) % 6 == 0 else [pose]
        if len(poses) != len(self.grasps):
            raise InputError(f"{len(poses)} poses are given for {len(self.grasps)} grasps.",
                             "Each grasp needs one pose.", "Give an array [grasps, 6].")
        return [check_pose(item) for item in poses]

    def target(self, pose: np.ndarray | None, grasp_force: np.ndarray | None,
               nodal_forces: np.ndarray | None) -> Target:
        shape = (self.model.mesh.node_count, 3)
        held = np.zeros(shape)
        pins: list[np.ndarray] = []
        load = self.model.weight_force
        if nodal_forces is not None:
            load = load + checked_forces(nodal_forces, shape)
        if pose is not None:
            held, pins = self.constraint(self.poses(pose))
        if grasp_force is not None:
            load = load + self.spread(grasp_force)
        return Target(held, np.reshape(pins, (-1, 3)), load)

    def constraint(self, poses: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
        held, pins = np.zeros((self.model.mesh.node_count, 3)), []
        for grasp, pose in zip(self.grasps, poses, strict=True):
            if grasp.mode == "rigid":
                held[grasp.nodes] = grasp.displacement(self.model.mesh.nodes, pose)
            else:
                pins.append(pose[:3] - grasp.centre)
        return held, pins

    def spread(self, grasp_force: np.ndarray) -> np.ndarray:
        """Return nodal forces of forces [N] at the grasps, spread over the patches."""
        forces = np.asarray(grasp_force, float).reshape(-1, 3)
        if self.is_held or len(forces) != len(self.grasps) or not np.isfinite(forces).all():
            raise InputError(f"{len(forces)} grasp forces are given for "
                             f"{len(self.grasps)} grasps.",
                             "Each grasp needs a force, and a grasp with a force has no pose.",
                             "Give an array [grasps, 3] [N] and omit the poses.")
        load = np.zeros((self.model.mesh.node_count, 3))
        for grasp, force in zip(self.grasps, forces, strict=True):
            load[grasp.nodes] += grasp.weights[:, None] * force
        return load

    def displacement_of(self, start: "StaticResult | np.ndarray | None") -> np.ndarray:
        if start is None:
            return np.zeros((self.model.mesh.node_count, 3))
        values = start.displacement if isinstance(start, StaticResult) else start
        return checked_forces(values, (self.model.mesh.node_count, 3), "start displacements")


def strain_warnings(stretch: Place) -> list[str]:
    """Return a warning if the largest stretch exceeds the strength of wood, else an empty tuple."""
    if stretch.value <= 1.5:
        return []
    return [f"The strain reaches {100 * (stretch.value - 1):.0f} % {stretch.at}, far more than "
            "wood withstands. Check the units of the loads and of Young's modulus."]


class HowFound(TypedDict, total=False):
    """The fields of a result that state how it was found; see StaticResult."""

    status: Required[Status]
    iterations: Required[int]
    residual_history: Required[list[float]]
    seconds: Required[float]
    reached: float
    message: str
    warnings: list[str]
    snapped_at: list[float]
    uncertainty: str


def make_result(problem: StaticProblem, displacement: np.ndarray, state: InternalState,
                load: np.ndarray, **found: Unpack[HowFound]) -> StaticResult:
    """Return a result with the reactions that belong to a displacement."""
    model = problem.model
    positions = model.mesh.nodes + displacement
    out = state.force - load
    base = base_forces(model, out)
    pose, force, torque = None, np.zeros(3), np.zeros(3)
    if problem.grasps:
        poses = [g.pose_of(model.mesh.nodes, displacement) for g in problem.grasps]
        parts = [grasp_wrench(problem, grasp, positions, out, p[:3])
                 for grasp, p in zip(problem.grasps, poses, strict=True)]
        pose, force, torque = (np.array(poses), np.array([p[0] for p in parts]),
                               np.array([p[1] for p in parts]))
        if problem.single:
            pose, force, torque = pose[0], force[0], torque[0]
    return StaticResult(
        displacement=displacement, pose=pose, strain_energy=state.strain_energy,
        energy=state.energy - float((model.weight_force * displacement).sum()),
        reaction_force=force, reaction_torque=torque, base_force=base.sum(axis=0),
        base_torque=np.cross(positions, base).sum(axis=0), min_det_f=state.min_det_f, **found)


def base_forces(model: BranchModel, out: np.ndarray) -> np.ndarray:
    """Return the force of the base on its nodes [N], 0 elsewhere, shape [node_count, 3].

    Args:
        out: Internal and inertial force less loads on all nodes [N], shape [node_count, 3].
    """
    base = np.where(model.fixed[:, None], out, 0.0)
    return base if model.prestress is None else base + model.prestress.total.base


def grasp_wrench(problem: StaticProblem, grasp: Grasp, positions: np.ndarray, out: np.ndarray,
                 centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return force [N] and torque [Nm] about ``centre`` of a gripper on the branch.

    Args:
        out: Internal force less loads on all nodes [N], shape [node_count, 3].
    """
    if not problem.is_held:
        return np.zeros(3), np.zeros(3)
    forces = out[grasp.nodes]
    if grasp.mode == "point":
        total = grasp.weights @ forces / (grasp.weights @ grasp.weights)
        forces = grasp.weights[:, None] * total
    return forces.sum(axis=0), np.cross(positions[grasp.nodes] - centre, forces).sum(axis=0)


def checked_forces(values: np.ndarray, shape: tuple[int, ...],
                   name: str = "nodal forces") -> np.ndarray:
    """Return a nodal field as floats.

    Raises:
        InputError: the shape is wrong, or a value is not finite.
    """
    values = np.asarray(values, float)
    if values.shape != shape or not np.isfinite(values).all():
        raise InputError(f"The {name} have shape {values.shape} or are not finite.",
                         f"The mesh needs {shape}.", "Give three numbers for each node.")
    return values
