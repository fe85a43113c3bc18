"""The gentlest path with its certificate: eikonal descent, refinement, bound.

Each grid of the certificate gives its cheapest path; refined, it becomes a path on the field. The
first paths tried are the straight line and those of other planners. If none of them keeps the
limits, next come a path through cells that do, if there is one
(:mod:`limber.planning.certificate.feasibility`), else the path that exceeds the limits least.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from limber.core.progress import SILENT, Progress
from limber.planning.certificate.feasibility import Verdict, judge
from limber.planning.certificate.lower_bound import ENOUGH, Certificate, certify
from limber.planning.cost import arc_lengths
from limber.planning.path_problem import BlockedError, GentleProblem, no_path_error, not_found
from limber.planning.planners.least_violation import easiest_path
from limber.planning.planners.refine import refine

_GAIN = 1e-3  # relative gain of cost that another refinement must bring
_SAME_WAY = 0.05  # fraction of a path's length; another path around a ridge is farther away


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
    best: list = [None, np.inf]
    verdicts: list[Verdict] = []
    in_vain: list[bool] = []

    def found_from(paths: list[np.ndarray]) -> bool:
        for path in paths:
            if len(path) < 2 or not arc_lengths(path)[-1] > 0.0:
                continue
            points, cost = refine(path, problem)
            if cost < best[1]:
                best[:] = points, cost
        return best[0] is not None

    def improve(rough: np.ndarray | None) -> float:
        starts = [_straight(problem), *(others or [])] if rough is None else [rough]
        before, along = best[1], rough is not None and best[0] is not None and _is_along(
            rough, best[0])
        if along and in_vain:
            return before  # leads to the same optimum
        if found_from(starts):
            if along and best[1] > (1.0 - _GAIN) * before:
                in_vain.append(True)
            return best[1]
        if rough is not None:
            # Coarser cells than those that left it open will not decide it.
            raise not_found(problem, f"The question is undecided on {_grid(verdicts[0])}.")
        verdicts.append(judge(problem))
        # A path that keeps the limits is a better proof than cells that separate.
        path = verdicts[0].path
        known = (path is not None and found_from([path])) or found_from(_easiest(problem))
        if not known and verdicts[0].proven:
            raise separated(problem, verdicts[0])
        return best[1]

    certificate = certify(problem, improve, enough=enough, progress=progress)
    return GentlePath(best[0], best[1], certificate)


def separated(problem: GentleProblem, verdict: Verdict) -> BlockedError:
    """Return the error for a goal that cells separate from the start."""
    return no_path_error(problem,
                         f"This is proven on {_grid(verdict)}: forbidden cells separate the "
                         "start from the goal.").behind(verdict.wall, verdict.nearest)


def _is_along(rough: np.ndarray, path: np.ndarray) -> bool:
    """Return whether a rough path [n, 3] is so near to a refined one [k, 3] that refining it would
    give the same path.
    """
    away = cKDTree(path).query(rough)[0]
    return bool(away.max() <= _SAME_WAY * arc_lengths(path)[-1])


def _easiest(problem: GentleProblem) -> list[np.ndarray]:
    path = easiest_path(problem.energy_field, problem.limits, problem.start, problem.goal)
    return [] if path is None else [path.points]


def _grid(verdict: Verdict) -> str:
    along, off = 1e3 * verdict.edges[0], 1e3 * verdict.edges[2]
    return f"a grid of {along:.1f} mm along the low-energy surface and {off:.2g} mm across it"


def _straight(problem: GentleProblem) -> np.ndarray:
    end = problem.goal.centre(problem.energy_field)
    return problem.start + np.linspace(0.0, 1.0, 40)[:, None] * (end - problem.start)
