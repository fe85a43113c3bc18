"""Motion of the reduced model: implicit Newmark steps of about a millisecond.

As in limber.mechanics.dynamics.integration: beta 1/4 and gamma 1/2, mass damping, and stiffness
damping by the rate of the Green-Lagrange strain, which in the reduced strain coordinates is
J q' exactly.
"""

from dataclasses import dataclass

import numpy as np

from limber.core.numerics.rigid import pose_between
from limber.mechanics.dynamics.integration import NewmarkSettings
from limber.mechanics.grasp import check_pose
from limber.reduced.reduced_model import ReducedModel, ReducedState, solved_raised

_NEAR = 1e-5
"""Next gain of energy over the energy from which Newton is taken to close in; chosen."""
_JUMP = 2e-3
"""Deviation of the grasp from its old velocity, as a fraction of the extent, that a first step
allows for. Chosen, not measured.
"""
_LIVE_HALVINGS = 3
"""Halvings of a step that fails, at most: 8 steps of about a millisecond fit into one of 60 Hz."""
_NEWMARK = NewmarkSettings()


@dataclass
class ReducedMotionState:
    """One instant: coordinates, their velocity and acceleration, shape [size] each."""

    time: float
    coordinates: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


class ReducedStepper:
    """Steps the reduced model through time, driven at the grasp. A static ``state`` starts at rest;
    ``nodal_forces`` [node_count, 3] [N] are dead loads besides gravity."""

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
        """Energy of the strain relative to the model's mesh [J]."""
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
        """Step to a pose [m, rad] reached in ``step`` [s]; return whether it converged. The grasp
        moves straight, without acceleration: noise of live poses must not shake the branch."""
        return self._move(check_pose(pose), step, _LIVE_HALVINGS)

    def _move(self, pose: np.ndarray, step: float, halvings: int) -> bool:
        held = self.model.held.at(pose)
        count = len(held)
        velocity = (held - self.state.coordinates[:count]) / step
        if self.step(held, velocity, np.zeros(count), step, foresee=True):
            self.pose = pose
            return True
        # A branch compressed along its axis buckles within the step; in shorter steps inertia
        # decides where to.
        return halvings > 0 and self.pose is not None and all(
            self._move(goal, step / 2, halvings - 1)
            for goal in (pose_between(self.pose, pose, 0.5), pose))

    def step(self, held: np.ndarray, held_velocity: np.ndarray, held_acceleration: np.ndarray,
             step: float, *, foresee: bool = False) -> bool:
        """Take one Newmark step with the grasp coordinates given at its end. With ``foresee`` the
        first iteration takes a jump of the grasp into account: for motion that is not smooth."""
        model, old, settings = self.model, self.state, self.settings
        count = len(held)
        free = slice(count, None)
        by_rate = settings.gamma / (settings.beta * step)
        by_mass = 1 / (settings.beta * step**2)
        # Without the acceleration: that of the stiff coordinates swings from step to step.
        q = old.coordinates + step * old.velocity
        shift = held - q[:count]
        jump: np.ndarray | None = shift
        if not foresee or np.abs(shift).max() <= _JUMP * model.extent:
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
