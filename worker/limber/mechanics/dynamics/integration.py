"""Motion in time: implicit second-order steps, energy-momentum or Newmark.

M a + alpha M v + f(u, v) = loads, where the internal force f has a Kelvin-Voigt part (stress from
the rate of the Green-Lagrange strain). The energy-momentum step conserves energy at any amplitude.
Newmark's step with beta 1/4 and gamma 1/2 (average acceleration) conserves it in linear problems. A
step that fails is halved.
"""

import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from limber.core.errors import InputError, Text
from limber.core.not_none import present
from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.core.progress import SILENT, Progress
from limber.mechanics.dynamics.drive import Drive
from limber.mechanics.dynamics.motion import (
    DynamicResult,
    DynamicSensitivities,
    EnergyMomentumSettings,
    MotionSettings,
    MotionState,
    NewmarkSettings,
)
from limber.mechanics.grasp import Grasp
from limber.mechanics.linear.equations import Tangent, Viscous
from limber.mechanics.materials.laws import contracted, hooke_strain
from limber.mechanics.model import BranchModel
from limber.mechanics.sensitivities import (
    ParameterSet,
    explicit_forces,
    reactions,
    refined_solve,
    static_sensitivities,
    viscous_force,
)
from limber.mechanics.statics.equilibrium_path import base_forces, checked_forces, strain_warnings
from limber.mechanics.statics.result import StaticResult, Status
from limber.mechanics.strain import principal_stretch

# Derivatives along a motion, step by step, with the tangent of each step.

class MotionTangents:
    """Derivatives of the current state by the parameters; frames store those of the ``followed``
    nodes (None: all)."""

    def __init__(self, drive: Drive, settings: NewmarkSettings, requested: ParameterSet,
                 followed: np.ndarray | None):
        self.drive, self.settings, self.requested = drive, settings, requested
        self.model, self.equations = drive.model, drive.equations
        self._followed = (np.arange(self.model.mesh.node_count) if followed is None
                          else np.asarray(followed))
        self._states: list[MotionState] = []
        self._out: list[np.ndarray] = []

    def begin(self, start: MotionState, equilibrium: StaticResult | None) -> None:
        """Start from a state that does not depend on the parameters, or from an equilibrium."""
        zero = np.zeros_like(start.displacement)
        empty = np.zeros_like(start.strain)
        self._states = [MotionState(0.0, zero.copy(), zero.copy(), zero.copy(), empty, empty)
                        for _ in self.requested.labels()]
        if equilibrium is None:
            return
        drive, requested = self.drive, self.requested
        found = static_sensitivities(
            self.model, equilibrium, drive.grasps or None, requested.weights, requested.names,
            is_held=drive.path is not None, control_young=requested.control_young,
            shares=requested.shares)
        for column, tangent in enumerate(self._states):
            tangent.displacement = found.displacement[:, :, column].copy()
            if self.model.damping.stiffness:
                tangent.strain = tangent.strain_before = self.model.strain_changes(
                    equilibrium.displacement, tangent.displacement)

    def explicit(self, state: MotionState, viscous: Viscous | None) -> list[np.ndarray]:
        """Return the explicit derivatives of forces; pinned patches make them jump."""
        if not self.equations.pinned:
            return []
        return explicit_forces(self.model, self.requested, state.displacement, motion=state,
                               viscous=viscous)

    def jump(self, before: Sequence[np.ndarray], after: Sequence[np.ndarray]) -> None:
        """Store the reaction to the motion imposed on pinned patches."""
        if before:
            self._out = [out + now - was
                         for out, now, was in zip(self._out, after, before, strict=True)]

    def advance(self, old: MotionState, new: MotionState, dt: float,
                viscous: Viscous | None, tangent: Tangent) -> None:
        """Advance the derivatives by a step that was solved with ``tangent``."""
        model, settings = self.model, self.settings
        beta, gamma = settings.beta, settings.gamma
        rate, inertia = gamma / (beta * dt), 1 / (beta * dt**2)
        formula, alpha = old.rate_formula(dt), model.damping.mass
        partials = explicit_forces(model, self.requested, new.displacement, motion=new,
                                   viscous=viscous)

        def force(change: np.ndarray) -> np.ndarray:
            return (model.tangent_times(new.displacement, change, viscous)
                    + model.mass_times((inertia + alpha * rate) * change))

        self._out = []
        for number, partial in enumerate(partials):
            past = self._states[number]
            # Velocity and acceleration if the derivative of the displacement were 0.
            a_zero = (-(past.displacement + dt * past.velocity) / dt**2
                      - (0.5 - beta) * past.acceleration) / beta
            v_zero = past.velocity + dt * ((1 - gamma) * past.acceleration + gamma * a_zero)
            history = partial + model.mass_times(a_zero + alpha * v_zero)
            if viscous is not None:
                memory = model.damping.stiffness * (formula[1] * past.strain
                                                    + formula[2] * past.strain_before)
                history = history + viscous_force(model, new.displacement, memory)
            change = refined_solve(tangent, force, -history)
            strain = past.strain if viscous is None else model.strain_changes(
                new.displacement, change)
            motion = (v_zero + rate * change, a_zero + inertia * change)
            free = alpha * motion[0] + motion[1]
            for grasp in self.equations.pinned:
                # The path prescribes the velocity and acceleration of the means, independent of the
                # parameters.
                for values in motion:
                    values[grasp.nodes] -= grasp.weights @ values[grasp.nodes]
            imposed = model.mass_times(alpha * motion[0] + motion[1] - free)
            self._states[number] = MotionState(new.time, change, *motion, strain, past.strain,
                                               dt)
            self._out.append(history + force(change) + imposed)

    def frame(self, state: MotionState) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of followed nodes [nodes, 3, p] and reactions [grasps, 3, p]."""
        moved = np.stack([t.displacement[self._followed] for t in self._states], axis=-1)
        grasps = self.drive.grasps
        force = np.stack(
            [reactions(grasps, out) if self.drive.path else np.zeros((len(grasps), 3))
             for out in self._out or self._first_out(state)], axis=-1)
        return moved, force

    def _first_out(self, state: MotionState) -> list[np.ndarray]:
        partials = explicit_forces(self.model, self.requested, state.displacement, motion=state)
        return [partial + self.model.tangent_times(state.displacement, tangent.displacement)
                for partial, tangent in zip(partials, self._states, strict=True)]


# What the implicit time integration schemes have in common.


class Stepper(ABC):
    """Takes steps and keeps the tangent of the last one, None before the first. ``status`` and
    ``trouble`` say why the last step failed."""

    def __init__(self, drive: Drive, settings: MotionSettings):
        self.drive, self.settings = drive, settings
        self.model, self.equations = drive.model, drive.equations
        self.iteration_count = 0
        self.status, self.trouble = Status.converged, ""
        self.tangent: Tangent | None = None

    def forget_tangent(self) -> None:
        """Discard the last tangent."""
        self.tangent = None

    @abstractmethod
    def viscous(self, old: MotionState, dt: float) -> Viscous | None:
        """Return the viscous part of a step of ``dt`` from ``old``; None if there is none."""

    @abstractmethod
    def step(self, old: MotionState, dt: float, viscous: Viscous | None) -> MotionState | None:
        """Return the state ``dt`` after ``old``, or None if it is not found."""

    def _is_balanced(self, norm: float, reference: float) -> bool:
        """Whether a residual is small relative to the forces or to round-off."""
        # Differences of displacements in an element carry a round-off error of about one unit each.
        tangent = present(self.tangent, "tangent")
        floor = 8 * float(np.finfo(float).eps) * tangent.diagonal_norm * self.model.mean_edge
        return norm <= max(self.settings.tolerance * reference, floor)

    def _change(self, residual: np.ndarray, moved: np.ndarray | None,
                pins: np.ndarray) -> np.ndarray:
        """Return the tangent's response to a residual and to the motion ``moved`` of held nodes."""
        change = present(self.tangent, "tangent").solve(residual, pins)
        return change if moved is None or not self.equations.held.any() else change + moved

    def _failed(self, trouble: str, status: Status = Status.stalled) -> None:
        self.trouble, self.status = trouble, status


# One implicit Newmark step: mixed-point Newton that reuses a tangent while it converges.

_KEPT_TANGENT_ERROR = 1e-3
"""Fraction of the residual that a tangent's solve may leave for the next step to start with it.
Chosen, not measured.
"""


class NewmarkStepper(Stepper):
    """Steps by Newmark's formulas."""

    settings: NewmarkSettings

    def __init__(self, drive: Drive, settings: NewmarkSettings):
        super().__init__(drive, settings)
        self._tangent_step, self._tangent_error = 0.0, np.inf

    def viscous(self, old: MotionState, dt: float) -> Viscous | None:
        """Return the viscous part of a step of ``dt`` from ``old``."""
        factor = self.model.damping.stiffness
        if not factor:
            return None
        ahead, now, before = old.rate_formula(dt)
        return Viscous(1 + factor * ahead, factor * (now * old.strain + before * old.strain_before))

    def step(self, old: MotionState, dt: float,
             viscous: Viscous | None) -> MotionState | None:
        """Return the state ``dt`` after ``old``, or None. The first solve starts from the last
        balanced state: linear extrapolation in time stretches rotating parts."""
        model, equations, settings = self.model, self.equations, self.settings
        load = self.drive.load_at(old.time + dt)
        new = replace(old, time=old.time + dt, step_before=dt,
                      displacement=old.displacement.copy())
        moved, pins = self.drive.moves(new)
        self._follow(old, new, dt)
        increment: np.ndarray | None = None
        norms: list[float] = []
        fresh = False
        for _ in range(settings.max_iterations):
            out, inertial, min_det_f = self._imbalance(new, load, viscous)
            residual = equations.free_part(out)
            norm = float(np.linalg.norm(residual))
            reference = float(np.linalg.norm(load) + np.linalg.norm(inertial)
                              + np.linalg.norm(out - residual))
            if not np.isfinite(norm) or (len(norms) > 4 and norm > 0.9 * min(norms)
                                         and norms[-1] > 0.9 * min(norms[:-1])):
                self._failed("the iteration does not converge")
                return None
            if increment is not None and self._is_balanced(norm, reference):
                if fresh:
                    self._tangent_error = norm / norms[-1] if norms[-1] else 0.0
                return self._accepted(new, min_det_f)
            first = increment is None
            if fresh:
                self._tangent_error, fresh = norm / norms[-1], False
            # The last tangent fits if its own solve reduced the residual a thousandfold.
            keep = (settings.keep_factor > 0 and self.tangent is not None
                    and self._tangent_step == dt and self._tangent_error <= _KEPT_TANGENT_ERROR
                    ) if first else (
                norm <= settings.keep_factor * reference and norm < 0.1 * norms[-1])
            if not keep:
                if not self._make_tangent(new, increment, viscous, dt):
                    return None
                fresh = True
            norms.append(norm)
            self.iteration_count += 1
            if first and moved is not None:
                residual = equations.free_part(
                    out - model.tangent_times(old.displacement, moved, viscous))
            increment = self._change(residual, moved, pins)
            moved, pins = None, np.zeros_like(pins)
            new.displacement = new.displacement + increment
            self._follow(old, new, dt)
        self._failed(f"no convergence in {settings.max_iterations} iterations")
        return None

    def _follow(self, old: MotionState, new: MotionState, dt: float) -> None:
        """Set velocity and acceleration by Newmark's formulas, and held nodes to the path's."""
        beta, gamma = self.settings.beta, self.settings.gamma
        new.acceleration = ((new.displacement - old.displacement - dt * old.velocity) / dt**2
                            - (0.5 - beta) * old.acceleration) / beta
        new.velocity = old.velocity + dt * (
            (1 - gamma) * old.acceleration + gamma * new.acceleration)
        self.drive.hold(new)

    def _make_tangent(self, new: MotionState, increment: np.ndarray | None,
                      viscous: Viscous | None, dt: float) -> bool:
        settings, damping = self.settings, self.model.damping
        rate, inertia = settings.gamma / (settings.beta * dt), 1 / (settings.beta * dt**2)
        # Its memory is reused by the new one.
        self.tangent = None
        try:
            self.tangent = self.equations.tangent(
                self.model, new.displacement, increment=increment, viscous=viscous,
                mass_factor=inertia + damping.mass * rate)
        except NotPositiveDefiniteError:
            self._failed("the stiffness has no positive pivots")
            return False
        self._tangent_step = dt
        return True

    def _imbalance(self, new: MotionState, load: np.ndarray, viscous: Viscous | None,
                   ) -> tuple[np.ndarray, np.ndarray, float]:
        """Return residual forces, inertial forces, and min det F."""
        internal = self.model.internal(new.displacement, viscous=viscous)
        inertial = self.model.mass_times(
            new.acceleration + self.model.damping.mass * new.velocity)
        return load - internal.force - inertial, inertial, internal.min_det_f

    def _accepted(self, new: MotionState, min_det_f: float) -> MotionState | None:
        if min_det_f <= 0:
            self._failed("an element would turn inside out", Status.inverted)
            return None
        self.status = Status.converged
        return new


# One implicit step that conserves energy exactly, for any amplitude and step size.
#
# With the mean u_m of two successive displacements and the mean velocity,
#
#     M (v_1 - v_0) / dt + alpha M (v_0 + v_1) / 2 + f = load,     (u_1 - u_0) / dt = (v_0 + v_1) /
#     2,
#
# where f is the integral of F(u_m) S grad N. S is the stress of the mean of the strains E_0 and
# E_1, not of the strain of the mean (Simo and Tarnow 1992). F(u_m) times the change of F is exactly
# the change of E, so the work of f equals the change of the energy: no energy is gained, and
# damping only removes it. A rigid rotation of any size has no strain at either end, hence no stress
# in between. If the energy is not quadratic in E, S has a component along E_1 - E_0 that makes up
# the difference (Gonzalez 2000).

_STRAIN_CHANGE = 1e-6
"""Below this change of strain in a step, Gonzalez' correction (its cube) is round-off."""
_GOOD_REDUCTION = 0.3
"""Fraction of the residual that a solve may leave for its tangent to be reused."""
_FRESH = 3
"""Most new tangents in one step; later ones belong to nearly the same state. Both chosen, not
measured.
"""
_NOTHING = np.zeros(6)


class EnergyMomentumStepper(Stepper):
    """Takes steps that conserve energy and momentum."""

    def __init__(self, drive: Drive, settings: MotionSettings):
        super().__init__(drive, settings)
        self._balances: deque[tuple[float, np.ndarray]] = deque(maxlen=2)
        law = self.model.material
        # Its stress is expressed by the strain that has this stress in St. Venant-Kirchhoff.
        self._bearing = (self.model if law.is_hookean
                         else self.model.with_material("st_venant_kirchhoff"))
        self._stiff = self._bearing if law.is_compiled else self.model

    def begin(self, start: MotionState, out: np.ndarray) -> None:
        """Begin with the reactions ``out`` [N] of the holds on each node, shape [node_count, 3]."""
        self._balances.append((start.time, out))

    def viscous(self, old: MotionState, dt: float) -> None:
        """Return None: the step computes its own from the strains at its ends."""

    def step(self, old: MotionState, dt: float, viscous: Viscous | None = None,
             ) -> MotionState | None:
        """Return the state ``dt`` after ``old``, or None. The unknown is the mean displacement. Its
        tangent F(u_m) C F(u_1) is not symmetric. F(u_m) C F(u_m) is factorised, so each iteration
        reduces the error by about the rotation in half a step."""
        equations, settings = self.equations, self.settings
        new = replace(old, time=old.time + dt, step_before=dt,
                      displacement=old.displacement.copy())
        load = self.drive.load_at(old.time + dt / 2)
        moved, pins = self.drive.moves(new)
        moved, pins = None if moved is None else moved / 2, pins / 2
        before = self.model.strains(old.displacement)
        increment: np.ndarray | None = None
        norms: list[float] = []
        made = 0
        for _ in range(settings.max_iterations):
            self._follow(old, new, dt)
            middle = 0.5 * (old.displacement + new.displacement)
            bearing = self._bearing_strain(before, self.model.strains(new.displacement), dt)
            out, inertial = self._imbalance(old, new, dt, load, middle, bearing)
            residual = equations.free_part(out)
            norm = float(np.linalg.norm(residual))
            if not np.isfinite(norm):
                self._failed("the motion grew without bound")
                return None
            reference = float(np.linalg.norm(load) + np.linalg.norm(inertial)
                              + np.linalg.norm(out - residual))
            if (len(norms) > 6 and norm > 0.9 * min(norms)
                    and norms[-1] > 0.9 * min(norms[:-1])):
                self._failed("the iteration does not converge")
                return None
            if increment is not None and self._is_balanced(norm, reference):
                return self._accepted(new, old, out)
            first = increment is None
            if first or (norm > _GOOD_REDUCTION * norms[-1] and made < _FRESH):
                made += 1
                if not self._make_tangent(middle, increment, bearing, dt):
                    self._failed("the stiffness has no positive pivots")
                    return None
            norms.append(norm)
            self.iteration_count += 1
            if first and moved is not None:
                residual = equations.free_part(
                    out - self._bearing.tangent_times(middle, moved))
            increment = self._change(residual, moved, pins)
            moved, pins = None, np.zeros_like(pins)
            new.displacement = new.displacement + 2 * increment
        self._failed(f"no convergence in {settings.max_iterations} iterations")
        return None

    def borne(self, instant: float) -> np.ndarray | None:
        """Return the holds' reactions on nodes [N] [node_count, 3], extrapolated from the last two
        mid-points, where forces balance; None before. At steps' ends unresolved modes ring."""
        if len(self._balances) < 2:
            return None
        (before, was), (last, now) = self._balances
        return now + (now - was) * (instant - last) / (last - before)

    def _bearing_strain(self, before: np.ndarray, after: np.ndarray, dt: float) -> np.ndarray:
        """Return the strain whose linear elastic stress equals that of the step, including
        viscosity."""
        mean, change = 0.5 * (before + after), after - before
        if not self.model.material.is_hookean:
            mean = self._bearing_mean(before, after)
        return mean + self.model.damping.stiffness / dt * change

    def _bearing_mean(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return the strain whose linear elastic stress times the change gives the change of
        energy."""
        model, law = self.model, self.model.material
        lam, mu = model.lame_lambda[:, None], model.lame_mu[:, None]
        change = after - before
        # A motion that grows without bound is detected by its imbalance.
        with np.errstate(over="ignore", invalid="ignore"):
            size = contracted(change, change)
            stress = law.stress(0.5 * (before + after), lam, mu)
            left = (law.energy(after, lam, mu) - law.energy(before, lam, mu)
                    - contracted(stress, change))
        part = np.where(size > _STRAIN_CHANGE**2, left / np.maximum(size, _STRAIN_CHANGE**2), 0.0)
        return hooke_strain(stress + part[..., None] * change, lam, mu)

    def _follow(self, old: MotionState, new: MotionState, dt: float) -> None:
        new.velocity = 2 / dt * (new.displacement - old.displacement) - old.velocity
        self.drive.hold(new)

    def _imbalance(self, old: MotionState, new: MotionState, dt: float, load: np.ndarray,
                   middle: np.ndarray, bearing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return residual and inertial forces."""
        force = self._bearing.internal(middle, viscous=Viscous(0.0, bearing)).force
        inertial = self.model.mass_times(
            (new.velocity - old.velocity) / dt
            + 0.5 * self.model.damping.mass * (new.velocity + old.velocity))
        return load - force - inertial, inertial

    def _make_tangent(self, middle: np.ndarray, increment: np.ndarray | None,
                      bearing: np.ndarray, dt: float) -> bool:
        damping = self.model.damping
        growth = 1 + 2 * damping.stiffness / dt
        model = self._stiff
        memory = bearing - model.bearing_strain(model.strains(middle), Viscous(growth, _NOTHING))
        # The mean strain is quadratic in the increment, with twice the factor of the strain itself.
        mixed = None if increment is None else np.sqrt(2) * increment
        self.tangent = None
        try:
            self.tangent = self.equations.tangent(
                model, middle, increment=mixed, viscous=Viscous(growth, memory),
                mass_factor=4 / dt**2 + 2 * damping.mass / dt)
        except NotPositiveDefiniteError:
            return False
        return True

    def _accepted(self, new: MotionState, old: MotionState,
                  out: np.ndarray) -> MotionState | None:
        if self.model.internal(new.displacement).min_det_f <= 0:
            self._failed("an element would turn inside out", Status.inverted)
            return None
        self.status = Status.converged
        new.acceleration = (new.velocity - old.velocity) / new.step_before
        self._balances.append((0.5 * (old.time + new.time), -out))
        return new


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
            stepper.trouble = Text(f"stretched to {100 * stretch.value:.0f} % ", stretch.at)
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
        message = "" if complete else Text(self.stepper.trouble, "; the largest stretch is ",
                                           stretch.at)
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
