"""The path from an equilibrium to the target, in steps of adapted length."""

import time

import numpy as np

from limber.core.numerics.rigid import pose_between
from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.core.progress import Progress
from limber.mechanics.internal_state import InternalState
from limber.mechanics.linear.equations import Tangent
from limber.mechanics.solve_status import Status
from limber.mechanics.statics.result import StaticResult
from limber.mechanics.statics.snap_through import settle
from limber.mechanics.statics.static_problem import (
    StaticProblem,
    Target,
    make_result,
    strain_warnings,
)
from limber.mechanics.strain import principal_stretch

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
        """Return displacements of held nodes and pinned means at the fraction ``part`` of the path.
        """
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

        ``strain`` [tet_count, q, 6] belongs to the guess, if known.
        """
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
        """Iterate from ``trial`` to equilibrium at the fraction ``part`` of the path.

        Args:
            trial: Displacement [m], shape [node_count, 3], after ``increment``.
            diagonal_norm: Of a nearby tangent [N/m]; it gives the floor set by round-off.
            steady: Whether that tangent is positive definite.
            strain: Shape [tet_count, q, 6]; given if it is known better than from ``trial``.

        Returns:
            Length of the step; None if there is none.
        """
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
        norm.

        The tangent itself is freed, so at most one of a large mesh is in memory.
        """
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

        A step is taken only if it removes most of the imbalance.
        """
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
        reactions.
        """
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
        if asked and not self._is_stable(trial):
            self.status, self.trouble = Status.unstable, "the equilibrium found is not stable"
            return None
        if not steady and self._lost(trial, state, part) > _LOST:
            self.trouble = "the branch would jump to another equilibrium"
            return None
        if (stretch := principal_stretch(self.model, trial)).value > self.settings.stretch_limit:
            self.status = Status.torn
            self.trouble = f"stretched to {100 * stretch.value:.0f} % of its length {stretch.at}"
            return None
        self.displacement, self.state = trial, state
        taken = part - self.reached
        self.status = Status.stalled
        return taken

    def _lost(self, trial: np.ndarray, state: InternalState, part: float) -> float:
        """Return by how much the potential falls in a step beyond the work of forces and loads.

        Relative to both. The work is integrated by the trapezium rule. Between neighbouring
        equilibria the difference is only the error of that rule.
        """
        before, now = self.load_at(self.reached), self.load_at(part)
        moved = trial - self.displacement
        work = 0.5 * float(((self.state.force - before + state.force - now) * moved).sum()
                           - ((trial + self.displacement) * (now - before)).sum())
        change = (state.energy - float((now * trial).sum())
                  - self.state.energy + float((before * self.displacement).sum()))
        return (work - change) / max(abs(work) + abs(change), float(np.finfo(float).tiny))

    def _is_stable(self, trial: np.ndarray) -> bool:
        """Whether no pivot of the exact tangent's factor is negative."""
        return self.equations.exact_tangent(self.model, trial).is_positive_definite

    def _result(self) -> StaticResult:
        stretch = principal_stretch(self.model, self.displacement)
        message = "" if self.status is Status.converged else (
            f"{self.trouble}; stopped at {100 * self.reached:.1f} % of the path, where the "
            f"largest stretch of the branch is {stretch.at} ({100 * (stretch.value - 1):.1f} %)"
            + self._softening())
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
