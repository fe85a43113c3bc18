"""Reduced model of a branch: static grasps and their sensitivities in about a millisecond.

Full solutions span a subspace (limber.reduced.basis) in which the StVK force is a cubic
polynomial (limber.reduced.strain_polynomial). ::

    reduced = build_reduced(model, grasp, weights, control_young)  # limber.reduced.model_cache
    state = reduced.with_young(young).solve_static(pose)
    state.strain_energy, state.reaction_force, reduced.displacement(state)

For its error see :mod:`limber.reduced.refresh`.
"""

import copy
import time
from dataclasses import dataclass, field, replace

import numpy as np

from limber.core.errors import InputError
from limber.core.not_none import present
from limber.core.numerics.rigid import pose_between
from limber.mechanics.dynamics.integration import NewmarkSettings
from limber.mechanics.grasp import Grasp, check_pose
from limber.mechanics.materials.materials import RayleighDamping
from limber.reduced.basis import Basis, GraspCoordinates, TrainingPoses
from limber.reduced.strain_polynomial import StrainPolynomial, evaluate_strain, strain_only
from limber.reduced.training import TrainingSettings

# Settings and results of a reduced model and its solves.


@dataclass(frozen=True)
class ReducedSettings:
    """Settings of a reduced model.

    Attributes:
        size: Coordinates, those of the grasp and of the vibrations included.
        vibration_count: Coordinates for vibrations. Where Young's modulus is known they make
            motion in time better and cost statics little; where it changes they spoil the
            position of free ends.
        field_count: Strain fields; None: no projection, exact on the subspace and stiffer.
    """

    size: int = 64
    vibration_count: int = 0
    field_count: int | None = 105
    training: TrainingSettings = TrainingSettings()  # noqa: RUF009 (frozen)


@dataclass(frozen=True)
class ReducedStaticSettings:
    """Settings of the search for a reduced equilibrium.

    Attributes:
        tolerance: Energy that a Newton step would still gain, relative to the strain energy.
        max_iterations: Most Newton iterations per step.
        max_halvings: Most halvings of the path to the pose before another start is tried.
        start_count: How many starts are tried, the given state included.
        novelty_limit: Largest coordinate relative to the training's beyond which the state is
            taken for false and sought again from other starts.
        iteration_limit: Of the whole search; the best that was found by then counts.
    """

    tolerance: float = 1e-10
    max_iterations: int = 25
    max_halvings: int = 4
    start_count: int = 4
    novelty_limit: float = 1.5
    iteration_limit: int = 10_000


@dataclass(frozen=True)
class ReducedState:
    """A static state of the reduced model, at a pose [m, rad].

    Attributes:
        converged: Whether it is a stable equilibrium of the reduced model.
        trusted: Whether it is also within the training of the basis.
        coordinates: q, shape [size].
        young: At the control points [Pa], shape [K].
        strain_energy: Energy of the strain relative to the model's mesh [J].
        energy: Potential of strain and weight, as in StaticResult [J].
        reaction_force, reaction_torque: Of the gripper on the branch [N, Nm], shape [3]; torque
            about the pose's position.
        novelty: Largest mode coordinate relative to the training's.
    """

    converged: bool
    trusted: bool
    coordinates: np.ndarray
    pose: np.ndarray
    young: np.ndarray
    strain_energy: float
    energy: float
    reaction_force: np.ndarray
    reaction_torque: np.ndarray
    novelty: float
    iterations: int
    seconds: float


@dataclass(frozen=True)
class ReducedSensitivities:
    """Derivatives to log Young's modulus at K control points: coordinates [size, K], reaction
    [3, K] [N], [Nm] about the pose's position, strain energy [K] [J] with a carried weight's."""

    coordinates: np.ndarray
    reaction_force: np.ndarray
    reaction_torque: np.ndarray
    strain_energy: np.ndarray


# Arrays that the solver of a reduced model reuses, and the equilibria that it finds.


@dataclass
class Workspace:
    """Arrays that the kernel writes to."""

    strain: np.ndarray
    jacobian: np.ndarray
    gradient: np.ndarray
    tangent: np.ndarray

    @classmethod
    def of(cls, linear: np.ndarray) -> "Workspace":
        count, size = linear.shape
        return cls(np.empty(count), np.empty((count, size)), np.empty(size),
                   np.empty((size, size)))


@dataclass(frozen=True)
class FoundState:
    """One equilibrium that was found, in reduced coordinates ``q``."""

    q: np.ndarray
    converged: bool
    novelty: float
    iterations: int
    potential: float

    def agrees(self, other: "FoundState") -> bool:
        """Whether both are the same equilibrium."""
        return (self.converged and other.converged
                and abs(self.potential - other.potential) <= 1e-6 * abs(other.potential))

    def ranking(self, settings: ReducedStaticSettings) -> tuple[bool, bool, float]:
        """Sort key: converged, then within the training, then the lower potential energy."""
        return not self.converged, self.novelty >= settings.novelty_limit, self.potential


_STATIC = ReducedStaticSettings()
_NO_INCREMENT = np.empty(0)
_LEADING = 20
"""Modes that decide whether a state is like those of the training. Chosen, not measured."""


@dataclass
class ReducedModel:
    """A branch held at one patch, in few coordinates.

    Attributes:
        rest: Rest positions of all nodes [m], shape [node_count, 3].
        polynomial: Strain as a polynomial of the coordinates.
        load: Weight that the mesh's shape does not carry, on the coordinates [N], shape [size].
        weight_stiffness: Of the weight that it carries (limber.mechanics.model) [N/m], shape
            [size, size].
        mass: Mass matrix of the coordinates, shape [size, size].
        control_young: Young's modulus at the control points [Pa], shape [K].
        poses, training_young, energies: Of the training states.
        young_spread: Factor in Young's modulus within which the training sampled.
        extent: Diagonal of the branch's bounding box [m].
        error: Held-out errors measured when it was built (limber.reduced.refresh).
        poisson: Poisson's ratio, if it differs from the training's.
    """

    grasp: Grasp
    rest: np.ndarray
    basis: Basis
    polynomial: StrainPolynomial
    load: np.ndarray
    weight_stiffness: np.ndarray
    mass: np.ndarray
    damping: RayleighDamping
    control_young: np.ndarray
    poses: np.ndarray
    training_young: np.ndarray
    energies: np.ndarray
    young_spread: float
    extent: float
    error: dict[str, float] = field(default_factory=dict)
    poisson: float | None = None

    def __post_init__(self) -> None:
        self.held = GraspCoordinates(self.grasp)
        self.young = self.control_young
        self._largest = self.basis.reach
        # The leading modes: those of vibrations are not in the states, the last are small.
        modes = np.arange(self.size) >= self.basis.lift_count
        self._known = np.flatnonzero(modes & (self._largest > 0))[:_LEADING]
        self._table = TrainingPoses(self.poses, self.extent)
        self._spacing = self._table.spacing()
        self._weight_lower = np.tril(self.weight_stiffness)
        self._set()

    @property
    def size(self) -> int:
        return self.basis.size

    @property
    def jacobian(self) -> np.ndarray:
        """Derivative of the whitened strain where the tangent was evaluated last, [m, size]."""
        return self._work.jacobian

    def with_young(self, young: np.ndarray, poisson: float | None = None) -> "ReducedModel":
        """Return the model with other moduli [K] [Pa] at the control points; InputError if their
        number is wrong, or one not positive."""
        young = np.asarray(young, float)
        if young.shape != self.control_young.shape or not (young > 0).all():
            raise InputError(f"The given Young's moduli are {young}.",
                             f"The model needs {len(self.control_young)} positive values.", "")
        other = copy.copy(self)
        other.young = young
        other.poisson = self.poisson if poisson is None else poisson
        other._set()
        return other

    def with_density(self, factor: float) -> "ReducedModel":
        """Return the model of a branch ``factor`` times as heavy, at rest."""
        other = copy.copy(self)
        other.load = factor * self.load
        other.weight_stiffness = factor * self.weight_stiffness
        other._weight_lower = factor * self._weight_lower
        return other

    def _set(self) -> None:
        moduli = self.polynomial.moduli(self.young, self.poisson)
        self.linear, self.quadratic, self.root = self.polynomial.whitened(moduli)
        self._work = Workspace.of(self.linear)

    def energy_force(self, q: np.ndarray) -> tuple[float, np.ndarray]:
        """Return energy [J], with that of a carried weight, and its derivative [size]."""
        energy, gradient, _ = self.tangent(q)
        return energy, gradient.copy()

    def tangent(self, q: np.ndarray, increment: np.ndarray | None = None,
                velocity: np.ndarray | None = None, by_rate: float = 0.0,
                ) -> tuple[float, np.ndarray, np.ndarray]:
        """Return energy, force and tangent (lower triangle), with the weight that the mesh carries,
        in arrays reused next time. ``increment``: stiffness of the mixed-integration-point Newton.
        ``velocity``, which changes by ``by_rate`` [1/s] with q: stiffness damping acts."""
        work = self._work
        dq = _NO_INCREMENT if increment is None else increment
        moving = _NO_INCREMENT if velocity is None else velocity
        energy = evaluate_strain(self.linear, self.quadratic, q, dq, moving, work.strain,
                                 work.jacobian, work.gradient, work.tangent,
                                 self.damping.stiffness, by_rate)
        lifted = self.weight_stiffness @ q
        work.gradient += lifted
        work.tangent += self._weight_lower
        return energy + 0.5 * float(lifted @ q), work.gradient, work.tangent

    def strain_energy(self, q: np.ndarray) -> float:
        """Return the energy of the strain since the model's mesh [J] at coordinates."""
        return strain_only(self.linear, self.quadratic, q, self._work.strain)

    def energy(self, q: np.ndarray) -> float:
        """Return that energy with the carried weight's [J]."""
        return self.strain_energy(q) + 0.5 * float(q @ self.weight_stiffness @ q)

    def displacement_of(self, q: np.ndarray) -> np.ndarray:
        """Return the displacement of all nodes [m], shape [node_count, 3]."""
        return np.tensordot(q, self.basis.columns, 1)

    def displacement(self, state: ReducedState) -> np.ndarray:
        """Return the displacement of all nodes [m] in a state, shape [node_count, 3]."""
        return self.displacement_of(state.coordinates)

    def load_of(self, nodal_forces: np.ndarray) -> np.ndarray:
        """Return nodal forces [N], shape [node_count, 3], on the coordinates."""
        return np.tensordot(self.basis.columns, nodal_forces, 2)

    def solve_static(self, pose: np.ndarray, *, start: ReducedState | None = None,
                     nodal_forces: np.ndarray | None = None,
                     settings: ReducedStaticSettings = _STATIC,
                     ) -> ReducedState:
        """Return the equilibrium at a pose [m, rad]; look at ``converged`` and ``trusted``. Starts
        from ``start`` or the nearest training state. If that fails, is unstable or outside the
        training, other states on longer paths are tried, and the lowest energy counts."""
        began = time.perf_counter()
        pose = check_pose(pose)
        load = self.load if nodal_forces is None else self.load + self.load_of(nodal_forces)
        best: FoundState | None = None
        iterations = 0
        for at_pose, q in self._starts(pose, start)[:settings.start_count]:
            found = self._follow(at_pose, q, pose, load, settings,
                                 settings.iteration_limit - iterations)
            iterations += found.iterations
            if best is not None and found.agrees(best):
                break  # equal from two starts: unusual, but no accident of the path
            if best is None or (found.ranking(settings) < best.ranking(settings)):
                best = found
            if ((best.converged and best.novelty < settings.novelty_limit)
                    or iterations >= settings.iteration_limit):
                break
        return self._state(present(best, "start"), pose, load, iterations, began, settings)

    def sensitivities(self, state: ReducedState) -> ReducedSensitivities:
        """Differentiate a converged state to log Young's modulus at each control point."""
        from scipy.linalg import cho_factor, cho_solve

        q, free = state.coordinates, slice(self.basis.lift_count, None)
        _, force, lower = self.tangent(q)
        force, tangent = force.copy(), lower + np.tril(lower, -1).T
        strain = np.linalg.solve(self.root.T, self._work.strain)
        slope = np.linalg.solve(self.root.T, self._work.jacobian)
        factor = cho_factor(tangent[free, free])
        columns, forces, energies = [], [], []
        for modulus, part in zip(self.young, self.polynomial.parts(self.poisson), strict=True):
            explicit = modulus * slope.T @ (part @ strain)
            change = np.zeros(self.size)
            change[free] = -cho_solve(factor, explicit[free])
            columns.append(change)
            forces.append(np.concatenate(self.wrench(state.pose, explicit + tangent @ change)))
            energies.append(0.5 * modulus * strain @ part @ strain + force @ change)
        wrench = np.array(forces).T
        return ReducedSensitivities(np.array(columns).T, wrench[:3], wrench[3:],
                                    np.array(energies))

    def nearest(self, pose: np.ndarray, count: int = 4) -> np.ndarray:
        """Return the training states nearest to a pose at this Young's modulus."""
        distance = self._table.distance(pose) + 0.1 * self.extent * np.abs(
            np.log(self.training_young / self.young)).max(axis=1)
        return np.argsort(distance)[:count]

    def covers(self, pose: np.ndarray, novelty: float, limit: float) -> bool:
        """Whether a state lies in the range of the basis: near a training grasp, at a sampled
        Young's modulus, no coordinate over ``limit`` times its largest value in training."""
        factor = np.exp(np.abs(np.log(self.young / self.control_young)).max())
        return bool(self._table.distance(pose).min() <= 3 * self._spacing
                    and factor <= 1.05 * self.young_spread and novelty <= limit)

    def _starts(self, pose: np.ndarray, start: ReducedState | None,
                ) -> list[tuple[np.ndarray, np.ndarray]]:
        near = [(self.poses[k], self.basis.states[k]) for k in self.nearest(pose)]
        if start is None:
            return near
        own = (start.pose, start.coordinates)
        far = TrainingPoses(np.array([start.pose, near[0][0]]), self.extent).distance(pose)
        return [own, *near] if far[0] <= 2 * far[1] else [near[0], own, *near[1:]]

    def _follow(self, at_pose: np.ndarray, q: np.ndarray, pose: np.ndarray, load: np.ndarray,
                settings: ReducedStaticSettings, most: int) -> "FoundState":
        """Newton to the pose in ``most`` iterations; if that fails, the step is halved."""
        iterations, reached, step = 0, 0.0, 1.0
        while True:
            part = min(1.0, reached + step)
            goal = pose if part == 1.0 else pose_between(at_pose, pose, part)
            found = self._newton(q, self.held.at(goal), load, settings,
                                 min(settings.max_iterations, most - iterations))
            iterations += found.iterations
            sound = found.converged and found.novelty < 4 * settings.novelty_limit
            if sound and part == 1.0:
                return replace(found, iterations=iterations)
            if iterations >= most:
                return replace(found, converged=False, iterations=iterations)
            if sound:
                q, reached = found.q, part
                continue
            step /= 2
            if step < 0.5**settings.max_halvings:
                return replace(found, converged=False, iterations=iterations)

    def _newton(self, q: np.ndarray, held: np.ndarray, load: np.ndarray,
                settings: ReducedStaticSettings, most: int) -> "FoundState":
        """Iterate with the grasp's coordinates ``held``."""
        count, q = self.basis.lift_count, q.copy()
        move: np.ndarray | None = held - q[:count]
        increment = None
        for iteration in range(most):
            energy, force, tangent = self.tangent(q, increment)
            right = load[count:] - force[count:]
            if move is not None:
                right = right - tangent[count:, :count] @ move
            step, stable = solved_raised(tangent[count:, count:], right)
            increment = np.concatenate([np.zeros(count) if move is None else move, step])
            q = q + increment
            gain = 0.5 * abs(right @ step)
            if not np.isfinite(gain) or np.abs(q).max() > 1e3 * self._largest.max():
                return FoundState(q, False, np.inf, iteration + 1, np.inf)
            if move is None and gain <= settings.tolerance * max(energy, 1e-12):
                novelty = float((np.abs(q[self._known]) / self._largest[self._known]).max())
                return FoundState(q, stable, novelty, iteration + 1,
                                  self.energy(q) - float(load @ q))
            move = None
        return FoundState(q, False, np.inf, most, np.inf)

    def _state(self, found: "FoundState", pose: np.ndarray, load: np.ndarray, iterations: int,
               began: float, settings: ReducedStaticSettings) -> ReducedState:
        energy, force = self.energy_force(found.q)
        reaction, torque = self.wrench(pose, force - load)
        strain = energy - 0.5 * float(found.q @ self.weight_stiffness @ found.q)
        trusted = found.converged and self.covers(pose, found.novelty, settings.novelty_limit)
        return ReducedState(
            found.converged, trusted, found.q, pose, self.young, strain,
            float(energy - self.load @ found.q), reaction, torque, found.novelty, iterations,
            time.perf_counter() - began)

    def wrench(self, pose: np.ndarray, out: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return force and torque of the gripper from the forces on the grasp coordinates."""
        wrench = self.held.by_pose(pose).T @ out[:self.basis.lift_count]
        return wrench[:3], wrench[3:] if len(wrench) == 6 else np.zeros(3)


def solved_raised(matrix: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, bool]:
    """Solve with the lower triangle; raise the diagonal until it is positive definite. Return the
    solution (NaN if there is none) and whether the diagonal stayed as it was."""
    from scipy.linalg.lapack import dposv

    _, solution, info = dposv(matrix, right, lower=1)
    if info == 0:
        return solution, True
    scale, shift = np.abs(np.diag(matrix)).mean(), 1e-6
    while shift <= 1e3 and np.isfinite(scale):
        _, solution, info = dposv(matrix + shift * scale * np.eye(len(matrix)), right, lower=1)
        if info == 0:
            return solution, False
        shift *= 4
    return np.full(len(right), np.nan), False


# Motion of the reduced model: implicit Newmark steps of about a millisecond.
#
# As in limber.mechanics.dynamics.integration: beta 1/4 and gamma 1/2, mass damping, and stiffness
# damping by the rate of the Green-Lagrange strain, which in the reduced strain coordinates is J
# q' exactly.

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
