"""A pull, simulated: a slow one frame by frame as a chain of equilibria, a fast one over time,
with exact derivatives."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from limber.core.errors import InputError, Option, WorkError
from limber.core.not_none import present
from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.estimation.forward import forward_model as base
from limber.estimation.parameters import Values, YoungField, equal_values, mechanics_names
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.added_masses import HungTwig
from limber.mechanics.dynamics.integration import simulate_dynamics
from limber.mechanics.dynamics.motion import NewmarkSettings
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel, CarriedWeight
from limber.mechanics.sensitivities import ParameterSet, explicit_forces, static_sensitivities
from limber.mechanics.statics.solve import StaticResult, StaticSettings, solve_static
from limber.recordings.recording import PullEntry, point_of, pose_on
from limber.recordings.synchronisation import Frames

# The torque of a clamping gripper: whether it counts, and its derivatives.


def uses_torque(entry: PullEntry, frames: Frames) -> bool:
    """Whether the gripper's torque counts: for a clamped grasp, and a sensor with a stated torque
    noise. Driven by pose it is an observation; driven by force it acts as a load."""
    return (entry.grasp.mode == "rigid" and entry.sensor.torque_sigma_nm is not None
            and bool(np.isfinite(frames.wrenches[:, 3:]).all(axis=1).any()))


def require_torque(name: str, entry: PullEntry, frames: Frames) -> None:
    """Refuse a clamped gripper without torque: its force alone does not determine the motion.
    InputError if its torque was not measured."""
    if not uses_torque(entry, frames):
        raise InputError(
            f"{name}: the force of a clamped gripper drives the simulation, but its torque is not "
            "known.",
            "A clamped gripper also bends the branch by a torque. A simulation with the force "
            "alone would not reproduce the pull.",
            "Use ", Option("drive", "pose"), ", or record the torque and give torque_sigma_nm "
            'under [sensor] in pull.toml. If the branch could turn in the gripper, set mode = '
            '"point" under [grasp].')


def torque_slopes(model: BranchModel, grasp: Grasp, parameters: ParameterSet,
                  displacement: np.ndarray, slope: np.ndarray, about: np.ndarray) -> np.ndarray:
    """Return the slopes [3, p] of the gripper's torque [N m] about a fixed point, from nodes
    displaced [n, 3] [m] and their slopes [n, 3, p]."""
    held = grasp.nodes
    arm = model.mesh.nodes[held] + displacement[held] - about
    columns = []
    for column, partial in enumerate(explicit_forces(model, parameters, displacement)):
        out = partial + model.tangent_times(displacement, np.ascontiguousarray(slope[..., column]))
        columns.append(np.cross(arm, out[held]).sum(axis=0))
    return np.array(columns).T


SETTINGS = StaticSettings(tolerance=1e-8, total_iterations=200, way_back=False, keeps_factor=True)
NEAR = replace(SETTINGS, total_iterations=40, snap=False)
"""From a state near a recorded path: without equilibrium nearby, the branch folds or snaps away."""
ITERATIONS_A_KEY, ITERATIONS_FROM_REST = 12, 40
"""Most iterations of a simulation per simulated frame, and in addition if no state is known yet.
Branches that did not fold needed at most 12 until the force had settled, 4 in one simulation;
folding ones hundreds. So a simulation that fails costs about as much as three that do not.
"""
FEW_KEYS = 4
"""Frames that show the difference of two pulls: with 4, 6 and 12, moduli agreed to 1.5 %."""
YOUNG_STEP_LIMIT = 0.7
"""Largest change of a log E for which a state is extrapolated by its derivative; chosen."""


@dataclass
class _Memory:
    """State of one key frame under the last parameters: the start of the next solve."""

    result: StaticResult
    slope: np.ndarray | None = None

    @property
    def displacement(self) -> np.ndarray:
        return self.result.displacement


@dataclass(frozen=True)
class Lumping:
    """Twigs that are not meshed: the largest relative change by that of the linear response of
    grasps and points to the grippers' forces, how the mesh's shape carries their weight (None:
    weightless), and the twigs."""

    error: float
    weight: CarriedWeight | None
    twigs: Sequence[HungTwig]


class QuasiStaticForward(base.Forward):
    """Simulates one pull in equilibrium, at most at ``key_count`` frames. Their states are kept:
    parameters change little, so two Newton steps are enough. ``weights`` [tet_count, K] map moduli
    to tetrahedra, unless ``field`` does."""

    lumping: Lumping | None = None
    """What is not in the mesh. None: nothing."""

    def __init__(self, name: str, model: BranchModel, weights: np.ndarray, entry: PullEntry,
                 frames: Frames, rest_points: np.ndarray, *, key_count: int = 12,
                 field: YoungField | None = None):
        super().__init__(name, model, weights, entry, frames, rest_points, field)
        measured = np.isfinite(frames.wrenches[:, :3]).all(axis=1)
        if self.drive == "force" and measured.sum() < 2:
            raise InputError(f"{name} has no measured force for a force-driven simulation.",
                             "Nothing would pull the branch.",
                             "Use ", Option("drive", "pose"), ", or record the force.")
        if self.drive == "force" and entry.grasp.mode == "rigid":
            require_torque(name, entry, frames)
        self.uses_torque = uses_torque(entry, frames)
        self.spread = np.empty((len(frames), 0))
        self._memory: list[_Memory | None] = []
        self._last: tuple | None = None
        self.iteration_count = 0
        self.set_key_count(key_count)

    def set_key_count(self, count: int) -> None:
        """Simulate at most ``count`` frames from now on; more if the force needs them."""
        frames, earlier = self.frames, self.spread
        states = [memory.displacement for memory in self._memory if memory is not None]
        self._course: base.Course | None = None
        self.response = None
        if self.drive == "pose":
            self._along = base.travel(frames.poses)
            self.keys, self.spread = base.key_frames(self._along, count)
            self._drives = [pose_on(self.grasp, self.entry.grasp, pose)
                            for pose in frames.poses[self.keys]]
        else:
            components = 6 if self.uses_torque else 3
            sigma = base.wrench_sigma(self.entry, frames, components)
            self._course = base.course_of(frames, sigma, count, components,
                                     self.pose_sigma if self.watches_pose else np.inf)
            self._along = frames.times
            self.keys, self.spread = self._course.keys, self._course.spread
            self._measured = self._course.values
            self._drives = list(self._measured)
            self._loads = [self._loads_at(key) for key in self.keys]
        self._memory = [None] * len(self.keys)
        self._values: Values | None = None
        # The requested states are between known ones.
        self._hints: list[np.ndarray] | None = list(np.tensordot(
            earlier[self.keys], states, axes=1)) if states else None

    def refine(self) -> None:
        self.set_key_count(2 * self.key_count)

    @property
    def key_count(self) -> int:
        return len(self.keys)

    @property
    def iteration_limit(self) -> int:
        """Iterations after which a simulation counts as failed."""
        from_rest = any(memory is None for memory in self._memory)
        return ITERATIONS_A_KEY * len(self.keys) + (ITERATIONS_FROM_REST if from_rest else 0)

    @property
    def mesh(self) -> TetMesh:
        return self._model.mesh

    @property
    def model(self) -> BranchModel:
        """The branch under its weight, with the initial values."""
        return self._model

    def simulate(self, values: Values, extra: tuple[str, ...], sensitivities: bool,
                 ) -> base.Simulated | None:
        is_asked = (sensitivities or self.watches_pose) and self.response is None and (
            self.has_force_unknowns)
        self.iteration_count, self.work = 0, 0.0
        # What changes the model or the drives replaces these objects.
        if self._last is not None and not is_asked and equal_values(self._values, values):
            model, drives, names, known = self._last
            if (model is self._model and drives is self._drives
                    and self.uses_torque == (known.torques is not None)
                    and (not sensitivities or (names == extra and known.slopes is not None))):
                return known
        model = self.model_with(values)
        jump = None if self._values is None else np.log(values.young) - np.log(self._values.young)
        size = len(self.keys), len(self.rest_points), self.uses_torque
        found, slopes = base.Simulated.empty(*size), base.Simulated.empty(
            *size, len(values.young) + len(extra))
        states: list[_Memory | None] = []
        before: np.ndarray | None = None
        compliances: list[np.ndarray] = []
        for key, memory in enumerate(self._memory):
            is_known = memory is not None and equal_values(self._values, values)
            result = memory.result if memory is not None and is_known else self._solved(
                model, key, jump, before)
            if result is None:
                return None
            before = result.displacement
            # An old derivative still predicts most of a small change.
            slope = None if memory is None else memory.slope
            self._enter(found, key, result)
            # While the factorisation of this state is available.
            if is_asked:
                compliances.append(base.compliance(model, before, self._loads[key]))
            if sensitivities:
                slope = self._enter_slopes(slopes, key, model, values, extra, result)
            states.append(_Memory(result, slope))
        self._memory, self._values, self._hints = states, values, None
        if self._directions is not None:
            self.point_directions = np.tensordot(self.spread, [
                self._directions.bent(state.displacement) for state in self.states()], axes=1)
        if is_asked:
            self.response = self._response(compliances)
        found = replace(found, grasps=self._grasps(), slopes=replace(
            slopes, grasps=self._grasp_slopes()) if sensitivities else None)
        found = found.each(lambda at_keys: np.tensordot(self.spread, at_keys, axes=1))
        self._last = (self._model, self._drives, extra, found)
        return found

    def _enter(self, found: base.Simulated, key: int, result: StaticResult) -> None:
        drive = self._drives[key]
        found.positions[key] = self.rest_points + self._observed(result.displacement)
        found.forces[key] = result.reaction_force if self.drive == "pose" else drive[:3]
        if found.torques is not None and self.drive == "force":
            found.torques[key] = drive[3:]
        elif found.torques is not None:
            # About the recorded grasp point, which differs from the patch's centre.
            arm = drive[:3] - self.frames.poses[self.keys[key], :3]
            found.torques[key] = result.reaction_torque + np.cross(arm, result.reaction_force)

    def _enter_slopes(self, found: base.Simulated, key: int, model: BranchModel, values: Values,
                      extra: tuple[str, ...], result: StaticResult) -> np.ndarray | None:
        """Enter the derivatives; return that of the displacement [n, 3, p], if it is known."""
        slope, found.forces[key] = self._slopes(model, values, extra, result)
        for column in range(slope.shape[-1]):
            found.positions[key, ..., column] = self._observed(slope[..., column])
        if found.torques is not None:
            names = ParameterSet(mechanics_names(extra), shares=self.field.shares(values, extra))
            found.torques[key] = 0.0 if self.drive == "force" else torque_slopes(
                model, self.grasp, names, result.displacement, slope,
                self.frames.poses[self.keys[key], :3])
        return slope

    def _grasps(self) -> np.ndarray | None:
        """The grasp point at the key frames, if it is compared."""
        return None

    def _grasp_slopes(self) -> np.ndarray | None:
        """Its derivatives."""
        return None

    @property
    def force_is_stated(self) -> bool:
        return self._course is not None and self._course.exact

    @property
    def has_force_unknowns(self) -> bool:
        return self._course is not None and not self._course.exact

    def shift_force(self, change: np.ndarray) -> None:
        steps = change.reshape(len(self.keys), -1)
        self._drives = [drive + step for drive, step in zip(self._drives, steps, strict=True)]
        self._hints = [state.displacement + np.tensordot(step, moved, axes=1)
                       for state, step, moved in zip(self.states(), steps, self._compliances,
                                                     strict=True)]
        self._values, self.response = None, None

    def _off_readings(self) -> np.ndarray:
        return (self._measured - np.array(self._drives)).ravel()

    def _response(self, compliances: list[np.ndarray]) -> base.Simulated:
        self._compliances = compliances
        return base.response_of(self.spread, np.array(
            [[self._observed(moved) for moved in each] for each in compliances]))

    def _loads_at(self, frame: int) -> np.ndarray:
        return base.nodal_loads(self.grasp, self.entry.grasp, self.frames.poses[frame],
                           self._model.mesh.nodes, 6 if self.uses_torque else 3)

    def load_at(self, key: int) -> np.ndarray:
        """Return the load of a key frame: a pose [m, rad], or nodal forces [N]."""
        drive = self._drives[key]
        return drive if self.drive == "pose" else np.tensordot(drive, self._loads[key], axes=1)

    def aside(self, nodes: np.ndarray) -> "QuasiStaticForward":
        """Return the same pull with moved nodes [n, 3] [m]: gripper, material and hanging stay."""
        other = copy.copy(self)
        model = self._model.with_rest_nodes(nodes)
        if self._model.prestress is not None:
            model = model.as_scanned()
            if self.lumping is not None and self.lumping.weight is not None:
                # Its change with the shape is left out: a part of a small part.
                known = present(model.prestress, "prestress")
                model.prestress = replace(known, own=known.own + self.lumping.weight)
        other._model = model
        other.grasp = self.grasp.elsewhere(other.mesh, np.array(self.entry.grasp.point_m))
        if self.drive == "pose":
            other._drives = [pose_on(other.grasp, self.entry.grasp, pose)
                             for pose in self.frames.poses[self.keys]]
        else:
            other._loads = [other._loads_at(key) for key in self.keys]
        return other

    def with_hung_mass(self, factor: float) -> "QuasiStaticForward":
        """Return the same pull with all added masses ``factor`` times as heavy."""
        other = copy.copy(self)
        other._model = self._model.with_hung_mass(factor)
        return other

    def with_longer_grip(self, length: float) -> "QuasiStaticForward":
        """Return the same pull with a clamped grasp longer by ``length`` [m] on both sides."""
        other = copy.copy(self)
        if self.grasp.held is not None:
            held = self.entry.grasp
            other._model = self._model.gripped(self.grasp.holding(
                self.mesh, np.array(held.point_m), held.radius_m + length))
        return other

    def grasp_position(self, displacement: np.ndarray) -> np.ndarray:
        """Position of the recorded grasp point [m], shape [3]."""
        return point_of(self.grasp, self.entry.grasp,
                        self.grasp.pose_of(self.mesh.nodes, displacement))

    def with_prescribed_poses(self, poses: np.ndarray) -> "QuasiStaticForward":
        made = type(self)(self.name, self._model, self.weights, self.entry,
                          replace(self.frames, poses=poses), self.rest_points,
                          key_count=FEW_KEYS, field=self.field)
        made.lumping, made.creep_time = self.lumping, self.creep_time
        made.begin_at(self)
        return made

    def begin_at(self, other: "QuasiStaticForward") -> None:
        """Start from states and force of another simulation of this pull with as many nodes."""
        if self.has_force_unknowns:
            self._drives = list((other.spread @ np.array(other._drives))[self.keys])
        states = other.displacements()
        if len(states) == other.key_count:
            self.hint(list(np.tensordot(other.spread[self.keys], states, axes=1)))

    def hint(self, displacements: list[np.ndarray] | None) -> None:
        """Start the next simulation from these displacements [m] of the key frames; None: rest."""
        self._hints = displacements

    def states(self) -> list[_Memory]:
        """The states of all key frames, all simulated, under the last parameters."""
        return [present(memory, "state of a key frame") for memory in self._memory]

    def displacements(self) -> list[np.ndarray]:
        """Nodal displacements [m] of the key frames under the last parameters."""
        return [memory.displacement for memory in self._memory if memory is not None]

    def thinning_error(self, values: Values) -> float:
        """Largest distance [m] between spline and simulation halfway between key frames."""
        if len(self.keys) >= len(self.frames) or len(self.keys) < 4:
            return 0.0
        known = self.simulate(values, (), False)
        if known is None:
            raise WorkError(f"{self.name}: the simulation finds no equilibrium at the end of the "
                            "fit.", "It was found from another state during the fit.",
                            "Omit ", Option("quick"), ", or use fewer control points (",
                            Option("fractions"), ").")
        states = [state.displacement for state in self.states()]
        if (middle := self._least_known()) is None:
            return 0.0
        result = self._solve(self.model_with(values), self._load_between(middle),
                             np.tensordot(self.spread[middle], states, axes=1))
        exact = known.positions[middle] if result is None else (
            self.rest_points + self._observed(result.displacement))
        return float(np.linalg.norm(exact - known.positions[middle], axis=1).max())

    def _least_known(self) -> int | None:
        """The frame halfway between those two key frames that a spline through the others foretells
        worst; None: every frame is one."""
        seen = np.array([self._observed(state.displacement).ravel() for state in self.states()])
        at, off = self._along[self.keys], np.zeros(len(self.keys))
        for key in range(1, len(at) - 1):
            others = scipy.interpolate.CubicSpline(np.delete(at, key), np.delete(seen, key, 0))
            off[key] = np.linalg.norm(others(at[key]) - seen[key])
        off[[0, -1]] = off[[1, -2]]
        return max(((off[k] + off[k + 1], int(first + second) // 2) for k, (first, second) in
                    enumerate(zip(self.keys[:-1], self.keys[1:], strict=True))
                    if second - first > 1), default=(0.0, None))[1]

    def _load_between(self, frame: int) -> np.ndarray:
        if self.drive == "pose":
            return pose_on(self.grasp, self.entry.grasp, self.frames.poses[frame])
        return np.tensordot(self.spread[frame] @ np.array(self._drives), self._loads_at(frame),
                            axes=1)

    def _observed(self, displacement: np.ndarray) -> np.ndarray:
        return (self._operator @ displacement.ravel()).reshape(-1, 3)

    def _solve(self, model: BranchModel, drive: np.ndarray, start: np.ndarray | None,
               left: float = np.inf) -> StaticResult | None:
        """Return the equilibrium, or None; after ``left`` iterations there is none."""
        loads = ({"grasp": self.grasp, "pose": drive} if self.drive == "pose"
                 else {"nodal_forces": drive})
        settings = NEAR if self.watches_pose and start is not None else SETTINGS
        result = solve_static(model, start=start, settings=replace(
            settings, total_iterations=min(settings.total_iterations, left)), **loads)
        self.iteration_count += result.iterations
        # It begins with a step along the tangent, and ends with a test of stability.
        self.work += float(self.mesh.tet_count * (result.iterations + 2))
        return result if result.converged else None

    def _solved(self, model: BranchModel, key: int, jump: np.ndarray | None,
                before: np.ndarray | None) -> StaticResult | None:
        memory, drive = self._memory[key], self.load_at(key)
        starts: list[np.ndarray | None] = [] if self._hints is None else [self._hints[key]]
        if memory is not None:
            start = memory.displacement
            if (memory.slope is not None and jump is not None and not self.watches_pose
                    and np.abs(jump).max() < YOUNG_STEP_LIMIT):
                start = start + memory.slope[..., :len(jump)] @ jump
            starts.append(start)
        starts += [before] if before is not None else []
        starts += [] if starts and self.watches_pose else [None]
        for begin in starts:
            left = self.iteration_limit - self.iteration_count
            if left <= 0:
                break
            try:
                result = self._solve(model, drive, begin, left)
            except NotPositiveDefiniteError:
                continue
            if result is not None:
                return result
        return None

    def _slopes(self, model: BranchModel, values: Values, extra: tuple[str, ...],
                result: StaticResult) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of displacement [n, 3, p] and reaction [3, p]."""
        found = static_sensitivities(
            model, result, self.grasp, None, mechanics_names(extra),
            is_held=self.drive == "pose", shares=self.field.shares(values, extra))
        return found.displacement, found.reaction_force


# A fast pull, simulated over time with inertia and damping.

class DynamicForward(base.Forward):
    """Simulates one pull by Newmark steps. Arguments as for
    :class:`limber.estimation.forward.solved_pull.QuasiStaticForward`. Every frame is simulated."""

    is_dynamic = True

    def __init__(self, name: str, model: BranchModel, weights: np.ndarray, entry: PullEntry,
                 frames: Frames, rest_points: np.ndarray, *, field: YoungField | None = None):
        super().__init__(name, model, weights, entry, frames, rest_points, field)
        measured = np.isfinite(frames.wrenches[:, :3]).all(axis=1)
        if entry.drive == "force" and not measured.all():
            raise InputError(f"{name}: {np.sum(~measured)} frames have no force.",
                             "A force-driven motion needs the force in every frame.",
                             "Use ", Option("drive", "pose"), ".")
        if self.drive == "force" and entry.grasp.mode == "rigid":
            raise InputError(
                f"{name}: the force of a clamped gripper drives a dynamic simulation.",
                "A clamped gripper also bends the branch by a torque, but only a force can drive "
                "a dynamic simulation.",
                "Use ", Option("drive", "pose"), ". If the branch could turn in the gripper, set "
                'mode = "point" under [grasp] in pull.toml.')
        self._forces = frames.wrenches[:, :3]
        self._arguments = (name, model, weights, entry)
        steps = np.ceil(np.diff(frames.times) / NewmarkSettings().max_step).sum()
        self.work = float(model.mesh.tet_count * steps)
        # Only the nodes that determine the observed points need derivatives.
        self._nodes = np.unique(self._operator.indices // 3)
        columns = (3 * self._nodes[:, None] + np.arange(3)).ravel()
        self._near = self._operator[:, columns]

    @property
    def has_force_unknowns(self) -> bool:
        return self.drive == "force"

    def simulate(self, values: Values, extra: tuple[str, ...], sensitivities: bool,
                 ) -> base.Simulated | None:
        model = self.model_with(values)
        frames, by_pose = self.frames, self.drive == "pose"
        drive = ({"poses": np.array([pose_on(self.grasp, self.entry.grasp, pose)
                                     for pose in frames.poses])} if by_pose
                 else {"grasp_forces": self._forces})
        parameters = ParameterSet(mechanics_names(extra), shares=self.field.shares(values, extra))
        asked = {"sensitivities": parameters,
                 "sensitivity_nodes": self._nodes} if sensitivities else {}
        # The same scheme with and without derivatives: one loss, one minimum.
        result = simulate_dynamics(model, grasp=self.grasp, times=frames.times,
                                   settings=NewmarkSettings(), **drive, **asked)
        if not result.converged:
            return None
        moved = (self._operator @ result.displacement.reshape(len(frames), -1).T).T
        positions = self.rest_points + moved.reshape(len(frames), -1, 3)
        if self._directions is not None:
            self.point_directions = np.array([self._directions.bent(each)
                                              for each in result.displacement])
        forces = result.reaction_force if by_pose else self._forces
        if not sensitivities:
            return base.Simulated(positions, forces)
        if self.response is None and not by_pose:
            self.response = self._response(model)
        slopes = present(result.sensitivities, "derivative of the motion")
        count = slopes.displacement.shape[-1]
        # Damping enters the fit by its logarithm.
        scale = np.array([*np.ones(len(values.young)), *(
            {"alpha": values.damping[0], "beta": values.damping[1]}.get(name, 1.0)
            for name in extra)])
        flat = slopes.displacement.reshape(len(frames), -1, count)
        d_positions = np.stack([(self._near @ frame).reshape(-1, 3, count) for frame in flat])
        d_forces = slopes.reaction_force if by_pose else np.zeros((len(frames), 3, count))
        return base.Simulated(positions, forces, slopes=base.Simulated(d_positions * scale,
                                                             d_forces * scale))

    def until(self, count: int) -> "DynamicForward":
        """Return the first frames, driven by force if known: on a prescribed path wrong moduli give
        a thousandfold force, under a force the branch merely moves too far."""
        name, model, weights, entry = self._arguments
        measured = np.isfinite(self.frames.wrenches[:, :3]).all()
        if measured and entry.grasp.mode == "point":
            entry = entry.model_copy(update={"drive": "force"})
        return DynamicForward(name, model, weights, entry, self.frames[:count], self.rest_points,
                              field=self.field)

    def with_prescribed_poses(self, poses: np.ndarray) -> "DynamicForward":
        name, model, weights, entry = self._arguments
        return DynamicForward(name, model, weights, entry, replace(self.frames, poses=poses),
                              self.rest_points, field=self.field)

    def shift_force(self, change: np.ndarray) -> None:
        self._forces = self._forces + change.reshape(-1, 3)
        self.response = None

    def _off_readings(self) -> np.ndarray:
        return (self.frames.wrenches[:, :3] - self._forces).ravel()

    def _response(self, model: BranchModel) -> base.Simulated:
        loads = base.nodal_loads(self.grasp, self.entry.grasp, self.frames.poses[0],
                            model.mesh.nodes, 3)
        count = len(self.frames)
        points = base.motion_response(model, loads, self._operator, self.frames.times)
        return base.Simulated(points, np.eye(3 * count).reshape(count, 3, 3 * count))
