"""One implicit step that conserves energy exactly, for any amplitude and step size.

With the mean u_m of two successive displacements and the mean velocity,

    M (v_1 - v_0) / dt + alpha M (v_0 + v_1) / 2 + f = load,     (u_1 - u_0) / dt = (v_0 + v_1) / 2,

where f is the integral of F(u_m) S grad N. S is the stress of the mean of the strains E_0 and E_1,
not of the strain of the mean (Simo and Tarnow 1992). F(u_m) times the change of F is exactly the
change of E, so the work of f equals the change of the energy: no energy is gained, and damping only
removes it. A rigid rotation of any size has no strain at either end, hence no stress in between. If
the energy is not quadratic in E, S has a component along E_1 - E_0 that makes up the difference
(Gonzalez 2000).
"""

from collections import deque
from dataclasses import replace

import numpy as np

from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.mechanics.dynamics.drive import Drive
from limber.mechanics.dynamics.motion import MotionSettings
from limber.mechanics.dynamics.stepper import Stepper
from limber.mechanics.linear.equations import Viscous
from limber.mechanics.materials.law import contracted, hooke_strain
from limber.mechanics.motion_state import MotionState
from limber.mechanics.solve_status import Status

_STRAIN_CHANGE = 1e-6
"""Below this change of strain in a step, Gonzalez' correction (its cube) is round-off."""
_GOOD_TANGENT = 0.3
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
        """Return the state ``dt`` after ``old``, or None if it is not found.

        Newton's unknown is the mean displacement. Its tangent F(u_m) C F(u_1) is not symmetric. The
        factorised matrix is F(u_m) C F(u_m), so each iteration reduces the error by a factor of
        about the rotation in half a step.
        """
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
            if first or (norm > _GOOD_TANGENT * norms[-1] and made < _FRESH):
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
        """Return the reactions of the holds on each node [N], shape [node_count, 3].

        Extrapolated from the mid-points of the last two steps, where forces balance; None before
        there are two. At the ends of a step, modes that the mesh cannot resolve ring.
        """
        if len(self._balances) < 2:
            return None
        (before, was), (last, now) = self._balances
        return now + (now - was) * (instant - last) / (last - before)

    def _bearing_strain(self, before: np.ndarray, after: np.ndarray, dt: float) -> np.ndarray:
        """Return the strain whose linear elastic stress equals that of the step, including
        viscosity.
        """
        mean, change = 0.5 * (before + after), after - before
        if not self.model.material.is_hookean:
            mean = self._bearing_mean(before, after)
        return mean + self.model.damping.stiffness / dt * change

    def _bearing_mean(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return the strain whose linear elastic stress times the change gives the change of
        energy.
        """
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
