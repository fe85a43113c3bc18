"""The gentlest path with its certificate: eikonal descent, refinement, bound.

Each grid of the certificate gives its cheapest path; refined, it becomes a path on the field. The
first paths tried are the straight line and those of other planners that keep the limits; if none
does, the path that exceeds them least. If that fails, next comes a path through cells that keep
them, if there is one (:mod:`limber.planning.certificate.feasibility`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.planning.certificate.feasibility import Verdict, judge
from limber.planning.certificate.lower_bound import ENOUGH, Certificate, certify_all
from limber.planning.cost import arc_lengths
from limber.planning.path_problem import BlockedError, GentleProblem, no_path_error, not_found
from limber.planning.planners.least_violation import easiest_path
from limber.planning.planners.refine import is_along, refine

_GAIN = 1e-3  # relative gain of cost that another refinement must bring


@dataclass(frozen=True)
class GentlePath:
    """A path [n, 3], its cost, and its gap to the best."""

    points: np.ndarray
    cost: float
    certificate: Certificate


def plan_gentle(problem: GentleProblem, others: list[np.ndarray] | None = None, *,
                enough: float = ENOUGH, progress: Progress = SILENT) -> GentlePath:
    """Return the gentlest path found, and a lower bound on every path.

    ``others`` are paths [n, 3] to start from besides the straight line; ``enough`` is the gap
    below which the bound is refined no further.

    Raises:
        BlockedError: it is proven that there is none, or none was found; states which.
    """
    return plan_gentle_all([problem], others, enough=[enough], progress=progress)[0]


def plan_gentle_all(problems: Sequence[GentleProblem], others: list[np.ndarray] | None = None, *,
                    enough: Sequence[float], progress: Progress = SILENT) -> list[GentlePath]:
    """Return the same for each of problems that differ in the weight of length alone; their bounds
    share the energies of the field.

    Raises:
        BlockedError: as for one.
    """
    found = [_Gentlest(problem, others or []) for problem in problems]
    certificates = certify_all(problems, found, enough=enough, progress=progress)
    return [GentlePath(present(one.points, "path"), one.cost, certificate)
            for one, certificate in zip(found, certificates, strict=True)]


class _Gentlest:
    """The gentlest path of a problem so far."""

    def __init__(self, problem: GentleProblem, others: list[np.ndarray]):
        self.problem, self._others = problem, others
        self.points: np.ndarray | None = None
        self.cost = np.inf
        self._tried: list[np.ndarray] = []
        self._is_in_vain = False

    def __call__(self, rough: np.ndarray | None) -> float:
        """Return the cost after refining a ``rough`` path [n, 3]; None: those known before."""
        problem, before = self.problem, self.cost
        along = rough is not None and self.points is not None and is_along(rough, self.points)
        if along and self._is_in_vain:
            return before  # leads to the same optimum
        if self._found_from(self._starts() if rough is None else [rough], rough is None):
            self._is_in_vain |= along and self.cost > (1.0 - _GAIN) * before
            return self.cost
        if problem.limits.slack.factors.any():
            # Cells are asked about the limits as requested, not about extended or tighter ones.
            raise not_found(problem, "The easiest path does not keep them.")
        verdict = judge(problem)
        # A path that keeps the limits is a better proof than cells that separate.
        if verdict.path is None or not self._found_from([verdict.path]):
            raise separated(problem, verdict) if verdict.proven else not_found(
                problem, f"The question is undecided on {_grid(verdict)}.")
        return self.cost

    def _starts(self) -> list[np.ndarray]:
        """Return the known paths that keep the limits; if none does, the path that exceeds them
        least.
        """
        # Those of planners first: mostly the straight line then leads to the same optimum.
        known = [path for path in [*self._others[::-1], _straight(self.problem)]
                 if len(path) > 1 and np.isfinite(self.problem.cost(path))]
        return known or _easiest(self.problem)

    def _found_from(self, paths: list[np.ndarray], skips_same: bool = False) -> bool:
        for path in paths:
            if len(path) < 2 or not arc_lengths(path)[-1] > 0.0:
                continue
            same = self._tried if self.points is None or not skips_same else [
                *self._tried, self.points]
            if any(is_along(path, other) for other in same):
                continue  # leads to the same optimum
            self._tried.append(path)
            points, cost = refine(path, self.problem)
            if cost < self.cost:
                self.points, self.cost = points, cost
        return self.points is not None


def separated(problem: GentleProblem, verdict: Verdict) -> BlockedError:
    """Return the error for a goal that cells separate from the start."""
    return no_path_error(problem,
                         f"This is proven on {_grid(verdict)}: forbidden cells separate the "
                         "start from the goal.").behind(verdict.wall, verdict.nearest)


def _easiest(problem: GentleProblem) -> list[np.ndarray]:
    path = easiest_path(problem.energy_field, problem.limits, problem.start, problem.goal)
    return [] if path is None else [path.points]


def _grid(verdict: Verdict) -> str:
    along, off = 1e3 * verdict.edges[0], 1e3 * verdict.edges[2]
    return f"a grid of {along:.1f} mm along the low-energy surface and {off:.2g} mm across it"


def _straight(problem: GentleProblem) -> np.ndarray:
    end = problem.goal.centre(problem.energy_field)
    return problem.start + np.linspace(0.0, 1.0, 40)[:, None] * (end - problem.start)
