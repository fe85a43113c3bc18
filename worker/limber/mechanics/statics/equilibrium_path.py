"""The path from an equilibrium to the target, in steps of adapted length."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Required, TypedDict, Unpack

import numpy as np

from limber.core.errors import InputError, Text
from limber.core.numerics.rigid import pose_between
from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.core.progress import SILENT, Progress
from limber.mechanics.grasp import Grasp, check_pose
from limber.mechanics.linear.equations import Equations, Tangent
from limber.mechanics.model import BranchModel, InternalState
from limber.mechanics.statics.result import StaticResult, StaticSettings, Status
from limber.mechanics.strain import Place, principal_stretch

# A static problem: constraints, loads, target, and the reactions at its end.


@dataclass(frozen=True)
class Target:
    """The target of a solve: displacement of held nodes [node_count, 3] (others unused) and of
    pinned means [pinned, 3] [m], and loads [node_count, 3] [N]."""

    held: np.ndarray
    pins: np.ndarray
    load: np.ndarray


class StaticProblem:
    """One set of constraints; solves for a target from a start."""

    def __init__(self, model: BranchModel, grasp: Grasp | Sequence[Grasp] | None,
                 is_held: bool, settings: StaticSettings):
        self.model, self.settings = model, settings
        self.grasps = ([] if grasp is None else [grasp] if isinstance(grasp, Grasp)
                       else list(grasp))
        self.single = isinstance(grasp, Grasp)
        if is_held and not self.grasps:
            raise InputError("A pose is given without a grasp.", "No node would follow it.",
                             "Also give the grasp.")
        self.is_held = is_held
        self.equations: Equations = model.equations(self.grasps if is_held else ())
        self.mixed = settings.mixed and model.material.has_cubic_force

    def poses(self, pose: np.ndarray) -> list[np.ndarray]:
        poses = np.asarray(pose, float).reshape(-1, 6) if np.size(pose) % 6 == 0 else [pose]
        if len(poses) != len(self.grasps):
            raise InputError(f"{len(poses)} poses are given for {len(self.grasps)} grasps.",
                             "Each grasp needs one pose.", "Give an array [grasps, 6].")
        return [check_pose(item) for item in poses]

    def target(self, pose: np.ndarray | None, grasp_force: np.ndarray | None,
               nodal_forces: np.ndarray | None) -> Target:
        shape = (self.model.mesh.node_count, 3)
        held = np.zeros(shape)
        pins: list[np.ndarray] = []
        load = self.model.weight_force
        if nodal_forces is not None:
            load = load + checked_forces(nodal_forces, shape)
        if pose is not None:
            held, pins = self.constraint(self.poses(pose))
        if grasp_force is not None:
            load = load + self.spread(grasp_force)
        return Target(held, np.reshape(pins, (-1, 3)), load)

    def constraint(self, poses: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
        held, pins = np.zeros((self.model.mesh.node_count, 3)), []
        for grasp, pose in zip(self.grasps, poses, strict=True):
            if grasp.mode == "rigid":
                held[grasp.nodes] = grasp.displacement(self.model.mesh.nodes, pose)
            else:
                pins.append(pose[:3] - grasp.centre)
        return held, pins

    def spread(self, grasp_force: np.ndarray) -> np.ndarray:
        """Return nodal forces of forces [N] at the grasps, spread over the patches."""
        forces = np.asarray(grasp_force, float).reshape(-1, 3)
        if self.is_held or len(forces) != len(self.grasps) or not np.isfinite(forces).all():
            raise InputError(f"{len(forces)} grasp forces are given for "
                             f"{len(self.grasps)} grasps.",
                             "Each grasp needs a force, and a grasp with a force has no pose.",
                             "Give an array [grasps, 3] [N] and omit the poses.")
        load = np.zeros((self.model.mesh.node_count, 3))
        for grasp, force in zip(self.grasps, forces, strict=True):
            load[grasp.nodes] += grasp.weights[:, None] * force
        return load

    def displacement_of(self, start: "StaticResult | np.ndarray | None") -> np.ndarray:
        if start is None:
            return np.zeros((self.model.mesh.node_count, 3))
        values = start.displacement if isinstance(start, StaticResult) else start
        return checked_forces(values, (self.model.mesh.node_count, 3), "start displacements")


def strain_warnings(stretch: Place) -> list[str]:
    """Return a warning if the largest stretch exceeds the strength of wood, else an empty tuple."""
    if stretch.value <= 1.5:
        return []
    return [Text(f"The strain reaches {100 * (stretch.value - 1):.0f} % ", stretch.at, ", far more "
                 "than wood withstands. Check the units of the loads and of Young's modulus.")]


class HowFound(TypedDict, total=False):
    """The fields of a result that state how it was found; see StaticResult."""

    status: Required[Status]
    iterations: Required[int]
    residual_history: Required[list[float]]
    seconds: Required[float]
    reached: float
    message: str
    warnings: list[str]
    snapped_at: list[float]
    uncertainty: str


def make_result(problem: StaticProblem, displacement: np.ndarray, state: InternalState,
                load: np.ndarray, **found: Unpack[HowFound]) -> StaticResult:
    """Return a result with the reactions that belong to a displacement."""
    model = problem.model
    positions = model.mesh.nodes + displacement
    out = state.force - load
    base = base_forces(model, out)
    pose, force, torque = None, np.zeros(3), np.zeros(3)
    if problem.grasps:
        poses = [g.pose_of(model.mesh.nodes, displacement) for g in problem.grasps]
        parts = [grasp_wrench(problem, grasp, positions, out, p[:3])
                 for grasp, p in zip(problem.grasps, poses, strict=True)]
        pose, force, torque = (np.array(poses), np.array([p[0] for p in parts]),
                               np.array([p[1] for p in parts]))
        if problem.single:
            pose, force, torque = pose[0], force[0], torque[0]
    return StaticResult(
        displacement=displacement, pose=pose, strain_energy=state.strain_energy,
        energy=state.energy - float((model.weight_force * displacement).sum()),
        reaction_force=force, reaction_torque=torque, base_force=base.sum(axis=0),
        base_torque=np.cross(positions, base).sum(axis=0), min_det_f=state.min_det_f, **found)


def base_forces(model: BranchModel, out: np.ndarray) -> np.ndarray:
    """Return the base's force on its nodes, 0 elsewhere; ``out`` [node_count, 3] [N] is internal
    and inertial force less loads."""
    base = np.where(model.fixed[:, None], out, 0.0)
    return base if model.prestress is None else base + model.prestress.total.base


def grasp_wrench(problem: StaticProblem, grasp: Grasp, positions: np.ndarray, out: np.ndarray,
                 centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return force [N] and torque [N m] about ``centre`` of a gripper on the branch; ``out``
    [node_count, 3] [N] is internal force less loads."""
    if not problem.is_held:
        return np.zeros(3), np.zeros(3)
    forces = out[grasp.nodes]
    if grasp.mode == "point":
        total = grasp.weights @ forces / (grasp.weights @ grasp.weights)
        forces = grasp.weights[:, None] * total
    return forces.sum(axis=0), np.cross(positions[grasp.nodes] - centre, forces).sum(axis=0)


def checked_forces(values: np.ndarray, shape: tuple[int, ...],
                   name: str = "nodal forces") -> np.ndarray:
    """Return a nodal field as floats. InputError if the shape is wrong, or a value is not
    finite."""
    values = np.asarray(values, float)
    if values.shape != shape or not np.isfinite(values).all():
        raise InputError(f"The {name} have shape {values.shape} or are not finite.",
                         f"The mesh needs {shape}.", "Give three numbers for each node.")
    return values


# The end of a path of stable equilibria: a column buckles, a bow turns over.
#
# No small step continues the path there. The branch moves as in a viscous fluid until it is at
# rest. If that state is a saddle (a straight column under too much load), it is perturbed along the
# mode of negative tangent stiffness and moves on to the bent state.


# Chosen on the columns and bows of tests/mechanics/statics; none was measured in a series.
_FIRST_DRAG = 1e-5
"""Drag of the first creep step, as a fraction of the mean diagonal of the stiffness."""
_CREEPS = 60
"""Most creep steps to the equilibrium."""
_CREEP_ITERATIONS = 9
"""Most Newton iterations per creep step; if it takes more, it is repeated with more drag."""
_RESTING = 1e-2
"""Imbalance relative to loads and reactions below which the branch is at rest or on a saddle."""
_PUSHES = 3
"""Most perturbations off saddles."""
_PUSH = 2e-3
"""Size of the perturbation off a saddle, as a fraction of the branch's extent."""
_MODE_ITERATIONS = 30
"""Inverse iterations for the unstable mode of a saddle."""


def settle(path: "Path", part: float) -> float | None:
    """Let the branch snap to its equilibrium at the fraction ``part`` of the path, by implicit
    Euler steps of the potential's gradient flow, in which it only falls. Return the step's length;
    None if the branch does not come to rest."""
    if path.model.material.is_linear:
        return None
    target, pins = path.constraint_at(part)
    load, before = path.load_at(part), (path.status, path.trouble)
    trial, drag, pushes = path.displacement, _FIRST_DRAG, 0
    for _ in range(_CREEPS):
        if path.iterations > path.settings.total_iterations:
            break
        crept = _creep(path, trial, target, pins, load, drag)
        if crept is None:
            drag *= 8
            if drag > 1:
                break
            continue
        trial, quick, error, stable, diagonal_norm = crept
        if error < _RESTING and not stable and pushes < _PUSHES:
            trial, pushed = pushed_off(path.model, path.equations, trial, load)
            pushes += pushed
        elif error < _RESTING and stable:
            taken = path.correct(trial, np.zeros_like(trial), part, diagonal_norm,
                                 stable)
            if taken is not None:
                path.snaps.append((path.reached + taken, pushes > 0))
                return taken
        drag *= 0.25 if quick else 0.7
    path.status, path.trouble = before
    return None


def _creep(path: "Path", start: np.ndarray, target: np.ndarray, pins: np.ndarray,
           load: np.ndarray, drag: float,
           ) -> tuple[np.ndarray, bool, float, bool, float] | None:
    """Return the state after one creep step, whether it converged quickly, and its imbalance. And
    whether its tangent is positive definite and the norm of its diagonal [N/m]."""
    model, equations, held = path.model, path.equations, path.equations.held
    moved = np.where(held[:, None], target - start, 0.0)
    now = np.array([g.weights @ start[g.nodes] for g in equations.pinned]).reshape(-1, 3)
    trial, increment, honey = start, None, 0.0
    for count in range(_CREEP_ITERATIONS):
        state = model.internal(trial)
        out = load - state.force
        pull = equations.free_part(out - honey * (trial - start))
        norm = float(np.linalg.norm(pull))
        reference = float(np.linalg.norm(out - equations.free_part(out)) + np.linalg.norm(load))
        if not np.isfinite(norm):
            return None
        if increment is not None and norm <= 1e-4 * reference:
            left = float(np.linalg.norm(equations.free_part(out)))
            # Without load there is no scale for the imbalance.
            part = left / max(reference, 1e-300)
            tangent = equations.tangent(model, trial)
            return (trial, count <= 4, part, tangent.is_positive_definite,
                    tangent.diagonal_norm)
        path.iterations += 1
        try:
            tangent = equations.tangent(model, trial, increment=increment, drag=drag)
        except NotPositiveDefiniteError:
            return None
        if not tangent.is_positive_definite:
            return None
        honey = tangent.drag
        if increment is None:
            right = out - model.tangent_times(start, moved) if moved.any() else out
            increment = tangent.solve(right, pins - now) + moved
        else:
            increment = tangent.solve(pull)
        # Its memory is reused by the next one.
        del tangent
        trial = trial + increment
    return None


def pushed_off(model: BranchModel, equations: Equations, state: np.ndarray,
               load: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return a state perturbed off a saddle to the side where the potential falls more. And whether
    there was a mode to push it along."""
    mode, curvature = lowest_mode(model, equations, state)
    if curvature >= 0:
        return state, False
    push = _PUSH * model.extent * mode / np.linalg.norm(mode, axis=1).max()
    sides = [state + push, state - push]
    potentials = [model.internal(side).energy - float((load * side).sum())
                  for side in sides]
    return sides[int(np.argmin(potentials))], True


def lowest_mode(model: BranchModel, equations: Equations, state: np.ndarray,
                ) -> tuple[np.ndarray, float]:
    """Return the mode of least stiffness [node_count, 3] and its Rayleigh quotient [N/m], by
    inverse iteration on the tangent with a raised diagonal, which has the same eigenvectors."""
    tangent = equations.tangent(model, state)
    mode = np.random.default_rng(0).normal(size=state.shape)
    for _ in range(_MODE_ITERATIONS):
        mode = tangent.solve(mode)
        mode /= np.linalg.norm(mode)
    return mode, float((mode * model.tangent_times(state, mode)).sum())


_SOFT_DET_F = 0.75
"""Relative volume below which St. Venant-Kirchhoff itself is taken to have collapsed. In pure
compression it carries most at a stretch of 1 / sqrt(3) = 0.58; a branch buckles before. Chosen, not
measured.
"""
_LOST = 0.25
"""Largest fraction of the change of the potential in a step that the work may not account for. A
step above it counts as a jump if its tangents were not positive definite. Of 250 such steps of far
pulls of a forked branch, 1 % are above; a bow that turns over loses 0.74.
"""
_SNAP = 1 / 64
"""Fraction of the path of a step in which the branch snaps. Chosen, not measured."""
_FALLS = 0.3
"""Fraction of the imbalance that a step with an old factorisation may leave. A new one costs six
times as much and reduces it further. Chosen, not measured.
"""


class Path:
    """The path from a start to a target, in steps of adapted length."""

    def __init__(self, problem: StaticProblem, begin: np.ndarray, goal: Target,
                 pose: np.ndarray | None):
        self.problem, self.goal, self.pose = problem, goal, pose
        self.model, self.equations = problem.model, problem.equations
        self.settings = problem.settings
        self.started = time.perf_counter()
        self.begin, self.displacement = begin, begin.copy()
        self.state: InternalState = self.model.internal(begin)
        # Imbalance of the start under the target loads; it is released along the path.
        self.imbalance = self.equations.free_part(goal.load - self.state.force)
        self._begin_constraint(begin)
        self.history: list[float] = []
        self.iterations = 0
        self.reached = 0.0
        self.trouble = ""
        # Where the branch snapped, as a fraction of the path, and whether it buckled there.
        self.snaps: list[tuple[float, bool]] = []
        self.status = Status.stalled

    def _begin_constraint(self, begin: np.ndarray) -> None:
        problem, nodes = self.problem, self.model.mesh.nodes
        self.begin_poses = None
        self.begin_pins = np.array([g.weights @ begin[g.nodes] for g in self.equations.pinned]
                                   ).reshape(-1, 3)
        self.begin_rest = np.where(self.equations.held[:, None], begin, 0.0)
        if self.pose is not None:
            self.end_poses = problem.poses(self.pose)
            self.begin_poses = [g.pose_of(nodes, begin) for g in problem.grasps]
            rigid, _ = problem.constraint(self.begin_poses)
            # The part of the start that is not rigid is released along the path as well.
            self.begin_rest = self.begin_rest - rigid

    def constraint_at(self, part: float) -> tuple[np.ndarray, np.ndarray]:
        """Return displacements of held nodes and pinned means at the fraction ``part``."""
        pins = self.begin_pins + part * (self.goal.pins - self.begin_pins)
        if part >= 1.0:
            return self.goal.held, self.goal.pins
        if self.begin_poses is None:
            return self.begin_rest + part * (self.goal.held - self.begin_rest), pins
        poses = [pose_between(a, b, part)
                 for a, b in zip(self.begin_poses, self.end_poses, strict=True)]
        return self.problem.constraint(poses)[0] + (1 - part) * self.begin_rest, pins

    def run(self, progress: Progress, guess: np.ndarray | None = None,
            strain: np.ndarray | None = None) -> StaticResult:
        """Follow the path; start from a ``guess`` of its end [node_count, 3] if there is one.
        ``strain`` [tet_count, q, 6] belongs to the guess, if known."""
        step = 1.0
        if guess is not None and not self._leap(guess, strain):
            step = 0.5
        while self.reached < 1.0:
            progress(self.reached, "seeking equilibrium", iteration=self.iterations)
            if self.iterations > self.settings.total_iterations:
                self.trouble = f"not finished after {self.iterations} iterations"
                return self._result()
            part = min(1.0, self.reached + step)
            before = self.iterations
            taken = self._step(part)
            if taken is None:
                step = (part - self.reached) / 2
                if step < self.settings.min_step:
                    if not self.settings.snap:
                        return self._result()
                    taken = settle(self, min(1.0, self.reached + _SNAP))
                    if taken is None:
                        return self._result()
                    self.reached, step = self.reached + taken, _SNAP
                continue
            quick = self.iterations - before <= 6
            step = max(taken, step) * (2.0 if quick else 1.0) if taken == part - self.reached \
                else taken * (1.5 if quick else 1.0)
            self.reached += taken
            if self.reached > 1 - 1e-12:
                self.reached = 1.0
        self.status = Status.converged
        return self._result()

    def _step(self, part: float) -> float | None:
        """Try a step to the fraction ``part`` of the path; return its length, None if it failed."""
        settings, equations, held = self.settings, self.equations, self.equations.held
        try:
            tangent = equations.exact_tangent(self.model, self.displacement)
        except NotPositiveDefiniteError:
            self.trouble = "the stiffness has no positive pivots"
            return None
        target, pins = self.constraint_at(part)
        increment = self._predict(tangent, target, pins, part)
        longest = np.linalg.norm(increment, axis=1).max()
        limit = settings.max_step * self.model.extent
        if longest > limit:
            part = self.reached + (part - self.reached) * limit / longest
            target, pins = self.constraint_at(part)
            increment = self._predict(tangent, target, pins, part)
        trial = self.displacement + increment
        trial[held] = target[held]
        diagonal_norm, steady = tangent.diagonal_norm, tangent.is_positive_definite
        if settings.keeps_factor and steady:
            trial, increment = self._gone_on(trial, increment, tangent, self.load_at(part))
        # Its memory is reused by the tangents along the path.
        del tangent
        return self.correct(trial, increment, part, diagonal_norm, steady)

    def _leap(self, guess: np.ndarray, strain: np.ndarray | None) -> bool:
        """Try to reach the end from nearby; return whether it was reached."""
        begin = self.displacement
        trial = np.where(self.equations.held[:, None], self.goal.held, guess)
        for grasp, pin in zip(self.equations.pinned, self.goal.pins, strict=True):
            trial[grasp.nodes] += pin - grasp.weights @ trial[grasp.nodes]
        longest = np.linalg.norm(trial - begin, axis=1).max()
        # No linear step leads there, so mixed points have no spurious strain to remove.
        if longest <= self.settings.max_step * self.model.extent and self.correct(
                trial, np.zeros_like(trial), 1.0, 0.0, True, strain) is not None:
            self.reached = 1.0
            return True
        self.status, self.trouble = Status.stalled, ""
        return False

    def load_at(self, part: float) -> np.ndarray:
        return self.goal.load - (1.0 - part) * self.imbalance

    def _predict(self, tangent: Tangent, target: np.ndarray, pins: np.ndarray,
                 part: float) -> np.ndarray:
        equations, held = self.equations, self.equations.held
        moved = np.where(held[:, None], target - self.displacement, 0.0)
        right = self.load_at(part) - self.state.force
        if moved.any():
            right = right - self.model.tangent_times(self.displacement, moved)
        now = np.array([g.weights @ self.displacement[g.nodes] for g in equations.pinned])
        return tangent.solve(right, pins - now.reshape(-1, 3)) + moved

    def correct(self, trial: np.ndarray, increment: np.ndarray, part: float,
                diagonal_norm: float, steady: bool, strain: np.ndarray | None = None,
                ) -> float | None:
        """Iterate to equilibrium at the fraction ``part`` of the path; length of the step or None.
        The ``diagonal_norm`` [N/m] of a nearby tangent, ``steady`` if positive definite, sets the
        round-off; ``strain`` [tet_count, q, 6] is one known better than from ``trial``."""
        settings, load = self.settings, self.load_at(part)
        best, worse = np.inf, 0
        stable = True
        for _ in range(settings.max_iterations):
            state, residual, norm, reference = self._imbalance(trial, load)
            if not np.isfinite(norm):
                self.trouble = "the displacements grew without bound"
                return None
            self.history.append(norm / reference if reference else 0.0)
            if norm <= self._enough(reference, diagonal_norm):
                return self._accept(trial, state, part, stable, steady)
            worse = worse + 1 if norm > 0.9 * best else 0
            best = min(best, norm)
            if worse > 5:
                self.trouble = "Newton's iteration does not converge"
                return None
            self.iterations += 1
            solved = self._newton_step(trial, increment, strain, load, residual)
            if solved is None:
                return None
            strain = None
            trial, increment, stable, diagonal_norm = solved
            steady = steady and stable
        self.trouble = f"no convergence in {settings.max_iterations} iterations"
        return None

    def _newton_step(self, trial: np.ndarray, increment: np.ndarray, strain: np.ndarray | None,
                     load: np.ndarray, residual: np.ndarray,
                     ) -> tuple[np.ndarray, np.ndarray, bool, float] | None:
        """Return the state after a step, its increment, and whether the tangent is stable and its
        norm. The tangent itself is freed, so at most one of a large mesh is in memory."""
        mixed = self.problem.mixed
        try:
            tangent = self.equations.tangent(
                self.model, trial, increment=increment if mixed and strain is None else None,
                strain=strain if mixed else None)
        except NotPositiveDefiniteError:
            self.trouble = "the stiffness has no positive pivots"
            return None
        increment = tangent.solve(residual)
        if not mixed:
            increment = self._searched(trial, increment, load, residual)
        trial, stable = trial + increment, tangent.is_positive_definite
        if self.settings.keeps_factor and stable:
            trial, increment = self._gone_on(trial, increment, tangent, load)
        return trial, increment, stable, tangent.diagonal_norm

    def _gone_on(self, trial: np.ndarray, increment: np.ndarray, tangent: Tangent,
                 load: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the state after further steps with the same factorisation, and the last increment.
        A step is taken only if it removes most of the imbalance."""
        _, residual, norm, reference = self._imbalance(trial, load)
        while norm > self._enough(reference, tangent.diagonal_norm):
            further = tangent.solve(residual)
            _, residual, left, reference = self._imbalance(trial + further, load)
            if not left <= _FALLS * norm:
                break
            trial, increment, norm = trial + further, further, left
        return trial, increment

    def _imbalance(self, trial: np.ndarray, load: np.ndarray,
                   ) -> tuple[InternalState, np.ndarray, float, float]:
        """Return the state at ``trial``, the imbalance [N], its norm, and the norm of loads and
        reactions."""
        state = self.model.internal(trial)
        out = load - state.force
        residual = self.equations.free_part(out)
        return (state, residual, float(np.linalg.norm(residual)),
                float(np.linalg.norm(out - residual) + np.linalg.norm(load)))

    def _enough(self, reference: float, diagonal_norm: float) -> float:
        return max(self.settings.tolerance * reference, self._floor(diagonal_norm))

    def _searched(self, trial: np.ndarray, increment: np.ndarray, load: np.ndarray,
                  residual: np.ndarray) -> np.ndarray:
        """Return the increment, shortened until the work of the residual along it has decreased."""
        slope = float((residual * increment).sum())
        length = 1.0
        for _ in range(8):
            state = self.model.internal(trial + length * increment)
            left = float((self.equations.free_part(load - state.force) * increment).sum())
            if abs(left) < 0.9 * abs(slope) and np.isfinite(left):
                break
            length *= 0.5
        return length * increment

    def _floor(self, diagonal_norm: float) -> float:
        # Differences of displacements in an element carry a round-off error of about one unit each.
        return 8 * float(np.finfo(float).eps) * diagonal_norm * self.model.mean_edge

    def _accept(self, trial: np.ndarray, state: InternalState, part: float,
                stable: bool, steady: bool) -> float | None:
        if state.min_det_f <= 0:
            self.status, self.trouble = Status.inverted, "an element would turn inside out"
            return None
        # The iteration's tangents belong to intermediate states; the exact one of the last state
        # decides.
        asked = part >= 1.0 or not stable or self.settings.keeps_factor
        if asked and not self.equations.exact_tangent(self.model, trial).is_positive_definite:
            self.status, self.trouble = Status.unstable, "the equilibrium found is not stable"
            return None
        if not steady and self._lost(trial, state, part) > _LOST:
            self.trouble = "the branch would jump to another equilibrium"
            return None
        if (stretch := principal_stretch(self.model, trial)).value > self.settings.stretch_limit:
            self.status = Status.torn
            self.trouble = Text(f"stretched to {100 * stretch.value:.0f} % of its length ",
                                stretch.at)
            return None
        self.displacement, self.state = trial, state
        taken = part - self.reached
        self.status = Status.stalled
        return taken

    def _lost(self, trial: np.ndarray, state: InternalState, part: float) -> float:
        """Return the potential's fall in a step beyond the work of forces and loads, relative to
        both. Between neighbouring equilibria it is only the trapezium rule's error."""
        before, now = self.load_at(self.reached), self.load_at(part)
        moved = trial - self.displacement
        work = 0.5 * float(((self.state.force - before + state.force - now) * moved).sum()
                           - ((trial + self.displacement) * (now - before)).sum())
        change = (state.energy - float((now * trial).sum())
                  - self.state.energy + float((before * self.displacement).sum()))
        return (work - change) / max(abs(work) + abs(change), float(np.finfo(float).tiny))

    def _result(self) -> StaticResult:
        stretch = principal_stretch(self.model, self.displacement)
        message = "" if self.status is Status.converged else Text(
            self.trouble, f"; stopped at {100 * self.reached:.1f} % of the path, where the "
            "largest stretch of the branch is ", stretch.at,
            f" ({100 * (stretch.value - 1):.1f} %)", self._softening())
        warnings = strain_warnings(stretch) + buckling_warnings(self.snaps)
        load = self.load_at(self.reached)
        return make_result(self.problem, self.displacement, self.state, load,
                           status=self.status, message=message, warnings=warnings,
                           iterations=self.iterations, residual_history=self.history,
                           seconds=time.perf_counter() - self.started, reached=self.reached,
                           snapped_at=[part for part, _ in self.snaps])

    def _softening(self) -> str:
        """Warn if the material law collapses rather than the branch."""
        advice = self.model.material.softening
        if not advice or self.state.min_det_f > _SOFT_DET_F:
            return ""
        return f"; it is compressed to {100 * self.state.min_det_f:.0f} % of its volume, {advice}"


def buckling_warnings(snaps: list[tuple[float, bool]]) -> list[str]:
    """Return a warning if the branch left a saddle along the path, else an empty tuple."""
    where = [f"{100 * part:.0f} %" for part, buckled in snaps if buckled]
    if not where:
        return []
    return [f"A straight part buckled at {where[0]} of the path. The side is arbitrary: another "
            "equilibrium with about the same energy exists."]


# Whether a branch that snapped would return: the same path, followed backwards.
#
# A straight part that buckles straightens again. A bow that turned over stays so: start and end are
# two stable states of one grasp, and the history of the branch decides which one is real.

_SAME = 1e-3
"""Distance, as a fraction of the branch's extent, below which the start counts as reached."""


def why_uncertain(path: Path, result: StaticResult) -> str:
    """Return why a converged result may not be the only state of its grasp, or an empty string.
    Free unless the branch snapped; then it costs as much as the path itself."""
    if not path.snaps:
        return ""
    where = f"the branch snapped through at {100 * path.snaps[0][0]:.0f} % of the path"
    begin, grasps = path.begin, path.problem.grasps
    pose = None if path.pose is None else np.array(
        [grasp.pose_of(path.model.mesh.nodes, begin) for grasp in grasps])
    goal = Target(np.where(path.equations.held[:, None], begin, 0.0), path.begin_pins,
                  path.goal.load - path.imbalance)
    back = Path(path.problem, result.displacement, goal, pose).run(SILENT)
    if not back.converged:
        return f"{where}, and no return path was found ({back.message})"
    away = float(np.linalg.norm(back.displacement - begin, axis=1).max())
    if away <= _SAME * path.model.extent:
        return ""
    return (f"{where}, and on the return path it ends {1e3 * away:.0f} mm from its start: another "
            "stable state exists for the same grasp")
