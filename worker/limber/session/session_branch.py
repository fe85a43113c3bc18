"""The branch of a session with its grasps and loads, and its equilibria on the full model.

It does not depend on clients, threads or files: :mod:`limber.session.worker` passes the requests
and publishes the answers.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from limber.core.errors import InputError, Option
from limber.core.numerics.rigid import pose_between
from limber.core.progress import SILENT, Progress
from limber.geometry.skeleton.skeleton import Skeleton
from limber.mechanics.grasp import RADIAN, Grasp
from limber.mechanics.loads.loaded_branch import LoadedBranch
from limber.mechanics.loads.outdoor import LoadedOutdoors, Outdoors
from limber.mechanics.model import BranchModel
from limber.mechanics.statics.solve import solve_static
from limber.mechanics.strain import carried_strain
from limber.reduced.model_cache import as_control_points
from limber.reduced.reduced_model import ReducedSettings
from limber.reduced.training import TrainingSettings
from limber.session.frame_buffer import HeldAt
from limber.session.protocol import GRASP_LIMIT, Load, SessionSettings
from limber.store import Branch
from limber.store.loading import load_branch, load_skeleton, stiffness_deviation

FULL_STEP = 0.05
"""Longest step towards the target poses that the full model takes before it shows a frame, as a
fraction of the branch's extent.
"""


@dataclass(frozen=True)
class Answer:
    """A state of the branch, from either model.

    Attributes:
        displacement: Displacement of all nodes from the hanging branch [m], shape [node_count, 3].
        energy: Potential of strain and weight above the hanging branch [J]; and ``kinetic_energy``.
        time: Time of a motion [s].
        is_converged: An equilibrium was found, or the step was.
        is_reached: The grasps are at their requested poses.
        is_trusted: Within the range that the model has learnt.
        message: Reason for a missing equilibrium.
    """

    displacement: np.ndarray
    grasps: tuple[HeldAt, ...] = ()
    energy: float = 0.0
    kinetic_energy: float = 0.0
    time: float = 0.0
    is_converged: bool = True
    is_reached: bool = True
    is_reduced: bool = False
    is_trusted: bool = True
    message: str = ""


@dataclass(frozen=True)
class Held:
    """A grasp: its patch, current pose and target pose [m, rad]."""

    grasp: Grasp
    pose: np.ndarray
    goal: np.ndarray


class HeldBranch:
    """A branch as it hangs, with its targets, grasps and loads. Wind, snow and cuts need its
    ``skeleton``; ``young_deviation`` is the standard deviation of log E, if known."""

    def __init__(self, loaded: LoadedBranch, skeleton: Skeleton | None = None,
                 young_deviation: float | None = None):
        self.loaded, self._skeleton = loaded, skeleton
        self.young_deviation = young_deviation
        self._outdoors: Outdoors | None = None
        self.model = model = loaded.model
        self.displacement = np.zeros_like(model.mesh.nodes)
        self.weights, self.young = as_control_points(model)
        faces = model.mesh.surface_faces()
        self.surface, compact = np.unique(faces, return_inverse=True)
        self.faces = compact.reshape(-1, 3)
        self.grasps: dict[int, Held] = {}
        self.gravity_on = model.prestress is not None
        self._hung: np.ndarray | None = None
        self._weather: np.ndarray | None = None
        self._is_gone = np.zeros(len(model.mesh.tets), bool)
        self._count = 0
        self._last: Answer | None = None
        self._strains = _AtVertices(model, self.surface)
        self._carried = carried_strain(model)

    def grab(self, vertex: int | None, point: tuple[float, float, float] | None, radius: float,
             mode: Literal["rigid", "point"]) -> int:
        """Hold a patch where it is now and return the grasp's number. ``point`` [m] and
        ``radius`` [m] (0: one node) are on the branch as it hung at the start. InputError for too
        many grasps, or where the branch is not there, or the base or another grasp is."""
        if len(self.grasps) >= GRASP_LIMIT:
            raise InputError(f"There are already {GRASP_LIMIT} grasps.",
                             "A frame cannot hold more.", "Release one.")
        return self.hold(Grasp.at(self.model.mesh, self._position_of(vertex, point), radius, mode))

    def hold(self, grasp: Grasp) -> int:
        """Hold a known patch; as :meth:`grab`."""
        self.model.equations([*(held.grasp for held in self.grasps.values()), grasp])
        pose = grasp.pose_of(self.model.mesh.nodes, self.displacement)
        if grasp.mode == "point":
            pose[3:] = 0.0
        self._count += 1
        self.grasps[self._count] = Held(grasp, pose, pose)
        return self._count

    def release(self, number: int | None) -> None:
        """Release a grasp, or all; InputError if there is no such grasp."""
        if number is None:
            self.grasps.clear()
        else:
            del self.grasps[self.number(number)]

    def number(self, number: int | None) -> int:
        """Return the number of a grasp, the first if none is named; InputError if there is none."""
        if not self.grasps:
            raise InputError("No grasp is held.", "A move needs a grasp.", "Send a grasp first.")
        number = min(self.grasps) if number is None else number
        if number not in self.grasps:
            raise InputError(f"There is no grasp {number}.",
                             f"There are {sorted(self.grasps)}.", "")
        return number

    def aim(self, number: int | None, pose: np.ndarray) -> None:
        """Set the target pose of a grasp (the first, if not named) [m, rad]."""
        number = self.number(number)
        held = self.grasps[number]
        if held.grasp.mode == "point":
            pose = np.concatenate([pose[:3], held.pose[3:]])
        self.grasps[number] = replace(held, goal=pose)

    def set_gravity(self, on: bool) -> None:
        """Switch the branch's weight; without it, the branch rises from where it hangs. InputError
        if it was loaded without weight."""
        if on and self.model.prestress is None:
            raise InputError("The branch has no weight.", "The session was started without it.",
                             "Start it with ", Option("gravity", True), ".")
        self.gravity_on = on

    def set_young(self, young: np.ndarray) -> None:
        """Set Young's modulus [K] [Pa] at the control points; the branch hangs as scanned.
        InputError if the number of values is wrong."""
        if young.shape != self.young.shape:
            raise InputError(f"{young.size} moduli.",
                             f"The branch has {len(self.young)} control points.", "")
        self.young = young
        self.model = self.model.with_young(self.weights @ young)
        self._carried = carried_strain(self.model)

    def set_loads(self, loads: list[Load]) -> None:
        """Replace the dead loads on the branch; InputError if a position is not on it."""
        forces = np.zeros_like(self.model.mesh.nodes)
        for load in loads:
            position = self._position_of(load.vertex, load.point)
            forces[np.linalg.norm(self.model.mesh.nodes - position,
                                  axis=1).argmin()] += load.force_n
        self._hung = forces if loads else None

    def set_outdoors(self, loads: Outdoors) -> LoadedOutdoors:
        """Replace wind, snow, fruit and cuts; a cut part keeps its shape, has no weight and does
        not count. InputError if a position is not on the branch, or its axes are unknown."""
        if self._skeleton is None:
            raise InputError("The branch has no axes.", "Wind, snow and cuts need its axes.",
                             "Make it from a scan (limber reconstruct).")
        made = LoadedOutdoors(self.model, self._skeleton, loads)
        self._outdoors = loads
        forces = made.dead_forces
        self._weather = forces if forces.any() else None
        self._is_gone = made.is_gone
        return made

    def outdoors(self) -> Outdoors:
        """Return the active wind, snow, fruit and cuts; InputError without any, or without
        weight."""
        if self._outdoors is None:
            raise InputError("There is no wind, snow, fruit or cut.", "",
                             "Send `outdoors` first.")
        if not self.gravity_on and self.model.prestress is not None:
            raise InputError("The branch's weight is switched off.",
                             "Effects of loads are computed for a branch under its "
                             "weight.", "Switch it on.")
        return self._outdoors

    def vertices_gone(self) -> np.ndarray:
        """Return the surface's vertices that are cut off, numbers [k]."""
        kept = np.unique(self.model.mesh.tets[~self._is_gone])
        return np.flatnonzero(~np.isin(self.surface, kept))

    @property
    def loads(self) -> np.ndarray | None:
        """Forces [node_count, 3] [N] beside those that the hanging branch carries; None: none."""
        acting = [forces for forces in (self._hung, self._weather) if forces is not None]
        if not self.gravity_on and self.model.prestress is not None:
            acting.append(-self.model.mass_load[:, None] * self.model.gravity)
        return sum(acting, np.zeros(3)) if acting else None

    def sag(self, answer: Answer) -> float:
        """Return the largest displacement along gravity [m] of the part that is not cut off."""
        size = float(np.linalg.norm(self.model.gravity))
        down = self.model.gravity / size if size else np.array([0.0, 0.0, -1.0])
        left = np.unique(self.model.mesh.tets[~self._is_gone])
        moved = answer.displacement[left] @ down
        return float(moved[np.abs(moved).argmax()])

    def goal_distance(self, number: int) -> float:
        """Return the distance of a grasp from its target [m]; rotations count as lengths."""
        held = self.grasps[number]
        move = held.goal - held.pose
        return float(np.linalg.norm(move[:3])
                     + RADIAN * self.model.extent * np.linalg.norm(move[3:]))

    def put(self, number: int, pose: np.ndarray, displacement: np.ndarray) -> None:
        """Record that a grasp is now at a pose, with the branch displaced accordingly."""
        self.grasps[number] = replace(self.grasps[number], pose=pose)
        self.displacement = displacement

    def solve(self) -> Answer:
        """Move towards the target poses with the full model, by a short step at most. If there is
        no equilibrium, the branch keeps its last position."""
        longest = max((self.goal_distance(number) for number in self.grasps), default=0.0)
        part = min(1.0, FULL_STEP * self.model.extent / max(longest, 1e-12))
        goals = {number: held.goal if part == 1.0 else pose_between(held.pose, held.goal, part)
                 for number, held in self.grasps.items()}
        grasps = [held.grasp for held in self.grasps.values()]
        result = solve_static(
            self.model, grasp=grasps or None,
            pose=np.array(list(goals.values())) if grasps else None,
            nodal_forces=self.loads, start=self.displacement)
        if result.converged:
            self.displacement = result.displacement
            self.grasps = {number: replace(held, pose=goals[number])
                           for number, held in self.grasps.items()}
        forces = np.reshape(result.reaction_force, (-1, 3))
        torques = np.reshape(result.reaction_torque, (-1, 3))
        if not result.converged:
            return replace(self._last or Answer(self.displacement), is_converged=False,
                           is_reached=False, is_trusted=False, message=result.message)
        held = tuple(HeldAt(number, self.grasps[number].pose, force, torque)
                     for number, force, torque in zip(self.grasps, forces, torques, strict=False))
        self._last = Answer(self.displacement, held, result.energy,
                            is_reached=part == 1.0, is_trusted=part == 1.0)
        return self._last

    def positions(self, answer: Answer) -> np.ndarray:
        """Return the surface's positions [m], shape [vertex_count, 3]."""
        return self.model.mesh.nodes[self.surface] + answer.displacement[self.surface]

    def target_positions(self, answer: Answer) -> np.ndarray:
        """Return the positions of the targets [m], shape [t, 3]."""
        return self.loaded.target_positions(answer.displacement)

    def strain(self, answer: Answer) -> tuple[np.ndarray, float, np.ndarray]:
        """Return the strain at the vertices [v], the largest of all, and its position [m]."""
        strains = self.model.largest_principal_strains(answer.displacement, self._carried)
        strains[self._is_gone] = 0.0
        worst = int(strains.argmax())
        corners = self.model.mesh.tets[worst, :4]
        position = (self.model.mesh.nodes[corners] + answer.displacement[corners]).mean(axis=0)
        return self._strains(strains), float(strains[worst]), position

    def _position_of(self, vertex: int | None,
                     point: tuple[float, float, float] | None) -> np.ndarray:
        if vertex is None:
            return np.asarray(point, float)
        if vertex >= len(self.surface):
            raise InputError(f"There is no vertex {vertex}.",
                             f"The surface has {len(self.surface)}.", "")
        return self.model.mesh.nodes[self.surface[vertex]]


class _AtVertices:
    """Maps values of tetrahedra to the surface's vertices: the largest at each."""

    def __init__(self, model: BranchModel, surface: np.ndarray):
        tets = model.mesh.tets
        indices = np.full(model.mesh.node_count, -1)
        indices[surface] = np.arange(len(surface))
        vertex = indices[tets].ravel()
        tet = np.repeat(np.arange(len(tets)), tets.shape[1])[vertex >= 0]
        vertex = vertex[vertex >= 0]
        order = np.argsort(vertex, kind="stable")
        self._tets = tet[order]
        self._starts = np.searchsorted(vertex[order], np.arange(len(surface)))

    def __call__(self, values: np.ndarray) -> np.ndarray:
        return np.maximum.reduceat(values[self._tets], self._starts)


# The initial branch of a session, and the inputs of its reduced model.


def reduced_settings(settings: SessionSettings) -> ReducedSettings:
    """Return the data from which the reduced model is made."""
    training = TrainingSettings(grasp_count=settings.grasps, young_spread=settings.young_spread)
    return ReducedSettings(size=settings.size, field_count=settings.fields, training=training,
                           vibration_count=1 if settings.young_spread == 1 else 0)


def load_held(folder: Path, settings: SessionSettings,
              progress: Progress = SILENT) -> HeldBranch:
    """Return the branch of a folder as it hangs, without grasps. BranchFolderError if there is
    none, or no mesh in it; InputError if it lacks the material."""
    branch = Branch.read(folder)
    axes = load_skeleton(branch) if branch.has("skeleton.swc") else None
    return HeldBranch(load_branch(branch, gravity=settings.gravity, progress=progress), axes,
                      stiffness_deviation(branch))
