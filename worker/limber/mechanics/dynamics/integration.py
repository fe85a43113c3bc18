"""Motion in time: implicit second-order steps, energy-momentum or Newmark.

M a + alpha M v + f(u, v) = loads, where the internal force f has a Kelvin-Voigt part (stress from
the rate of the Green-Lagrange strain). The energy-momentum step conserves energy at any amplitude.
Newmark's step with beta 1/4 and gamma 1/2 (average acceleration) conserves it in linear problems. A
step that fails is halved.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from limber.core.errors import InputError
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.mechanics.dynamics.drive import Drive
from limber.mechanics.dynamics.energy_momentum import EnergyMomentumStepper
from limber.mechanics.dynamics.motion import (
    DynamicResult,
    DynamicSensitivities,
    EnergyMomentumSettings,
    MotionSettings,
    NewmarkSettings,
)
from limber.mechanics.dynamics.motion_tangents import MotionTangents
from limber.mechanics.dynamics.newmark import NewmarkStepper
from limber.mechanics.grasp import Grasp
from limber.mechanics.linear.equations import Viscous
from limber.mechanics.model import BranchModel
from limber.mechanics.motion_state import MotionState
from limber.mechanics.sensitivities import ParameterSet, reactions
from limber.mechanics.solve_status import Status
from limber.mechanics.statics.result import StaticResult
from limber.mechanics.statics.static_problem import base_forces, checked_forces, strain_warnings
from limber.mechanics.strain import principal_stretch


def simulate_dynamics(model: BranchModel, *, grasp: Grasp | Sequence[Grasp] | None = None,
                      poses: np.ndarray | None = None, grasp_forces: np.ndarray | None = None,
                      nodal_forces: np.ndarray | None = None, times: np.ndarray,
                      start: StaticResult | MotionState | np.ndarray
                      | Literal["equilibrium", "rest"] = "equilibrium",
                      settings: MotionSettings | None = None,
                      sensitivities: ParameterSet | None = None,
                      sensitivity_nodes: np.ndarray | None = None,
                      progress: Progress = SILENT) -> DynamicResult:
    """Simulate the motion of a branch; a failure to converge is a status, not an exception.

    Args:
        grasp: The grasp, or several grasps.
        poses: Pose of the grasp at each time [m, rad], shape [frames, 6] ([frames, g, 6]),
            interpolated by a cubic spline that starts at rest.
        grasp_forces: Force [N] of the gripper instead, shape [frames, 3] ([frames, g, 3]),
            linear between frames.
        nodal_forces: Loads [N] in addition to gravity: constant, shape [node_count, 3], or linear
            between frames, shape [frames, node_count, 3].
        times: Times of the frames [s], ascending, shape [frames].
        start: State at the first time: ``equilibrium`` under the loads and pose of that time,
            ``rest`` (undeformed), a static result, displacements, or the last state of another
            motion. Velocities are zero unless it is the last state of a motion.
        settings: Their type selects the scheme. Default: energy-momentum, or Newmark if derivatives
            are requested.
        sensitivities: Derivatives to accumulate; Newmark's scheme only.
        sensitivity_nodes: Nodes for which they are kept; default all.

    Raises:
        InputError: arguments do not fit each other. ConvergenceError: no equilibrium at the start.
    """
    if settings is None:
        settings = EnergyMomentumSettings() if sensitivities is None else NewmarkSettings()
    drive = Drive(model, grasp, poses, grasp_forces, nodal_forces, times)
    tangents = None
    if sensitivities is not None:
        if not isinstance(settings, NewmarkSettings):
            raise InputError("The energy-momentum scheme gives no derivatives along a motion.",
                             "Only Newmark's scheme has them.", "Give NewmarkSettings.")
        tangents = MotionTangents(drive, settings, sensitivities, sensitivity_nodes)
    run = _Run(drive, settings, tangents)
    run.begin(start)
    return run.go(progress)


class _Run:
    """A motion in progress."""

    def __init__(self, drive: Drive, settings: MotionSettings,
                 tangents: MotionTangents | None):
        self.drive, self.settings, self.tangents = drive, settings, tangents
        self.model, self.equations = drive.model, drive.equations
        self.stepper: NewmarkStepper | EnergyMomentumStepper = (
            NewmarkStepper(drive, settings) if isinstance(settings, NewmarkSettings)
            else EnergyMomentumStepper(drive, settings))
        self.step_count = 0
        self.factorisations_before = self.equations.factorisation_count
        self.viscous: Viscous | None = None

    def begin(self, start: StaticResult | MotionState | np.ndarray | str) -> None:
        shape = (self.model.mesh.node_count, 3)
        first = float(self.drive.times[0])
        equilibrium = None
        if isinstance(start, MotionState):
            self.state = replace(start, time=first)
        else:
            if isinstance(start, str) and start == "equilibrium":
                equilibrium = self.drive.equilibrium()
                displacement = equilibrium.displacement
            elif isinstance(start, str):
                displacement = np.zeros(shape)
            else:
                values = start.displacement if isinstance(start, StaticResult) else start
                displacement = checked_forces(values, shape, "start displacements").copy()
            self.state = MotionState(first, displacement, np.zeros(shape), np.zeros(shape),
                                     *self._strains(displacement), self.settings.max_step)
            if self.drive.path:
                self.drive.impose(self.state)
            self._start_acceleration()
        if self.tangents:
            self.tangents.begin(self.state, equilibrium)

    def _strains(self, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return current and previous strains of a branch at rest."""
        if not self.model.damping.stiffness:
            return np.zeros((0, 0, 6)), np.zeros((0, 0, 6))
        strain = self.model.strains(displacement)
        return strain, strain

    def _start_acceleration(self) -> None:
        state, model = self.state, self.model
        out = (self.drive.load_at(state.time)
               - model.internal(state.displacement).force
               - model.mass_times(model.damping.mass * state.velocity + state.acceleration))
        if np.linalg.norm(self.equations.free_part(out)) > 1e-12 * np.linalg.norm(out):
            state.acceleration += self.equations.mass(model).solve(out)

    def go(self, progress: Progress) -> DynamicResult:
        started = time.perf_counter()
        times = self.drive.times
        frames = [self._frame()]
        for number in range(1, len(times)):
            progress((number - 1) / max(len(times) - 1, 1), "moving", time=self.state.time)
            if not self._advance(times[number]):
                break
            frames.append(self._frame())
        progress(1.0, "moving")
        return self._result(frames, time.perf_counter() - started)

    def _advance(self, end: float) -> bool:
        settings = self.settings
        while end - self.state.time > 1e-9 * max(1.0, abs(end)):
            remaining = end - self.state.time
            step = remaining / np.ceil(remaining / settings.max_step - 1e-9)
            while not self._step(step):
                step /= 2
                if step < settings.min_step:
                    return False
        self.state.time = float(end)
        return True

    def _step(self, dt: float) -> bool:
        """Take one step of ``dt``; if it fails, return False and change nothing."""
        old, drive, stepper = self.state, self.drive, self.stepper
        viscous = stepper.viscous(old, dt)
        new = stepper.step(old, dt, viscous)
        if new is None:
            stepper.forget_tangent()
            return False
        stretch = principal_stretch(self.model, new.displacement)
        if stretch.value > self.settings.stretch_limit:
            stepper.status = Status.torn
            stepper.trouble = f"stretched to {100 * stretch.value:.0f} % {stretch.at}"
            return False
        if viscous is not None:
            new.strain, new.strain_before = self.model.strains(new.displacement), old.strain
        self.viscous, self.state = viscous, new
        tangents = self.tangents
        if tangents:
            tangents.advance(old, new, dt, viscous, present(stepper.tangent, "tangent"))
            before = tangents.explicit(new, viscous)
        if drive.path:
            drive.impose(new)
            if tangents:
                tangents.jump(before, tangents.explicit(new, viscous))
        self.step_count += 1
        return True

    def _frame(self) -> dict[str, np.ndarray | float]:
        state, model, grasps = self.state, self.model, self.drive.grasps
        internal = model.internal(state.displacement, viscous=self.viscous)
        load = self.drive.load_at(state.time)
        momentum = model.mass_times(state.velocity)
        stepper = self.stepper
        out = (stepper.borne(state.time) if isinstance(stepper, EnergyMomentumStepper) else None)
        if out is None:
            out = (internal.force - load
                   + model.mass_times(state.acceleration) + model.damping.mass * momentum)
            if isinstance(stepper, EnergyMomentumStepper):
                stepper.begin(state, out)
        positions = model.mesh.nodes + state.displacement
        forces, torques = np.zeros((len(grasps), 3)), np.zeros((len(grasps), 3))
        if self.drive.path:
            forces = reactions(grasps, out)
            for number, grasp in enumerate(grasps):
                arm = positions[grasp.nodes] - grasp.pose_of(model.mesh.nodes,
                                                             state.displacement)[:3]
                share = (out[grasp.nodes] if grasp.mode == "rigid"
                         else grasp.weights[:, None] * forces[number])
                torques[number] = np.cross(arm, share).sum(axis=0)
        frame = {
            "time": state.time, "displacement": state.displacement.copy(),
            "strain_energy": internal.strain_energy,
            "energy": internal.energy - float((model.weight_force * state.displacement).sum()),
            "kinetic_energy": 0.5 * float((state.velocity * momentum).sum()),
            "load_energy": -float((load * state.displacement).sum()),
            "reaction_force": forces, "reaction_torque": torques,
            "base_force": base_forces(model, out).sum(axis=0), "min_det_f": internal.min_det_f}
        if self.tangents:
            frame["displacement_change"], frame["reaction_change"] = self.tangents.frame(state)
        return frame

    def _result(self, frames: list[dict], seconds: float) -> DynamicResult:
        def stacked(name: str) -> np.ndarray:
            return np.array([frame[name] for frame in frames])

        def per_grasp(name: str) -> np.ndarray:
            values = stacked(name)
            if self.drive.single:
                return values[:, 0]
            return values if self.drive.grasps else np.zeros((len(frames), 3))

        complete = len(frames) == len(self.drive.times)
        stretch = principal_stretch(self.model, self.state.displacement)
        message = "" if complete else (f"{self.stepper.trouble}; the largest stretch is "
                                       f"{stretch.at}")
        derivatives = None
        if self.tangents:
            change = stacked("reaction_change")
            derivatives = DynamicSensitivities(
                self.tangents.requested.labels(), stacked("displacement_change"),
                change[:, 0] if self.drive.single else change)
        return DynamicResult(
            status=Status.converged if complete else self.stepper.status,
            times=stacked("time"), displacement=stacked("displacement"),
            strain_energy=stacked("strain_energy"), energy=stacked("energy"),
            kinetic_energy=stacked("kinetic_energy"), load_energy=stacked("load_energy"),
            reaction_force=per_grasp("reaction_force"),
            reaction_torque=per_grasp("reaction_torque"), base_force=stacked("base_force"),
            min_det_f=stacked("min_det_f"), last=self.state, step_count=self.step_count,
            iteration_count=self.stepper.iteration_count,
            factorisation_count=self.equations.factorisation_count - self.factorisations_before,
            seconds=seconds, message=message, warnings=strain_warnings(stretch),
            sensitivities=derivatives)
