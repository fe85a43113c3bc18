"""Derivatives along a motion, step by step, with the tangent of each step."""

from collections.abc import Sequence

import numpy as np

from limber.mechanics.dynamics.drive import Drive
from limber.mechanics.dynamics.motion import NewmarkSettings
from limber.mechanics.linear.equations import Tangent, Viscous
from limber.mechanics.model import MotionState
from limber.mechanics.sensitivities import (
    ParameterSet,
    explicit_forces,
    reactions,
    refined_solve,
    static_sensitivities,
    viscous_force,
)
from limber.mechanics.statics.result import StaticResult


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
