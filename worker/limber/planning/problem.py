"""One planning problem: where from, where to, what a metre costs and what is not allowed."""

from dataclasses import dataclass

import numpy as np

from limber.errors import NoPathError
from limber.planning.cost import EdgeWeights, arc_lengths, resample
from limber.planning.field.energy_field import LOADS, EnergyField, FieldArrays
from limber.planning.goals import Goal

_FINE = 0.001  # [m] spacing at which a finished path is costed and its validity checked


class NoWayError(NoPathError):
    """No path from the start to the goal keeps the limits on the field: proven, or none found."""


@dataclass(frozen=True)
class GentleProblem:
    """Any path from ``start`` [3] into ``goal`` within ``limits`` (see ``EnergyField.limited``).

    ``weights`` are the cost of an edge. ``field_error`` [J] is subtracted from the energy where a
    lower bound is asked for, so that it holds for every branch whose energy lies that near. No path
    may be longer than ``longest`` [m]; bounds do without that limit, and hold with it as well.
    """

    energy_field: EnergyField
    limits: FieldArrays
    weights: EdgeWeights
    start: np.ndarray
    goal: Goal
    field_error: float = 0.0
    longest: float = np.inf

    def cost(self, path: np.ndarray) -> float:
        """Return the cost of a polyline [n, 3]; infinite if it breaks a limit, is too long or
        misses the goal.

        Finer than the planners' edges: what is reported must not owe to their quadrature.
        """
        from limber.planning.cost import path_cost

        if self.goal_excess(path[-1]) > 1e-9:
            return np.inf
        fine = resample(np.ascontiguousarray(path, float), _FINE)
        if arc_lengths(fine)[-1] > self.longest * (1.0 + 1e-9):
            return np.inf
        return float(path_cost(fine, self.limits, self.weights._replace(step=_FINE)))

    def limits_in_words(self) -> str:
        """Return the limits that there are, or an empty string."""
        limits = self.limits
        kept = [f"{name} {value:.3g} {unit}".rstrip() for name, value, unit in (
            ("energy", limits.max_energy, "J"), ("force", limits.max_force, "N"),
            *zip([name.replace("_", " ") for name in LOADS], limits.max_loads,
                 ("", "Pa", "N", "Nm", "(1: it touches)"), strict=True)) if value < np.inf]
        return (" at most " + " and ".join(kept)) if kept else ""

    def goal_excess(self, point: np.ndarray) -> float:
        """Return how far ``point`` [3] is outside the goal region [m], negative inside."""
        return float(self.goal.distance(self.energy_field, point[None])[0]) - self.goal.tolerance


def no_way(problem: GentleProblem, proof: str) -> NoWayError:
    """Return what is said where no path exists, and how that is proven."""
    return NoWayError(
        f"No path exists: with{problem.limits_in_words() or ' poses that the branch accepts'} no "
        "way leads from the start to the goal.", proof,
        "Raise the limit, choose another goal, or sample farther (`limber energy --deflection`).")
