"""A slow pull with an uncertain gripper path: the force is prescribed, the path is observed.

If the prescribed poses have an error of a millimetre, a slender branch is stretched. The error of
its force follows from its axial stiffness, a thousand times that of bending, and the moduli are
wrong with it. The same pull can be driven by its force, an unknown function of time with readings
as observations (see :mod:`limber.estimation.forward.forward_model`), and the recorded positions of
the gripper are
observations like the points, with the uncertainty of the gripper's frame. A branch responds softly
to an error of force, so the problem is well conditioned, and the more informative of force and path
has more weight.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import scipy

from limber.core.errors import WorkError
from limber.core.not_none import present
from limber.core.numerics.rigid import any_normal, principal_axes, rotation_matrix
from limber.core.progress import SILENT, Progress
from limber.estimation.forward.forward_model import Simulated, compliance
from limber.estimation.forward.solved_pull import FEW_KEYS, QuasiStaticForward
from limber.estimation.parameters import Values, equal_values, mechanics_names
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.dynamics.integration import NewmarkSettings, simulate_dynamics
from limber.mechanics.dynamics.motion import DynamicResult
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.mechanics.points import point_operator
from limber.mechanics.sensitivities import ParameterSet, explicit_forces
from limber.mechanics.statics.result import StaticResult
from limber.mechanics.statics.solve import StaticSettings, solve_static

# Path of a gripper in a virtual pull: that of the branch when it is pulled sideways.
#
# Slow pulls follow that path once. Fast ones shake the branch along it, or pull and release it. A
# hung weight needs no path.
#
# A path drawn in space would compress a branch (it buckles) or stretch it (it tears), because its
# length is fixed and its bending is not known beforehand. A hand feels that and yields. Here the
# true branch is pulled by a force that grows and turns, and the motion of the grasp is the path.

SETTINGS = StaticSettings(tolerance=1e-8)
_FORCES = 20
"""Most forces that are tried for a travel."""
_TRIAL = StaticSettings(total_iterations=100, way_back=False)
"""An equilibrium under a force takes some tens of iterations; a branch that folds, hundreds."""
TURNED_PART = 0.7
"""Fraction of the free rotation that a clamping gripper allows."""
WAY_STATES = 12
"""Number of static states that define the path of a shaken gripper."""
SHAKES = 2.0
"""Number of oscillations of a shaken gripper."""


@dataclass(frozen=True)
class MotionWanted:
    """Requested motion of a virtual gripper from ``point`` [m]; ``axis`` is from base to grasp.

    Attributes:
        kind: ``pull`` (slow, the branch turns freely), ``turned`` (slow, rotation restrained),
            ``shake`` (fast, along the path of a pull), ``release`` (fast, pulled by force and let
            go), ``weight`` (a growing weight hangs on the grasp).
        turn, phase: See :func:`sideways_forces`.
        weight: The largest weight's force [N], shape [3].
    """

    kind: Literal["pull", "turned", "shake", "release", "weight"]
    point: np.ndarray
    axis: np.ndarray
    travel: float
    turn: float
    phase: float
    times: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class MotionMade:
    """The motion at each time: poses of the grasp point [n, 6] [m, rad], wrenches on the branch [n,
    6], torque about the pose, and displacements [node_count, 3] [m]."""

    poses: np.ndarray
    wrenches: np.ndarray
    displacements: list[np.ndarray]


def seen_at(points: np.ndarray, mesh: TetMesh, displacements: Sequence[np.ndarray]) -> np.ndarray:
    """Return the places [n, m, 3] of points [m, 3] that move with a mesh [m]."""
    operator = point_operator(mesh, points)
    return np.array([points + (operator @ each.ravel()).reshape(-1, 3) for each in displacements])


def moved(model: BranchModel, grasp: Grasp, requested: MotionWanted, *,
          progress: Progress = SILENT) -> MotionMade:
    """Move a branch as requested. WorkError if no force moves the grasp that far, or the motion
    cannot be computed."""
    count = len(requested.times)
    if requested.kind == "weight":
        share = np.linspace(0.0, 1.0, count)
        return _slow(model, grasp, requested, share[:, None] * requested.weight, progress)
    if requested.kind == "release":
        return _released(model, grasp, requested, progress)
    states = WAY_STATES if requested.kind == "shake" else count
    directions = sideways_forces(requested.axis, states, turn=requested.turn, phase=requested.phase)
    size = force_for_travel(model, grasp, directions[-1], requested.travel)
    slow = _slow(model, grasp, requested, size * directions, progress)
    if requested.kind == "pull":
        return slow
    if requested.kind == "shake":
        return _shaken(model, grasp, requested, slow, progress)
    poses = slow.poses * np.r_[np.ones(3), np.full(3, TURNED_PART)]
    held = _about_centre(grasp, requested.point, poses)
    results, start = [], None
    for pose in held:
        results.append(solve_static(model, grasp=grasp, pose=pose, start=start,
                                    settings=SETTINGS).require())
        start = results[-1]
    forces = np.array([result.reaction_force for result in results])
    torques = np.array([result.reaction_torque for result in results])
    return _made(poses, held, forces, torques, [result.displacement for result in results])


def _slow(model: BranchModel, grasp: Grasp, requested: MotionWanted, forces: np.ndarray,
          progress: Progress) -> MotionMade:
    """Equilibria under forces of the gripper that exert no torque on the branch."""
    displacements, start = [], None
    for index, force in enumerate(forces):
        progress(index / len(forces), "pulling", frame=index)
        start = solve_static(model, grasp=grasp, grasp_force=force, start=start,
                             settings=SETTINGS).require()
        displacements.append(start.displacement)
    poses, centres = _poses(model, grasp, requested.point, displacements)
    return _made(poses, centres, forces, np.zeros_like(forces), displacements)


def _shaken(model: BranchModel, grasp: Grasp, requested: MotionWanted, path: MotionMade,
            progress: Progress) -> MotionMade:
    """Out within a quarter of the time, back and forth over half the path, then at rest."""
    share = requested.times / requested.times[-1]
    out = np.clip(share / 0.25, 0.0, 1.0)
    swing = np.clip((share - 0.25) / 0.5, 0.0, 1.0)
    along = out**2 * (3 - 2 * out) * (0.75 + 0.25 * np.cos(2 * np.pi * SHAKES * swing))
    poses = scipy.interpolate.CubicSpline(np.linspace(0.0, 1.0, len(path.poses)), path.poses)(along)
    held = _about_centre(grasp, requested.point, poses)
    result = simulate_dynamics(model, grasp=grasp, poses=held, times=requested.times,
                               settings=NewmarkSettings(), progress=progress)
    _require(result)
    return _made(poses, held, result.reaction_force, result.reaction_torque,
                 list(result.displacement))


def _released(model: BranchModel, grasp: Grasp, requested: MotionWanted,
              progress: Progress) -> MotionMade:
    """A force that grows over a third of the time and is removed within a frame."""
    direction = sideways_forces(requested.axis, 2, turn=0.0, phase=requested.phase)[-1]
    size = force_for_travel(model, grasp, direction, requested.travel)
    share = requested.times / requested.times[-1]
    ramp = np.clip(share / 0.3, 0.0, 1.0)
    forces = (ramp**2 * (3 - 2 * ramp) * (share < 0.4))[:, None] * size * direction
    result = simulate_dynamics(model, grasp=grasp, grasp_forces=forces, times=requested.times,
                               settings=NewmarkSettings(), progress=progress)
    _require(result)
    displacements = list(result.displacement)
    poses, centres = _poses(model, grasp, requested.point, displacements)
    return _made(poses, centres, forces, np.zeros_like(forces), displacements)


def _require(result: DynamicResult) -> None:
    if not result.converged:
        raise WorkError("The motion of the simulated branch cannot be computed.",
                        "It is too fast or too far for this branch.",
                        "Reduce the reach, or increase the duration.")


def _poses(model: BranchModel, grasp: Grasp, point: np.ndarray,
           displacements: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Poses of the grasp point, which moves with the patch, and of the patch's centre."""
    centres = np.array([grasp.pose_of(model.mesh.nodes, displacement)
                        for displacement in displacements])
    if grasp.mode == "point":
        # Held by its weighted mean: the position of the point, whatever the rotation.
        poses = centres.copy()
        poses[:, :3] += point - grasp.centre
        return poses, centres
    poses = centres.copy()
    for pose in poses:
        pose[:3] += rotation_matrix(pose[3:]) @ (point - grasp.centre)
    return poses, centres


def _about_centre(grasp: Grasp, point: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Poses of the patch's centre for those of the grasp point."""
    held = poses.copy()
    for pose in held:
        turn = rotation_matrix(pose[3:]) if grasp.mode == "rigid" else np.eye(3)
        pose[:3] += turn @ (grasp.centre - point)
    return held


def _made(poses: np.ndarray, held: np.ndarray, forces: np.ndarray, torques: np.ndarray,
          displacements: list[np.ndarray]) -> MotionMade:
    torques = torques + np.cross(held[:, :3] - poses[:, :3], forces)
    return MotionMade(poses, np.hstack([forces, torques]), displacements)


def sideways_forces(axis: np.ndarray, frame_count: int, *, turn: float, phase: float,
                    ) -> np.ndarray:
    """Return forces [n, 3] across ``axis`` (base to grasp) that grow from 0 to 1 N and rotate by
    ``turn`` [rad] from ``phase`` [rad]."""
    axis = axis / np.linalg.norm(axis)
    first = any_normal(axis)
    second = np.cross(axis, first)
    share = np.linspace(0.0, 1.0, frame_count)
    # Speed ramps up and down as a robot's does.
    eased = 0.35 * share * share * (3 - 2 * share) + 0.65 * share
    angle = phase + turn * eased
    return eased[:, None] * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second)


def force_for_travel(model: BranchModel, grasp: Grasp, direction: np.ndarray, travel: float,
                     ) -> float:
    """Return the factor of ``direction`` [N] that moves the grasp by ``travel`` [m], to 3 %.
    WorkError if there is no such factor, or the branch does not carry its own weight."""
    rest = solve_static(model).require().displacement
    load = np.zeros_like(rest)
    load[grasp.nodes] = grasp.weights[:, None] * direction
    response = compliance(model, rest, load[None])[0]
    slope = float(np.linalg.norm(grasp.weights @ response[grasp.nodes]))
    if not slope > 0:
        raise WorkError("No sideways force moves the grasp.", "It is where the branch is held.",
                        "Hold the branch farther out.")
    size, near, distance = travel / slope, None, 0.0
    low, high, longest = 0.0, np.inf, 0.0
    for _ in range(_FORCES):
        result = solve_static(model, grasp=grasp, grasp_force=size * direction, start=near,
                              settings=_TRIAL)
        if result.converged:
            shift = grasp.weights @ (result.displacement - rest)[grasp.nodes]
            distance = float(np.linalg.norm(shift))
            if abs(distance - travel) < 0.03 * travel:
                return size
        if result.converged and distance < travel:
            low, near, longest = size, result, max(longest, distance)
        else:
            # Beyond its last equilibrium a branch folds: there is less force, not more travel.
            high = size
        if high - low < 0.01 * high:
            break
        if not result.converged:
            size = (low + high) / 2
        elif np.isinf(high):
            # Bent, the branch stiffens.
            size *= np.clip(travel / max(distance, 1e-12), 1.2, 3.0)
        else:
            size = np.clip(size * travel / distance, low + 0.1 * (high - low),
                           high - 0.1 * (high - low))
    raise WorkError(
        f"No sideways force moves the grasp by {travel:.3g} m.",
        f"With the largest force for which an equilibrium was found, it moves {longest:.3g} m. "
        "Farther out the branch would fold, or it is too short or too stiff at the grasp.",
        "Pull less far.")


AT_REST_M = 5e-3
"""Distance of a first pose from the grasp point below which the branch is at rest; the sensor's
reading is then its zero.
"""
TANGENT_RADII = 4.0
SAME_RESPONSE = 0.02
"""Change over the branch's size below which the response to its force is unchanged."""


class ObservedPathForward(QuasiStaticForward):
    """Simulates one pose-recorded pull by its force; arguments as for its base class."""

    _drives_for: Values | None = None
    """Values for which the force was last found."""
    _good: tuple | None = None
    """Stored force with its values, states and response."""

    @property
    def drive(self) -> str:
        return "force"

    @property
    def watches_pose(self) -> bool:
        return True

    def __init__(self, *arguments: Any, **options: Any):
        self._held_slopes: dict[int, np.ndarray] = {}
        super().__init__(*arguments, **options)

    def set_key_count(self, count: int) -> None:
        """As in the base class; a stored force is kept on the new key frames."""
        known = None if self._good is None else self.spread @ np.array(self._good[0])
        super().set_key_count(count)
        first = self.entry.grasp.point_m - self.frames.poses[0, :3]
        if known is not None:
            self._drives = list(known[self.keys])
        elif np.linalg.norm(first) < AT_REST_M:
            self._drives = [drive - self._measured[0] for drive in self._drives]
        self._read = self._drives
        self.keep()

    def simulate(self, values: Values, extra: tuple[str, ...], sensitivities: bool,
                 ) -> Simulated | None:
        known = self._drives_for
        if known is not None and not equal_values(known, values):
            # At the same positions the force is proportional to the stiffness.
            factor = np.exp(np.mean(np.log(values.young)) - np.mean(np.log(known.young)))
            self._drives = [drive * factor for drive in self._drives]
            self.response = None
        self._drives_for = values
        return super().simulate(values, extra, sensitivities)

    def begin_at(self, other: QuasiStaticForward) -> None:
        """As in the base class, and for the values for which the force was found."""
        super().begin_at(other)
        if isinstance(other, ObservedPathForward):
            self._drives_for = other._drives_for
            self.keep()

    def is_held_against_its_force(self, values: Values) -> bool:
        """Whether a clamp holds states that its force and torque alone would let go: a compressed
        branch buckles under them, though not between base and gripper."""
        if self.grasp.mode != "rigid":
            return False
        held = QuasiStaticForward(self.name, self._model, self.weights, self.entry, self.frames,
                                  self.rest_points, key_count=FEW_KEYS, field=self.field)
        if held.simulate(values, (), False) is None:
            return False
        model = held.model_with(values)
        return not all(model.equations(()).exact_tangent(model, state).is_positive_definite
                       for state in held.displacements())

    def begin_without(self, zero: np.ndarray) -> None:
        """Start from the readings less a zero at each frame, [f, 3] [N]."""
        self._drives = [np.r_[drive[:3] - off, drive[3:]]
                        for drive, off in zip(self._read, zero[self.keys], strict=True)]
        self.keep()

    def keep(self) -> None:
        """Store force and states; :meth:`step_back` returns to them."""
        self._good = (list(self._drives), self._drives_for, list(self._memory), self._values,
                      self.response)

    def step_back(self) -> None:
        """Return to the last stored force and states, if any."""
        if self._good is not None:
            drives, self._drives_for, memory, self._values, self.response = self._good
            self._drives, self._memory, self._hints = list(drives), list(memory), None

    def moved_by(self, change: np.ndarray) -> float:
        """Largest motion of the gripper position by a change of the force unknowns [m]."""
        response = present(self.response, "response of the pull to its force")
        moved = (response.grasps @ change).reshape(-1, 3)
        return float(np.linalg.norm(moved, axis=1).max())

    def shift_force(self, change: np.ndarray) -> None:
        response = self.response
        size = float(np.linalg.norm(np.ptp(self.mesh.nodes, axis=0)))
        is_small = self.moved_by(change) < SAME_RESPONSE * size
        super().shift_force(change)
        if is_small:
            self.response = response

    def is_settled_for(self, values: Values) -> bool:
        """Whether force and states are those of these values."""
        return equal_values(self._drives_for, values) and equal_values(self._values, values)

    def foresee(self, change: np.ndarray, values: Values) -> None:
        """Move the force by an expected change, for the next simulation with these values."""
        known = present(self._drives_for, "values of the known force")
        stiffer = np.mean(np.log(values.young) - np.log(known.young))
        before = self._drives
        self.shift_force(change)
        # What a stiffer branch takes to stay where it is does not move it.
        self._hints = [hint - np.tensordot(stiffer * drive, moved, axes=1) for hint, drive, moved
                       in zip(present(self._hints, "states"), before, self._compliances,
                              strict=True)]
        self._drives_for = values

    def _grasps(self) -> np.ndarray:
        states = self.states()
        self.grasp_tangent = self.spread @ np.array(
            [self._tangent(state.displacement) for state in states])
        return np.array([self.grasp_position(state.displacement) for state in states])

    def _grasp_slopes(self) -> np.ndarray:
        return np.array([self._held_slopes[key] for key in range(self.key_count)])

    def _enter_slopes(self, found: Simulated, key: int, model: BranchModel, values: Values,
                      extra: tuple[str, ...], result: StaticResult) -> None:
        """Enter the derivatives by adjoints: few coordinates are observed, and the response to a
        load on one, zero at most nodes, is cheap and serves all parameters."""
        state, count = result.displacement, self._operator.shape[0]
        loads = np.zeros((count + 3, *state.shape))
        loads[:count] = self._operator.toarray().reshape(count, -1, 3)
        loads[count:, self.grasp.nodes] = self.grasp.position_rows(self.mesh.nodes, state)
        responses = model.equations(()).exact_tangent(model, state).solve_all(list(loads))
        changes = explicit_forces(model, ParameterSet(
            mechanics_names(extra), shares=self.field.shares(values, extra)), state)
        slopes = -np.reshape(responses, (count + 3, -1)) @ np.reshape(
            changes, (len(changes), -1)).T
        found.positions[key] = slopes[:count].reshape(-1, 3, len(changes))
        found.forces[key] = 0.0
        if found.torques is not None:
            found.torques[key] = 0.0
        self._held_slopes[key] = slopes[count:]

    def _response(self, compliances: list[np.ndarray]) -> Simulated:
        found = super()._response(compliances)
        at_keys = np.array([self.grasp.position_slopes(
            self.mesh.nodes, state.displacement, np.moveaxis(np.asarray(each), 0, -1)).T
            for state, each in zip(self.states(), self._compliances, strict=True)])
        grasps = np.einsum("fk,kci->fikc", self.spread, at_keys)
        return replace(found, grasps=grasps.reshape(*grasps.shape[:2], -1))

    def _tangent(self, displacement: np.ndarray) -> np.ndarray:
        """Direction of the branch at the grasp, shape [3]: the longest extent of nearby nodes."""
        nodes = self.mesh.nodes
        away = np.linalg.norm(nodes - self.grasp.centre, axis=1)
        near = away < max(TANGENT_RADII * self.entry.grasp.radius_m, np.sort(away)[30])
        placed = nodes[near] + displacement[near]
        axis = principal_axes(placed)[0]
        outward = placed.mean(axis=0) - nodes[self._model.fixed].mean(axis=0)
        return axis * np.sign(axis @ outward or 1.0)


