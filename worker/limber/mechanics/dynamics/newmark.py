"""One implicit Newmark step: mixed-point Newton that reuses a tangent while it converges."""

from dataclasses import replace

import numpy as np

from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.mechanics.dynamics.drive import Drive
from limber.mechanics.dynamics.motion import NewmarkSettings
from limber.mechanics.dynamics.stepper import Stepper
from limber.mechanics.linear.equations import Viscous
from limber.mechanics.motion_state import MotionState
from limber.mechanics.solve_status import Status

_GOOD_TANGENT = 1e-3
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
        """Return the state ``dt`` after ``old``, or None if it is not found.

        The first solve starts from the previous balanced state, not from an extrapolation in time:
        linear extrapolation stretches rotating parts. Mixed-point Newton then works as well as in
        statics.
        """
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
            keep = self._may_keep(dt) if first else (
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

    def _may_keep(self, dt: float) -> bool:
        """Whether the last tangent fits the state before this step.

        It does if its own solve reduced the residual a thousandfold.
        """
        return (self.settings.keep_factor > 0 and self.tangent is not None
                and self._tangent_step == dt and self._tangent_error <= _GOOD_TANGENT)

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
