"""The gentlest path with its certificate: eikonal descent, refinement, bound.

Each grid of the certificate shows the cheapest way on it; refined, it is a path. The first paths
that are tried are the straight line and what other planners found.
"""

from dataclasses import dataclass

import numpy as np

from limber.errors import NoPathError
from limber.planning.bound.certificate import ENOUGH, Certificate, certify
from limber.planning.cost import arc_lengths
from limber.planning.planners.refine import refine
from limber.planning.problem import GentleProblem
from limber.progress import SILENT, Progress

UNPROVEN = "nor is it proven that none exists"
"""Of what is said without a path: more samples may show one. Across processes the words tell."""


@dataclass(frozen=True)
class GentlePath:
    """A path [n, 3], its cost, and how close to the best it is."""

    points: np.ndarray
    cost: float
    certificate: Certificate


def plan_gentle(problem: GentleProblem, others: list[np.ndarray] | None = None, *,
                enough: float = ENOUGH, progress: Progress = SILENT) -> GentlePath:
    """Return the gentlest path that was found, and a lower bound on every path.

    ``others`` are paths [n, 3] to start from besides the straight line; ``enough`` is the gap
    below which the bound is refined no further.

    Raises:
        NoPathError: it is proven that there is none, or none was found; says which.
    """
    best: list = [None, np.inf]

    def improve(rough: np.ndarray | None) -> float:
        if rough is None:
            starts = [_straight(problem), *(others or [])]
        else:
            starts = [rough]
        for path in starts:
            if len(path) < 2 or not arc_lengths(path)[-1] > 0.0:
                continue
            points, cost = refine(path, problem)
            if cost < best[1]:
                best[:] = points, cost
        return best[1]

    certificate = certify(problem, improve, enough=enough, progress=progress)
    if best[0] is None:
        raise NoPathError(
            f"No path to the goal with{problem.limits_in_words() or ' poses that are known'} was "
            f"found, {UNPROVEN}.",
            f"The bound says a path costs at least {certificate.lower:.3g} "
            f"(grid of {1e3 * certificate.levels[-1]['spacing_m']:.1f} mm).",
            "Loosen the limits a little, or sample more poses with `limber energy --samples`.")
    return GentlePath(best[0], best[1], certificate)


def _straight(problem: GentleProblem) -> np.ndarray:
    end = problem.goal.centre(problem.energy_field)
    return problem.start + np.linspace(0.0, 1.0, 40)[:, None] * (end - problem.start)
