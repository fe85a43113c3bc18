"""Static equilibrium: mixed-integration-point Newton along a path of small steps.

The path leads from a state in balance to the wanted one: prescribed poses move, and the imbalance
that the start has under the wanted loads is let go in proportion. Each step starts with a linear
solve of the whole increment (tangent predictor); then Newton, whose geometric stiffness uses the
stress that the last linearisation predicted (Magisano, Leonetti and Garcea 2017), which lets a
slender branch take steps several times as long. A step that fails is halved.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from limber.errors import InputError
from limber.mechanics.equations import Equations
from limber.mechanics.factor import NotPositiveDefiniteError
from limber.mechanics.grasp import Grasp, check_pose, pose_between
from limber.mechanics.materials import Material
from limber.mechanics.model import BranchModel, InternalState
from limber.mechanics.static_result import DEFAULT_SETTINGS, StaticResult, StaticSettings
from limber.mechanics.strain import Place, principal_stretch
from limber.progress import SILENT, Progress

_SNAP = 1 / 64
"""Part of the way taken when the branch has to snap."""
_FIRST_DRAG = 1e-5
_CREEPS = 60
_CREEP_ITERATIONS = 9
_RESTING = 1e-2


@dataclass(frozen=True)
class Target:
    """Where a solve leads: held nodes, means of pinned patches, loads.

    Attributes:
        held: Displacement of held nodes [m] (others unused), shape [node_count, 3].
        pins: Displacement of the pinned means [m], shape [pinned, 3].
        load: Forces on the nodes [N], shape [node_count, 3].
    """

    held: np.ndarray
    pins: np.ndarray
    load: np.ndarray


def solve_static(model: BranchModel, *, grasp: Grasp | Sequence[Grasp] | None = None,
                 pose: np.ndarray | None = None, grasp_force: np.ndarray | None = None,
                 nodal_forces: np.ndarray | None = None,
                 start: "StaticResult | np.ndarray | None" = None,
                 settings: StaticSettings = DEFAULT_SETTINGS,
                 progress: Progress = SILENT) -> StaticResult:
    """Find the equilibrium of a branch; never raises for want of convergence.

    Args:
        grasp: The grasp, or several.
        pose: Pose of the grasp [m, rad], shape [6] ([g, 6] for several). None: it is not held.
        grasp_force: Force [N] of the gripper on the branch instead, spread over the patch,
            shape [3] ([g, 3]).
        nodal_forces: Dead loads [N], shape [node_count, 3], besides gravity.
        start: State to start from; default the rest shape.

    Raises:
        InputError: arguments that do not fit each other.
    """
    problem = _Problem(model, grasp, pose is not None, settings)
    goal = problem.target(pose, grasp_force, nodal_forces)
    begin = problem.displacement_of(start)
    result = problem.solve(begin, goal, pose, progress)
    if settings.verify and result.converged and start is not None:
        return _verified(problem, result, goal, pose, progress)
    return result


def follow_poses(model: BranchModel, grasp: Grasp | Sequence[Grasp], poses: np.ndarray, *,
                 nodal_forces: np.ndarray | None = None,
                 start: "StaticResult | np.ndarray | None" = None,
                 settings: StaticSettings = DEFAULT_SETTINGS,
                 progress: Progress = SILENT) -> list[StaticResult]:
    """Find the equilibrium at each of ``poses`` [m, 6] in turn, each from the one before.

    After a pose that fails the next starts from the last converged state.
    """
    problem = _Problem(model, grasp, True, settings)
    displacement = problem.displacement_of(start)
    results = []
    for number, pose in enumerate(poses):
        progress(number / len(poses), "following poses", pose=number)
        goal = problem.target(pose, None, nodal_forces)
        result = problem.solve(displacement, goal, pose, SILENT)
        if settings.verify and result.converged:
            result = _verified(problem, result, goal, pose, SILENT)
        if result.converged:
            displacement = result.displacement
        results.append(result)
    progress(1.0, "following poses")
    return results


def solve_prescribed(model: BranchModel, displacement: np.ndarray, *,
                     nodal_forces: np.ndarray | None = None,
                     settings: StaticSettings = DEFAULT_SETTINGS,
                     ) -> StaticResult:
    """Find the equilibrium with the model's fixed nodes moved by ``displacement``.

    Args:
        displacement: [m], shape [node_count, 3]; rows of nodes that are not fixed are unused.
    """
    problem = _Problem(model, None, False, settings)
    goal = problem.target(None, None, nodal_forces)
    held = np.where(model.fixed[:, None], displacement, 0.0)
    begin = np.zeros_like(held)
    return problem.solve(begin, replace(goal, held=held), None, SILENT)


class _Problem:
    """One set of constraints; solves for a target from a start."""

    def __init__(self, model: BranchModel, grasp: Grasp | Sequence[Grasp] | None,
                 is_held: bool, settings: StaticSettings):
        self.model, self.settings = model, settings
        self.grasps = ([] if grasp is None else [grasp] if isinstance(grasp, Grasp)
                       else list(grasp))
        self.single = isinstance(grasp, Grasp)
        if is_held and not self.grasps:
            raise InputError("A pose was given without a grasp.", "Nothing would follow it.",
                             "Give the grasp too.")
        self.is_held = is_held
        self.equations: Equations = model.equations(self.grasps if is_held else ())
        self.mixed = settings.mixed and model.material == Material.st_venant_kirchhoff

    def poses(self, pose: np.ndarray) -> list[np.ndarray]:
        poses = np.asarray(pose, float).reshape(-1, 6) if np.size(pose) % 6 == 0 else [pose]
        if len(poses) != len(self.grasps):
            raise InputError(f"{len(poses)} poses for {len(self.grasps)} grasps.",
                             "Each grasp needs one.", "Give an array [grasps, 6].")
        return [check_pose(item) for item in poses]

    def target(self, pose: np.ndarray | None, grasp_force: np.ndarray | None,
               nodal_forces: np.ndarray | None) -> Target:
        shape = (self.model.mesh.node_count, 3)
        held, pins = np.zeros(shape), []
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
            if grasp.mode == "clamped":
                held[grasp.nodes] = grasp.displacement(self.model.mesh.nodes, pose)
            else:
                pins.append(pose[:3] - grasp.centre)
        return held, pins

    def spread(self, grasp_force: np.ndarray) -> np.ndarray:
        """Return nodal forces of forces [N] at the grasps, spread over the patches."""
        forces = np.asarray(grasp_force, float).reshape(-1, 3)
        if self.is_held or len(forces) != len(self.grasps) or not np.isfinite(forces).all():
            raise InputError(f"{len(forces)} grasp forces for {len(self.grasps)} grasps.",
                             "A grasp has a pose or a force, and a force for each.",
                             "Give an array [grasps, 3] [N] and no pose.")
        load = np.zeros((self.model.mesh.node_count, 3))
        for grasp, force in zip(self.grasps, forces, strict=True):
            load[grasp.nodes] += grasp.weights[:, None] * force
        return load

    def displacement_of(self, start: "StaticResult | np.ndarray | None") -> np.ndarray:
        if start is None:
            return np.zeros((self.model.mesh.node_count, 3))
        values = start.displacement if isinstance(start, StaticResult) else start
        return checked_forces(values, (self.model.mesh.node_count, 3), "Start displacements")

    def solve(self, begin: np.ndarray, goal: Target, pose: np.ndarray | None,
              progress: Progress) -> StaticResult:
        return _Path(self, begin, goal, pose).run(progress)


class _Path:
    """The way from a start to a target, in steps of adapted length."""

    def __init__(self, problem: _Problem, begin: np.ndarray, goal: Target,
                 pose: np.ndarray | None):
        self.problem, self.goal, self.pose = problem, goal, pose
        self.model, self.equations = problem.model, problem.equations
        self.settings = problem.settings
        self.started = time.perf_counter()
        self.displacement = begin.copy()
        self.state: InternalState = self.model.internal(begin)
        # Imbalance of the start under the wanted loads: let go along the way.
        self.imbalance = self.equations.free_part(goal.load - self.state.force)
        self._begin_constraint(begin)
        self.history: list[float] = []
        self.iterations = 0
        self.reached = 0.0
        self.trouble = ""
        self.status = "stalled"

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
            # What of the start is not rigid goes away along the way as well.
            self.begin_rest = self.begin_rest - rigid

    def constraint_at(self, part: float) -> tuple[np.ndarray, np.ndarray]:
        """Return displacements of held nodes and pinned means at ``part`` of the way."""
        pins = self.begin_pins + part * (self.goal.pins - self.begin_pins)
        if part >= 1.0:
            return self.goal.held, self.goal.pins
        if self.begin_poses is None:
            return self.begin_rest + part * (self.goal.held - self.begin_rest), pins
        poses = [pose_between(a, b, part)
                 for a, b in zip(self.begin_poses, self.end_poses, strict=True)]
        return self.problem.constraint(poses)[0] + (1 - part) * self.begin_rest, pins

    def run(self, progress: Progress) -> StaticResult:
        step = 1.0
        while self.reached < 1.0:
            progress(self.reached, "seeking equilibrium", iteration=self.iterations)
            part = min(1.0, self.reached + step)
            before = self.iterations
            taken = self._step(part)
            if taken is None:
                step = (part - self.reached) / 2
                if step < self.settings.min_step:
                    taken = self._settle(min(1.0, self.reached + _SNAP))
                    if taken is None:
                        return self._result(False)
                    self.reached, step = self.reached + taken, _SNAP
                continue
            quick = self.iterations - before <= 6
            step = max(taken, step) * (2.0 if quick else 1.0) if taken == part - self.reached \
                else taken * (1.5 if quick else 1.0)
            self.reached += taken
            if self.reached > 1 - 1e-12:
                self.reached = 1.0
        self.status = "converged"
        return self._result(True)

    def _step(self, part: float) -> float | None:
        """Try a step to ``part`` of the way; return the length taken, None if it failed."""
        settings, equations, held = self.settings, self.equations, self.equations.held
        try:
            equations.assemble(self.model, self.displacement)
            equations.factorise()
        except NotPositiveDefiniteError:
            self.trouble = "the stiffness has no positive pivots"
            return None
        target, pins = self.constraint_at(part)
        increment = self._predict(target, pins, part)
        longest = np.linalg.norm(increment, axis=1).max()
        limit = settings.max_step * self.model.extent
        if longest > limit:
            part = self.reached + (part - self.reached) * limit / longest
            target, pins = self.constraint_at(part)
            increment = self._predict(target, pins, part)
        trial = self.displacement + increment
        trial[held] = target[held]
        return self._correct(trial, increment, part)

    def _load_at(self, part: float) -> np.ndarray:
        return self.goal.load - (1.0 - part) * self.imbalance

    def _predict(self, target: np.ndarray, pins: np.ndarray, part: float) -> np.ndarray:
        equations, held = self.equations, self.equations.held
        moved = np.where(held[:, None], target - self.displacement, 0.0)
        right = self._load_at(part) - self.state.force
        if moved.any():
            right = right - self.model.tangent_times(self.displacement, moved)
        now = np.array([g.weights @ self.displacement[g.nodes] for g in equations.pinned])
        return equations.solve(right, pins - now.reshape(-1, 3)) + moved

    def _correct(self, trial: np.ndarray, increment: np.ndarray, part: float) -> float | None:
        settings, equations = self.settings, self.equations
        load = self._load_at(part)
        best, worse = np.inf, 0
        stable = True
        for _ in range(settings.max_iterations):
            state = self.model.internal(trial)
            out = load - state.force
            residual = equations.free_part(out)
            norm = float(np.linalg.norm(residual))
            if not np.isfinite(norm):
                self.trouble = "the displacements grew without bound"
                return None
            reference = float(np.linalg.norm(out - residual) + np.linalg.norm(load))
            self.history.append(norm / reference if reference else 0.0)
            if norm <= max(settings.tolerance * reference, self._floor()):
                return self._accept(trial, state, part, stable)
            worse = worse + 1 if norm > 0.9 * best else 0
            best = min(best, norm)
            if worse > 5:
                self.trouble = "Newton's iteration does not converge"
                return None
            self.iterations += 1
            try:
                equations.assemble(self.model, trial,
                                   increment=increment if self.problem.mixed else None)
                stable = equations.factorise()
            except NotPositiveDefiniteError:
                self.trouble = "the stiffness has no positive pivots"
                return None
            increment = equations.solve(residual)
            if not self.problem.mixed:
                increment = self._searched(trial, increment, load, residual)
            trial = trial + increment
        self.trouble = f"no convergence in {settings.max_iterations} iterations"
        return None

    def _settle(self, part: float) -> float | None:
        """Let the branch snap to where it comes to rest at ``part`` of the way.

        Where a path of stable equilibria ends (a column buckles, a bow turns over) no small step
        leads on. Here the branch creeps, as through honey: each creep is a step of implicit
        Euler on the gradient flow of the potential, so it only ever goes down. Return the length
        taken; None where it does not come to rest.
        """
        if self.problem.model.material != Material.st_venant_kirchhoff:
            return None
        target, pins = self.constraint_at(part)
        load, before = self._load_at(part), (self.status, self.trouble)
        trial, drag = self.displacement, _FIRST_DRAG
        for _ in range(_CREEPS):
            crept = self._creep(trial, target, pins, load, drag)
            if crept is None:
                drag *= 8
                if drag > 1:
                    break
                continue
            trial, quick, error, stable = crept
            if stable and error < _RESTING:
                taken = self._correct(trial, np.zeros_like(trial), part)
                if taken is not None:
                    return taken
            drag *= 0.25 if quick else 0.7
        self.status, self.trouble = before
        return None

    def _creep(self, start: np.ndarray, target: np.ndarray, pins: np.ndarray, load: np.ndarray,
               drag: float) -> tuple[np.ndarray, bool, float, bool] | None:
        """Return the state after one creep, whether it was quick, its imbalance, stability."""
        equations, held = self.equations, self.equations.held
        moved = np.where(held[:, None], target - start, 0.0)
        now = np.array([g.weights @ start[g.nodes] for g in equations.pinned]).reshape(-1, 3)
        trial, increment, honey = start, None, 0.0
        for count in range(_CREEP_ITERATIONS):
            state = self.model.internal(trial)
            out = load - state.force
            pull = equations.free_part(out - honey * (trial - start))
            norm = float(np.linalg.norm(pull))
            reference = float(np.linalg.norm(out - equations.free_part(out))
                              + np.linalg.norm(load))
            if not np.isfinite(norm):
                return None
            if increment is not None and norm <= 1e-4 * reference:
                left = float(np.linalg.norm(equations.free_part(out)))
                equations.assemble(self.model, trial)
                return trial, count <= 4, left / reference, equations.factorise()
            self.iterations += 1
            try:
                equations.assemble(self.model, trial, increment=increment)
                honey = equations.raise_diagonal(drag)
                if not equations.factorise():
                    return None
            except NotPositiveDefiniteError:
                return None
            if increment is None:
                right = out - self.model.tangent_times(start, moved) if moved.any() else out
                increment = equations.solve(right, pins - now) + moved
            else:
                increment = equations.solve(pull)
            trial = trial + increment
        return None

    def _searched(self, trial: np.ndarray, increment: np.ndarray, load: np.ndarray,
                  residual: np.ndarray) -> np.ndarray:
        """Return the increment, shortened until the work of the residual along it has fallen."""
        slope = float((residual * increment).sum())
        length = 1.0
        for _ in range(8):
            state = self.model.internal(trial + length * increment)
            left = float((self.equations.free_part(load - state.force) * increment).sum())
            if abs(left) < 0.9 * abs(slope) and np.isfinite(left):
                break
            length *= 0.5
        return length * increment

    def _floor(self) -> float:
        # Differences of displacements in an element carry round-off of about one unit each.
        return 8 * np.finfo(float).eps * self.equations.diagonal_norm() * self.model.mean_edge

    def _accept(self, trial: np.ndarray, state: InternalState, part: float,
                stable: bool) -> float | None:
        if state.min_det_f <= 0:
            self.status, self.trouble = "inverted", "an element would turn inside out"
            return None
        if not stable and not self._is_stable(trial):
            self.status, self.trouble = "unstable", "the equilibrium found is not stable"
            return None
        if (stretch := principal_stretch(self.model, trial)).value > self.settings.stretch_limit:
            self.status = "torn"
            self.trouble = f"stretched to {100 * stretch.value:.0f} % of its length {stretch.at}"
            return None
        self.displacement, self.state = trial, state
        taken = part - self.reached
        self.status = "stalled"
        return taken

    def _is_stable(self, trial: np.ndarray) -> bool:
        self.equations.assemble(self.model, trial)
        return self.equations.factorise()

    def _result(self, converged: bool) -> StaticResult:
        stretch = principal_stretch(self.model, self.displacement)
        message = "" if converged else (
            f"{self.trouble}; stopped at {100 * self.reached:.1f} % of the way, where the branch"
            f" is stretched most {stretch.at} ({100 * (stretch.value - 1):.1f} %)")
        warnings = strain_warnings(stretch)
        load = self._load_at(self.reached)
        return make_result(self.problem, self.displacement, self.state, load, converged=converged,
                           status=self.status, message=message, warnings=warnings,
                           iterations=self.iterations, residual_history=self.history,
                           seconds=time.perf_counter() - self.started, reached=self.reached)


def strain_warnings(stretch: Place) -> list[str]:
    """Return a warning if the largest stretch is beyond what wood does, else nothing."""
    if stretch.value <= 1.5:
        return []
    return [f"Strain reaches {100 * (stretch.value - 1):.0f} % {stretch.at}: far beyond wood."
            " Check the units of loads and of Young's modulus."]


def make_result(problem: _Problem, displacement: np.ndarray, state: InternalState,
                load: np.ndarray, **found: object) -> StaticResult:
    """Return a result with the reactions that belong to a displacement."""
    model = problem.model
    positions = model.mesh.nodes + displacement
    out = state.force - load
    base = np.where(model.fixed[:, None], out, 0.0)
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
        reaction_force=force, reaction_torque=torque, base_force=base.sum(axis=0),
        base_torque=np.cross(positions, base).sum(axis=0), min_det_f=state.min_det_f, **found)


def grasp_wrench(problem: _Problem, grasp: Grasp, positions: np.ndarray, out: np.ndarray,
                 centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return force [N] and torque [Nm] about ``centre`` of a gripper on the branch.

    Args:
        out: Internal force less loads on all nodes [N], shape [node_count, 3].
    """
    if not problem.is_held:
        return np.zeros(3), np.zeros(3)
    forces = out[grasp.nodes]
    if grasp.mode == "pinned":
        total = grasp.weights @ forces / (grasp.weights @ grasp.weights)
        forces = grasp.weights[:, None] * total
    return forces.sum(axis=0), np.cross(positions[grasp.nodes] - centre, forces).sum(axis=0)


def checked_forces(values: np.ndarray, shape: tuple[int, int],
                   name: str = "Nodal forces") -> np.ndarray:
    """Return a nodal field as floats.

    Raises:
        InputError: wrong shape or not finite.
    """
    values = np.asarray(values, float)
    if values.shape != shape or not np.isfinite(values).all():
        raise InputError(f"{name} have shape {values.shape} or are not finite.",
                         f"The mesh needs {shape}.", "Give three numbers for each node.")
    return values


def _verified(problem: _Problem, result: StaticResult, goal: Target, pose: np.ndarray | None,
              progress: Progress) -> StaticResult:
    """Return the result, or, if a path from rest in small steps ends lower, a refusal."""
    careful = replace(problem.settings, max_step=problem.settings.max_step / 4, verify=False)
    other = _Problem(problem.model, problem.grasps or None, problem.is_held, careful)
    other.single = problem.single
    again = other.solve(problem.displacement_of(None), goal, pose, progress)
    lower = result.strain_energy - again.strain_energy
    if again.converged and lower > 1e-3 * abs(again.strain_energy):
        return replace(
            result, converged=False, status="false_equilibrium",
            message=f"energy {result.strain_energy:.6g} J, but {again.strain_energy:.6g} J on the"
                    " way from rest: a false equilibrium")
    return result
