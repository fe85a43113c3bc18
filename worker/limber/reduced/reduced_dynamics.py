"""Motion of the reduced model: implicit Newmark steps of about a millisecond.

As in limber.mechanics.dynamics.integration: beta 1/4 and gamma 1/2, mass damping, and stiffness
damping by the rate of the Green-Lagrange strain, which in the reduced strain coordinates is
J q' exactly.
"""

import itertools
import time
from dataclasses import dataclass, field

import numpy as np
import scipy

from limber.core.errors import InputError
from limber.core.numerics.rigid import pose_between
from limber.core.progress import SILENT, Progress
from limber.mechanics.dynamics.integration import NewmarkSettings
from limber.mechanics.dynamics.pose_path import unwrapped
from limber.mechanics.grasp import check_pose
from limber.reduced.reduced_model import ReducedModel, ReducedState, solved_raised

_HALVINGS = 6
"""Of a step that fails, at most, where nobody waits for it."""
_NEAR = 1e-5
"""Next gain of energy over the energy from which Newton is taken to close in; chosen."""
_JUMP = 2e-3
"""Grasp's motion off its old velocity, as part of the extent, that a first step foresees: chosen,
not measured."""
_LIVE_HALVINGS = 3
"""The same where a frame is waited for: 8 steps of about a millisecond fit into one of 60 Hz."""
_NEWMARK = NewmarkSettings()


@dataclass
class ReducedMotionState:
    """One instant: coordinates, their velocity and acceleration, shape [size] each."""

    time: float
    coordinates: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


@dataclass(frozen=True)
class ReducedMotion:
    """A motion of the reduced model.

    Attributes:
        converged: Whether all frames were reached.
        times: [s], shape [frames].
        coordinates: Shape [frames, size]; displacements by ``ReducedModel.displacement_of``.
        strain_energy, kinetic_energy: [J], shape [frames].
        reaction_force, reaction_torque: Of the gripper on the branch [N, Nm], shape [frames, 3].
        step_seconds: Wall time of each step [s].
        iteration_count: Newton iterations in all.
    """

    converged: bool
    times: np.ndarray
    coordinates: np.ndarray
    strain_energy: np.ndarray
    kinetic_energy: np.ndarray
    reaction_force: np.ndarray
    reaction_torque: np.ndarray
    step_seconds: np.ndarray
    iteration_count: int
    last: ReducedMotionState
    message: str = ""
    warnings: list[str] = field(default_factory=list)


class ReducedStepper:
    """Steps the reduced model through time, driven at the grasp.

    Args:
        model: With the Young's modulus wanted.
        state: Where to start; a static state starts at rest.
        nodal_forces: Dead loads [N] besides gravity, shape [node_count, 3].
    """

    def __init__(self, model: ReducedModel, state: ReducedState | ReducedMotionState, *,
                 nodal_forces: np.ndarray | None = None,
                 settings: NewmarkSettings = _NEWMARK):
        self.model, self.settings = model, settings
        self.load = model.load if nodal_forces is None else model.load + model.load_of(
            nodal_forces)
        zero = np.zeros(model.size)
        self.state = state if isinstance(state, ReducedMotionState) else ReducedMotionState(
            0.0, state.coordinates.copy(), zero, zero.copy())
        self.pose = None if isinstance(state, ReducedMotionState) else state.pose
        self.iteration_count = 0
        self.out = zero.copy()

    @property
    def strain_energy(self) -> float:
        """Of the strain since the model's mesh [J]."""
        return self.model.strain_energy(self.state.coordinates)

    @property
    def energy(self) -> float:
        """Potential of strain and weight, as in StaticResult [J]."""
        q = self.state.coordinates
        return self.model.energy(q) - float(self.model.load @ q)

    @property
    def kinetic_energy(self) -> float:
        velocity = self.state.velocity
        return 0.5 * float(velocity @ self.model.mass @ velocity)

    def move(self, pose: np.ndarray, step: float) -> bool:
        """Step to a pose [m, rad] that is reached in ``step`` [s]; return whether it converged.

        The grasp's velocity is that of the straight way there, its acceleration 0: poses that
        come live, with noise, must not shake the branch by their second difference.
        """
        return self._move(check_pose(pose), step, _LIVE_HALVINGS)

    def _move(self, pose: np.ndarray, step: float, halvings: int) -> bool:
        held = self.model.held.at(pose)
        count = len(held)
        velocity = (held - self.state.coordinates[:count]) / step
        if self.step(held, velocity, np.zeros(count), step, foresee=True):
            self.pose = pose
            return True
        # A branch pressed on its axis buckles within the step: inertia tells shorter ones where.
        return halvings > 0 and self.pose is not None and all(
            self._move(goal, step / 2, halvings - 1)
            for goal in (pose_between(self.pose, pose, 0.5), pose))

    def begin(self, held_acceleration: np.ndarray) -> None:
        """Set the acceleration that a state at rest starts with when the grasp starts to move.

        Without it the first step would cost the motion its second order.
        """
        mass, count = self.model.mass, len(held_acceleration)
        _, force = self.model.energy_force(self.state.coordinates)
        right = (self.load - force)[count:] - mass[count:, :count] @ held_acceleration
        self.state.acceleration[:count] = held_acceleration
        self.state.acceleration[count:] = np.linalg.solve(mass[count:, count:], right)

    def step(self, held: np.ndarray, held_velocity: np.ndarray, held_acceleration: np.ndarray,
             step: float, *, foresee: bool = False) -> bool:
        """Take one Newmark step with the grasp coordinates given at its end.

        Args:
            foresee: Whether the first iteration takes a jump of the grasp into account: for
                motion that is not smooth.
        """
        model, old, settings = self.model, self.state, self.settings
        count = len(held)
        free = slice(count, None)
        by_rate = settings.gamma / (settings.beta * step)
        by_mass = 1 / (settings.beta * step**2)
        # Without the acceleration: that of the stiff coordinates swings from step to step.
        q = old.coordinates + step * old.velocity
        way = held - q[:count]
        jump: np.ndarray | None = way
        if not foresee or np.abs(way).max() <= _JUMP * model.extent:
            q[:count], jump = held, None
        viscous, massive = model.damping.stiffness, model.damping.mass
        mass_part = (by_mass + massive * by_rate) * model.mass[free, free]
        mass_coupling = (by_mass + massive * by_rate) * model.mass[free, :count]
        last = np.inf
        for _ in range(settings.max_iterations):
            moved = q - old.coordinates
            velocity = by_rate * moved + (1 - settings.gamma / settings.beta) * old.velocity \
                + step * (1 - settings.gamma / (2 * settings.beta)) * old.acceleration
            acceleration = by_mass * moved - old.velocity / (settings.beta * step) \
                - (1 / (2 * settings.beta) - 1) * old.acceleration
            velocity[:count], acceleration[:count] = held_velocity, held_acceleration
            energy, force, tangent = model.tangent(
                q, velocity=velocity if viscous else None, by_rate=by_rate)
            inertia = model.mass @ (acceleration + massive * velocity)
            # Lower triangle alone is filled: the columns of the grasp are whole below it.
            force, coupling = force.copy(), tangent[free, :count] + mass_coupling
            tangent = tangent[free, free] + mass_part
            self.out = force + inertia - self.load
            right = -self.out[free]
            if jump is not None:
                # The rest follows the grasp's jump along the tangent, not after it.
                right = right - (coupling - mass_coupling) @ jump
            change, _ = solved_raised(tangent, right)
            self.iteration_count += 1
            q[free] += change
            if jump is not None:
                q[:count] += jump
                jump = None
                continue
            gain = 0.5 * abs(float(right @ change))
            if not np.isfinite(gain):
                return False
            scale = max(energy, self.kinetic_energy, 1e-9)
            # Near the end Newton's next gain falls at least as this one did against the last.
            expected = gain * min(1.0, gain / last) if gain < _NEAR * scale else gain
            if expected <= settings.tolerance**2 * scale:
                velocity[free] += by_rate * change
                acceleration[free] += by_mass * change
                self.out[:count] += coupling.T @ change
                self.state = ReducedMotionState(old.time + step, q, velocity, acceleration)
                return True
            last = gain
        return False

    def reaction(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return force [N] and torque [Nm] of the gripper on the branch after the last step."""
        return self.model.wrench(pose, self.out)


def simulate_reduced(model: ReducedModel, *, poses: np.ndarray, times: np.ndarray,
                     start: ReducedState | ReducedMotionState | None = None,
                     nodal_forces: np.ndarray | None = None,
                     settings: NewmarkSettings = _NEWMARK,
                     progress: Progress = SILENT) -> ReducedMotion:
    """Move the grasp through poses in time; never raises for want of convergence.

    Args:
        poses: [m, rad], shape [frames, 6]; a cubic spline between, at rest in the beginning.
        times: [s], ascending, shape [frames].
        start: Default the equilibrium at the first pose.
    """
    times, poses = np.asarray(times, float), np.asarray(poses, float)
    if times.ndim != 1 or len(times) < 2 or not (np.diff(times) > 0).all():
        raise InputError("Times do not ascend.", "Each frame needs a later time.", "Sort them.")
    path = scipy.interpolate.CubicSpline(times, unwrapped(poses[:, None])[:, 0], axis=0,
                       bc_type=((1, np.zeros(6)), (2, np.zeros(6))))
    begin = start or model.solve_static(poses[0], nodal_forces=nodal_forces)
    stepper = ReducedStepper(model, begin, nodal_forces=nodal_forces, settings=settings)
    stepper.state.time = float(times[0])
    if not isinstance(begin, ReducedMotionState):
        stepper.begin(_held_at(model, path, float(times[0]))[2])
    rows, message = [_row(stepper, poses[0])], ""
    seconds: list[float] = []
    for number in range(1, len(times)):
        progress(number / len(times), "moving the reduced model", time=float(times[number]))
        pieces = max(1, int(np.ceil((times[number] - times[number - 1]) / settings.max_step
                                    - 1e-9)))
        reached = all(_spline_step(stepper, path, a, b, seconds)
                      for a, b in _pairs(times[number - 1], times[number], pieces))
        if not reached:
            message = f"the step to {times[number]:.4g} s did not converge"
            break
        rows.append(_row(stepper, path(times[number])))
    coordinates, strain, kinetic, force, torque = map(np.array, zip(*rows, strict=True))
    return ReducedMotion(not message, times[:len(rows)], coordinates, strain, kinetic, force,
                         torque, np.array(seconds), stepper.iteration_count, stepper.state, message)


def _pairs(first: float, second: float, pieces: int) -> list[tuple[float, float]]:
    cuts = np.linspace(first, second, pieces + 1)
    return list(itertools.pairwise(cuts))


def _spline_step(stepper: ReducedStepper, path: "scipy.interpolate.CubicSpline", first: float,
                 second: float, seconds: list[float], depth: int = 0) -> bool:
    began = time.perf_counter()
    held = _held_at(stepper.model, path, second)
    if stepper.step(*held, second - first):
        seconds.append(time.perf_counter() - began)
        return True
    middle = (first + second) / 2
    return depth < _HALVINGS and all(
        _spline_step(stepper, path, a, b, seconds, depth + 1)
        for a, b in ((first, middle), (middle, second)))


def _held_at(model: ReducedModel, path: "scipy.interpolate.CubicSpline", instant: float,
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grasp coordinates, velocity and acceleration on a path, by central differences."""
    small = 2e-5
    before, now, after = (model.held.at(path(instant + shift))
                          for shift in (-small, 0.0, small))
    return now, (after - before) / (2 * small), (before - 2 * now + after) / small**2


def _row(stepper: ReducedStepper, pose: np.ndarray) -> tuple:
    force, torque = stepper.reaction(pose)
    return (stepper.state.coordinates.copy(), stepper.strain_energy, stepper.kinetic_energy,
            force, torque)
