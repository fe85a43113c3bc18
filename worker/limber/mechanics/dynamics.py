"""Motion in time: implicit Newmark steps, solved by Newton with kept factors.

M a + alpha M v + f(u, v) = loads, where the internal force f has a Kelvin-Voigt part (stress from
the rate of the Green-Lagrange strain). With beta 1/4 and gamma 1/2 (average acceleration) the
method is of second order and, in linear problems, keeps the energy. A step that fails is halved.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from limber.errors import InputError
from limber.mechanics.equations import Equations, Viscous
from limber.mechanics.factor import NotPositiveDefiniteError
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.mechanics.motion import (
    DEFAULT_SETTINGS,
    DynamicResult,
    DynamicSensitivities,
    MotionState,
    NewmarkSettings,
)
from limber.mechanics.pose_path import PosePath
from limber.mechanics.sensitivities import (
    ParameterSet,
    explicit_forces,
    reactions,
    refined_solve,
    static_sensitivities,
    viscous_force,
)
from limber.mechanics.static_problem import checked_forces, strain_warnings
from limber.mechanics.static_result import StaticResult
from limber.mechanics.statics import solve_static
from limber.mechanics.strain import principal_stretch
from limber.progress import SILENT, Progress

_GOOD_FACTOR = 1e-3


def simulate_dynamics(model: BranchModel, *, grasp: Grasp | Sequence[Grasp] | None = None,
                      poses: np.ndarray | None = None, grasp_forces: np.ndarray | None = None,
                      nodal_forces: np.ndarray | None = None, times: np.ndarray,
                      start: StaticResult | MotionState | np.ndarray
                      | Literal["equilibrium", "rest"] = "equilibrium",
                      settings: NewmarkSettings = DEFAULT_SETTINGS,
                      sensitivities: ParameterSet | None = None,
                      sensitivity_nodes: np.ndarray | None = None,
                      progress: Progress = SILENT) -> DynamicResult:
    """Move a branch in time; never raises for want of convergence.

    Args:
        grasp: The grasp, or several.
        poses: Pose of the grasp at each time [m, rad], shape [frames, 6] ([frames, g, 6]);
            between frames a cubic spline that starts at rest.
        grasp_forces: Force [N] of the gripper instead, shape [frames, 3] ([frames, g, 3]),
            linear between frames.
        nodal_forces: Constant loads [N], shape [node_count, 3], besides gravity.
        times: Of the frames [s], ascending, shape [frames].
        start: State at the first time: ``equilibrium`` under the loads and pose of that time,
            ``rest`` (undeformed), a static result, displacements, or the last state of another
            motion. At rest unless it is that last.
        sensitivities: Which derivatives to accumulate.
        sensitivity_nodes: Nodes that they are kept for; default all.

    Raises:
        InputError: arguments that do not fit each other. ConvergenceError: no equilibrium at
            the start.
    """
    run = _Motion(model, grasp, poses, grasp_forces, nodal_forces, times, settings,
                  sensitivities, sensitivity_nodes)
    run.begin(start)
    return run.go(progress)


class _Motion:
    """A motion under way."""

    def __init__(self, model: BranchModel, grasp: Grasp | Sequence[Grasp] | None,
                 poses: np.ndarray | None, grasp_forces: np.ndarray | None,
                 nodal_forces: np.ndarray | None, times: np.ndarray, settings: NewmarkSettings,
                 sensitivities: ParameterSet | None, sensitivity_nodes: np.ndarray | None):
        self.model, self.settings = model, settings
        self.times = _checked_times(times)
        self.single = isinstance(grasp, Grasp)
        self.grasps = [] if grasp is None else [grasp] if self.single else list(grasp)
        self.path = None
        if poses is not None:
            if not self.grasps or grasp_forces is not None:
                raise InputError("Poses without a grasp, or together with grasp forces.",
                                 "A grasp follows poses or exerts a force, not both.",
                                 "Leave one out.")
            self.path = PosePath(self.grasps, model.mesh.nodes, self.times, poses)
        shape = (model.mesh.node_count, 3)
        self.load = model.weight_force
        if nodal_forces is not None:
            self.load = self.load + checked_forces(nodal_forces, shape)
        self.grasp_forces = self._checked_grasp_forces(grasp_forces)
        self.equations: Equations = model.equations(self.grasps if self.path else ())
        self.held = self.equations.held
        self.factor_step, self.factor_error = 0.0, np.inf
        self.step_count = self.iteration_count = 0
        self.factorisations_before = self.equations.factorisation_count
        self.trouble, self.status = "", "converged"
        self.wanted = sensitivities
        self.followed = (np.arange(model.mesh.node_count) if sensitivity_nodes is None
                         else np.asarray(sensitivity_nodes))
        self.tangents: list[MotionState] = []
        self.tangent_out: list[np.ndarray] = []
        self.viscous: Viscous | None = None

    def _checked_grasp_forces(self, forces: np.ndarray | None) -> np.ndarray | None:
        if forces is None:
            return None
        wanted = (len(self.times), len(self.grasps), 3)
        values = np.asarray(forces, float)
        if not self.grasps or values.size != np.prod(wanted) or not np.isfinite(values).all():
            raise InputError(f"Grasp forces of shape {values.shape}.",
                             f"{len(self.times)} times and {len(self.grasps)} grasps need"
                             f" {wanted}.", "Give three numbers [N] for each.")
        return values.reshape(wanted)

    def load_at(self, instant: float) -> np.ndarray:
        """Return nodal loads [N] at a time."""
        if self.grasp_forces is None:
            return self.load
        load = self.load.copy()
        for number, grasp in enumerate(self.grasps):
            force = [np.interp(instant, self.times, self.grasp_forces[:, number, axis])
                     for axis in range(3)]
            load[grasp.nodes] += grasp.weights[:, None] * force
        return load

    def begin(self, start: StaticResult | MotionState | np.ndarray | str) -> None:
        shape = (self.model.mesh.node_count, 3)
        self.tangents = []
        if isinstance(start, MotionState):
            self.state = replace(start, time=float(self.times[0]))
            self._zero_tangents()
            return
        result = None
        if isinstance(start, str) and start == "equilibrium":
            result = self._equilibrium()
            displacement = result.displacement
        elif isinstance(start, str):
            displacement = np.zeros(shape)
        else:
            values = start.displacement if isinstance(start, StaticResult) else start
            displacement = checked_forces(values, shape, "Start displacements").copy()
        self.state = MotionState(float(self.times[0]), displacement, np.zeros(shape),
                                 np.zeros(shape), *self._strains(displacement),
                                 self.settings.max_step)
        if self.path:
            self._impose(self.state, self.state.time)
        self._start_acceleration()
        if self.wanted is None:
            return
        self._zero_tangents()
        if result is not None:
            found = static_sensitivities(
                self.model, result, self.grasps or None, self.wanted.weights, self.wanted.names,
                is_held=self.path is not None, control_young=self.wanted.control_young)
            for column, tangent in enumerate(self.tangents):
                tangent.displacement = found.displacement[:, :, column].copy()
                if self.model.damping.stiffness:
                    tangent.strain = tangent.strain_before = self.model.strain_changes(
                        displacement, tangent.displacement)

    def _strains(self, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return strains of now and before, for a branch at rest."""
        if not self.model.damping.stiffness:
            return np.zeros((0, 0, 6)), np.zeros((0, 0, 6))
        strain = self.model.strains(displacement)
        return strain, strain

    def _zero_tangents(self) -> None:
        if self.wanted is not None:
            shape = (self.model.mesh.node_count, 3)
            empty = np.zeros_like(self.state.strain)
            self.tangents = [MotionState(0.0, np.zeros(shape), np.zeros(shape), np.zeros(shape),
                                         empty, empty) for _ in self.wanted.labels()]

    def _equilibrium(self) -> StaticResult:
        pose = self.path.poses[0] if self.path else None
        force = None if self.grasp_forces is None else self.grasp_forces[0]
        extra = self.load - self.model.weight_force
        return solve_static(self.model, grasp=self.grasps or None, pose=pose, grasp_force=force,
                            nodal_forces=extra if extra.any() else None).require()

    def _start_acceleration(self) -> None:
        state, model = self.state, self.model
        out = (self.load_at(state.time)
               - model.internal(state.displacement).force
               - model.mass_matrix @ (model.damping.mass * state.velocity + state.acceleration))
        if np.linalg.norm(self.equations.free_part(out)) > 1e-12 * np.linalg.norm(out):
            self.equations.factorise_mass(model)
            state.acceleration += self.equations.solve(out)
            self.factor_step = 0.0

    def _impose(self, state: MotionState, instant: float) -> None:
        """Give held nodes, and the means of pinned patches, the path's motion."""
        held, pins = self.path.at(instant)
        fields = (state.displacement, state.velocity, state.acceleration)
        for field_, values, means in zip(fields, held, pins, strict=True):
            for grasp, patch in zip(self.path.clamped, values, strict=True):
                field_[grasp.nodes] = patch
            for grasp, mean in zip(self.path.pinned, means, strict=True):
                field_[grasp.nodes] += mean - grasp.weights @ field_[grasp.nodes]

    def go(self, progress: Progress) -> DynamicResult:
        started = time.perf_counter()
        frames = [self._frame()]
        for number in range(1, len(self.times)):
            progress((number - 1) / max(len(self.times) - 1, 1), "moving", time=self.state.time)
            if not self._advance(self.times[number]):
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
        """Take one step of ``dt``; False, and nothing changed, if it fails."""
        old, settings = self.state, self.settings
        load = self.load_at(old.time + dt)
        viscous = self._viscous(dt)
        new = self._converge(dt, load, viscous)
        if new is None:
            self.factor_step = 0.0
            return False
        if (stretch := principal_stretch(self.model, new.displacement)
                ).value > settings.stretch_limit:
            self.status = "torn"
            self.trouble = f"stretched to {100 * stretch.value:.0f} % {stretch.at}"
            return False
        if viscous is not None:
            new.strain, new.strain_before = self.model.strains(new.displacement), old.strain
        self.viscous, self.state = viscous, new
        if self.wanted is not None:
            self._advance_tangents(old, new, dt)
        if self.path:
            before = self._explicit(new)
            self._impose(new, new.time)
            if before:
                # The reaction is that of the motion imposed on pinned patches.
                self.tangent_out = [out + now - was for out, now, was in zip(
                    self.tangent_out, self._explicit(new), before, strict=True)]
        self.step_count += 1
        return True

    def _viscous(self, dt: float) -> Viscous | None:
        factor, old = self.model.damping.stiffness, self.state
        if not factor:
            return None
        ahead, now, before = old.rate_formula(dt)
        return Viscous(1 + factor * ahead, factor * (now * old.strain + before * old.strain_before))

    def _follow(self, new: MotionState, dt: float) -> None:
        """Give velocity and acceleration by Newmark's formulas, and the path's to held nodes."""
        old, beta, gamma = self.state, self.settings.beta, self.settings.gamma
        new.acceleration = ((new.displacement - old.displacement - dt * old.velocity) / dt**2
                            - (0.5 - beta) * old.acceleration) / beta
        new.velocity = old.velocity + dt * (
            (1 - gamma) * old.acceleration + gamma * new.acceleration)
        if self.path:
            held, _ = self.path.at(new.time)
            for values, motion in zip((new.velocity, new.acceleration), held[1:], strict=True):
                for grasp, patch in zip(self.path.clamped, motion, strict=True):
                    values[grasp.nodes] = patch

    def _converge(self, dt: float, load: np.ndarray,
                  viscous: Viscous | None) -> MotionState | None:
        """Return the state after ``dt``, or None.

        The first solve starts from the balanced state before, not from one extrapolated in time:
        straight extrapolation stretches whatever turns. Mixed-point Newton then does the same
        service as in statics.
        """
        model, equations, settings, old = self.model, self.equations, self.settings, self.state
        new = replace(old, time=old.time + dt, step_before=dt,
                      displacement=old.displacement.copy())
        moved, pins = self._constraint_moves(new)
        self._follow(new, dt)
        increment, norms, fresh = None, [], False
        for _ in range(settings.max_iterations):
            out, inertial, min_det_f = self._imbalance(new, load, viscous)
            residual = equations.free_part(out)
            norm = float(np.linalg.norm(residual))
            reference = float(np.linalg.norm(load) + np.linalg.norm(inertial)
                              + np.linalg.norm(out - residual))
            if not np.isfinite(norm) or (len(norms) > 4 and norm > 0.9 * min(norms)
                                         and norms[-1] > 0.9 * min(norms[:-1])):
                self.trouble, self.status = "the iteration does not converge", "stalled"
                return None
            if increment is not None and norm <= max(settings.tolerance * reference,
                                                     self._floor()):
                if fresh:
                    self.factor_error = norm / norms[-1]
                return self._accepted(new, min_det_f)
            first = increment is None
            if fresh:
                self.factor_error, fresh = norm / norms[-1], False
            keep = self._may_keep(dt) if first else (
                norm <= settings.keep_factor * reference and norm < 0.1 * norms[-1])
            if not keep:
                if not self._factorise(new, increment, viscous, dt):
                    return None
                fresh = True
            norms.append(norm)
            self.iteration_count += 1
            if first and moved is not None:
                residual = equations.free_part(
                    out - model.tangent_times(old.displacement, moved, viscous))
            increment = equations.solve(residual, pins)
            if moved is not None and self.held.any():
                increment = increment + moved
            moved, pins = None, np.zeros_like(pins)
            new.displacement = new.displacement + increment
            self._follow(new, dt)
        self.trouble = f"no convergence in {settings.max_iterations} iterations"
        self.status = "stalled"
        return None

    def _may_keep(self, dt: float) -> bool:
        """Whether the last factor fits the state before this step.

        It does if its own solve brought the residual down a thousandfold.
        """
        return (self.settings.keep_factor > 0 and self.factor_step == dt
                and self.factor_error <= _GOOD_FACTOR)

    def _constraint_moves(self, new: MotionState) -> tuple[np.ndarray | None, np.ndarray]:
        """Return how held nodes and pinned means move in the step; None: they do not."""
        if not self.path:
            return None, np.zeros((0, 3))
        held, means = self.path.at(new.time)
        moved = np.zeros_like(new.displacement)
        for grasp, patch in zip(self.path.clamped, held[0], strict=True):
            moved[grasp.nodes] = patch - new.displacement[grasp.nodes]
        now = np.array([g.weights @ new.displacement[g.nodes] for g in self.path.pinned])
        return (moved if moved.any() else None), means[0] - now.reshape(-1, 3)

    def _factorise(self, new: MotionState, increment: np.ndarray | None,
                   viscous: Viscous | None, dt: float) -> bool:
        settings, damping = self.settings, self.model.damping
        rate, inertia = settings.gamma / (settings.beta * dt), 1 / (settings.beta * dt**2)
        try:
            self.equations.assemble(self.model, new.displacement, increment=increment,
                                    viscous=viscous, mass_factor=inertia + damping.mass * rate)
            self.equations.factorise()
        except NotPositiveDefiniteError:
            self.trouble, self.status = "the stiffness has no positive pivots", "stalled"
            return False
        self.factor_step = dt
        return True

    def _imbalance(self, new: MotionState, load: np.ndarray, viscous: Viscous | None,
                   ) -> tuple[np.ndarray, np.ndarray, float]:
        """Return what forces are left over, the inertial ones, and min det F."""
        internal = self.model.internal(new.displacement, viscous=viscous)
        inertial = self.model.mass_matrix @ (
            new.acceleration + self.model.damping.mass * new.velocity)
        return load - internal.force - inertial, inertial, internal.min_det_f

    def _floor(self) -> float:
        # Differences of displacements in an element carry round-off of about one unit each.
        return 8 * np.finfo(float).eps * self.equations.diagonal_norm() * self.model.mean_edge

    def _accepted(self, new: MotionState, min_det_f: float) -> MotionState | None:
        if min_det_f <= 0:
            self.trouble, self.status = "an element would turn inside out", "inverted"
            return None
        self.status = "converged"
        return new

    def _explicit(self, state: MotionState) -> list[np.ndarray]:
        """Return the explicit derivatives of forces where pinned patches make them jump."""
        if self.wanted is None or not self.equations.pinned:
            return []
        return explicit_forces(self.model, self.wanted, state, self.viscous)

    def _advance_tangents(self, old: MotionState, new: MotionState, dt: float) -> None:
        model, settings, viscous = self.model, self.settings, self.viscous
        beta, gamma = settings.beta, settings.gamma
        rate, inertia = gamma / (beta * dt), 1 / (beta * dt**2)
        formula, alpha = old.rate_formula(dt), model.damping.mass
        partials = explicit_forces(model, self.wanted, new, viscous)

        def force(change: np.ndarray) -> np.ndarray:
            return (model.tangent_times(new.displacement, change, viscous)
                    + model.mass_matrix @ ((inertia + alpha * rate) * change))

        self.tangent_out = []
        for number, partial in enumerate(partials):
            past = self.tangents[number]
            # Velocity and acceleration if the displacement's derivative were 0.
            a_zero = (-(past.displacement + dt * past.velocity) / dt**2
                      - (0.5 - beta) * past.acceleration) / beta
            v_zero = past.velocity + dt * ((1 - gamma) * past.acceleration + gamma * a_zero)
            history = partial + model.mass_matrix @ (a_zero + alpha * v_zero)
            if viscous is not None:
                memory = model.damping.stiffness * (formula[1] * past.strain
                                                    + formula[2] * past.strain_before)
                history = history + viscous_force(model, new.displacement, memory)
            change = refined_solve(self.equations, force, -history)
            strain = past.strain if viscous is None else model.strain_changes(
                new.displacement, change)
            motion = (v_zero + rate * change, a_zero + inertia * change)
            free = alpha * motion[0] + motion[1]
            for grasp in self.equations.pinned:
                # The path gives the means' velocity and acceleration, whatever the parameters.
                for values in motion:
                    values[grasp.nodes] -= grasp.weights @ values[grasp.nodes]
            imposed = model.mass_matrix @ (alpha * motion[0] + motion[1] - free)
            self.tangents[number] = MotionState(new.time, change, *motion, strain, past.strain,
                                                dt)
            self.tangent_out.append(history + force(change) + imposed)

    def _frame(self) -> dict[str, np.ndarray | float]:
        state, model = self.state, self.model
        internal = model.internal(state.displacement, viscous=self.viscous)
        load = self.load_at(state.time)
        out = (internal.force - load
               + model.mass_matrix @ (state.acceleration + model.damping.mass * state.velocity))
        positions = model.mesh.nodes + state.displacement
        forces, torques = np.zeros((len(self.grasps), 3)), np.zeros((len(self.grasps), 3))
        if self.path:
            forces = reactions(self.grasps, out)
            for number, grasp in enumerate(self.grasps):
                arm = positions[grasp.nodes] - grasp.weights @ positions[grasp.nodes]
                share = (out[grasp.nodes] if grasp.mode == "clamped"
                         else grasp.weights[:, None] * forces[number])
                torques[number] = np.cross(arm, share).sum(axis=0)
        frame = {
            "time": state.time, "displacement": state.displacement.copy(),
            "strain_energy": internal.strain_energy,
            "kinetic_energy": 0.5 * float((state.velocity
                                           * (model.mass_matrix @ state.velocity)).sum()),
            "load_energy": -float((load * state.displacement).sum()),
            "reaction_force": forces, "reaction_torque": torques,
            "base_force": out[model.fixed].sum(axis=0), "min_det_f": internal.min_det_f}
        if self.wanted is not None:
            frame["displacement_change"] = np.stack(
                [t.displacement[self.followed] for t in self.tangents], axis=-1)
            outs = self.tangent_out or self._first_out()
            frame["reaction_change"] = np.stack(
                [reactions(self.grasps, out) if self.path else np.zeros((len(self.grasps), 3))
                 for out in outs], axis=-1)
        return frame

    def _first_out(self) -> list[np.ndarray]:
        state = self.state
        partials = explicit_forces(self.model, self.wanted, state, None)
        return [partial + self.model.tangent_times(state.displacement, tangent.displacement)
                for partial, tangent in zip(partials, self.tangents, strict=True)]

    def _result(self, frames: list[dict], seconds: float) -> DynamicResult:
        def stacked(name: str) -> np.ndarray:
            return np.array([frame[name] for frame in frames])

        def per_grasp(name: str) -> np.ndarray:
            values = stacked(name)
            if self.single:
                return values[:, 0]
            return values if self.grasps else np.zeros((len(frames), 3))

        complete = len(frames) == len(self.times)
        stretch = principal_stretch(self.model, self.state.displacement)
        message = "" if complete else f"{self.trouble}; stretched most {stretch.at}"
        derivatives = None
        if self.wanted is not None:
            change = stacked("reaction_change")
            derivatives = DynamicSensitivities(
                self.wanted.labels(), stacked("displacement_change"),
                change[:, 0] if self.single else change)
        return DynamicResult(
            converged=complete, status="converged" if complete else self.status,
            times=stacked("time"), displacement=stacked("displacement"),
            strain_energy=stacked("strain_energy"), kinetic_energy=stacked("kinetic_energy"),
            load_energy=stacked("load_energy"), reaction_force=per_grasp("reaction_force"),
            reaction_torque=per_grasp("reaction_torque"), base_force=stacked("base_force"),
            min_det_f=stacked("min_det_f"), last=self.state, step_count=self.step_count,
            iteration_count=self.iteration_count,
            factorisation_count=self.equations.factorisation_count - self.factorisations_before,
            seconds=seconds, message=message, warnings=strain_warnings(stretch),
            sensitivities=derivatives)


def _checked_times(times: np.ndarray) -> np.ndarray:
    times = np.asarray(times, float)
    if times.ndim != 1 or len(times) < 1 or not np.isfinite(times).all() or (
            np.diff(times) <= 0).any():
        raise InputError("Times are not ascending.", "Each frame must be later than the last.",
                         "Sort them and remove what is double.")
    return times
