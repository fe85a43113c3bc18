"""A whole motion of the reduced model along a spline through poses, for comparison in benches."""

import itertools
import time
from dataclasses import dataclass, field

import numpy as np
import scipy

from limber.core.errors import InputError
from limber.core.progress import SILENT, Progress
from limber.mechanics.dynamics.drive import unwrapped
from limber.mechanics.dynamics.integration import NewmarkSettings
from limber.reduced.reduced_dynamics import ReducedMotionState, ReducedStepper
from limber.reduced.reduced_model import ReducedModel, ReducedState

_HALVINGS = 6
_NEWMARK = NewmarkSettings()


@dataclass(frozen=True)
class ReducedMotion:
    """A motion of the reduced model.

    Attributes:
        converged: Whether all frames were reached.
        times: [s], shape [frames].
        coordinates: Shape [frames, size]; displacements by ``ReducedModel.displacement_of``.
        strain_energy, kinetic_energy: [J], shape [frames].
        reaction_force, reaction_torque: Force and torque of the gripper on the branch [N, Nm],
        shape [frames, 3].
        step_seconds: Wall time of each step [s].
        iteration_count: Total Newton iterations.
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


def simulate_reduced(model: ReducedModel, *, poses: np.ndarray, times: np.ndarray,
                     start: ReducedState | ReducedMotionState | None = None,
                     nodal_forces: np.ndarray | None = None,
                     settings: NewmarkSettings = _NEWMARK,
                     progress: Progress = SILENT) -> ReducedMotion:
    """Move the grasp through poses in time; never raises for lack of convergence.

    Args:
        poses: [m, rad], shape [frames, 6]; a cubic spline between, at rest at the start.
        times: [s], ascending, shape [frames].
        start: By default the equilibrium at the first pose.
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
        _begin(stepper, _held_at(model, path, float(times[0]))[2])
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


def _begin(stepper: ReducedStepper, held_acceleration: np.ndarray) -> None:
    """Set the acceleration that a state at rest starts with when the grasp starts to move.

    Without it the first step would cost the motion its second order.
    """
    mass, count = stepper.model.mass, len(held_acceleration)
    _, force = stepper.model.energy_force(stepper.state.coordinates)
    right = (stepper.load - force)[count:] - mass[count:, :count] @ held_acceleration
    stepper.state.acceleration[:count] = held_acceleration
    stepper.state.acceleration[count:] = np.linalg.solve(mass[count:, count:], right)


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
