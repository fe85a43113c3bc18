"""One planning problem: where from, where to, what a metre costs and what is not allowed."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from limber.core.errors import NoPathError
from limber.planning.cost import EdgeWeights, arc_lengths, resample
from limber.planning.field.energy_field import EnergyField, FieldArrays
from limber.planning.field.limited_quantities import limited
from limber.planning.field.local_error import LocalError
from limber.planning.goals.goal import Goal

_FINE = 0.001  # [m] spacing at which a finished path is costed and its validity checked


UNPROVEN = "but it is not proven that none exists"
"""Of what is said without a path: more samples may show one. Across processes the words tell."""


class NoWayError(NoPathError):
    """No path from the start to the goal keeps the limits on the field: proven, or none found.

    ``wall`` are grasp positions where the way is closed by limits, those first that are least over
    them [m], shape [k, 3].
    """

    wall: np.ndarray = np.empty((0, 3))

    @property
    def is_proven(self) -> bool:
        """Whether the field, its error counted, leaves no way."""
        return UNPROVEN not in self.seen

    def behind(self, wall: np.ndarray) -> "NoWayError":
        """Return the error with the places where the way is closed."""
        self.wall = wall
        return self


@dataclass(frozen=True)
class GentleProblem:
    """Any path from ``start`` [3] into ``goal`` within ``limits`` (see ``EnergyField.limited``).

    ``weights`` are the cost of an edge. ``field_error`` [J] is subtracted from the energy where a
    lower bound is asked for, so that it holds for every branch whose energy lies that near. No path
    may be longer than ``longest`` [m]; bounds do without that limit, and hold with it as well.

    ``beyond`` are limits that the field exceeds only where the branch exceeds those that were
    asked for (:meth:`~limber.planning.constraints.limits.Limits.beyond`). Bounds and proofs count
    on them alone; without them no limit proves anything. They allow for the field's largest error
    anywhere; ``errors``, by limit, say how much smaller it is at a place.
    """

    energy_field: EnergyField
    limits: FieldArrays
    weights: EdgeWeights
    start: np.ndarray
    goal: Goal
    field_error: float = 0.0
    longest: float = np.inf
    beyond: FieldArrays | None = None
    errors: Mapping[str, LocalError] = field(default_factory=dict)

    def spare(self, name: str, points: np.ndarray) -> np.ndarray:
        """Return by how much the limit ``beyond`` may be less at ``points`` [n, 3], shape [n]."""
        error = self.errors.get(name)
        if error is None or not np.isfinite(error.most):
            return np.zeros(len(points))
        return error.most - error.at(self.energy_field.region.chart.plain.map(points))

    @property
    def sure_limits(self) -> FieldArrays:
        """The limits ``beyond`` which a pose surely is not allowed; infinite where unknown."""
        if self.beyond is not None:
            return self.beyond
        return self.limits._replace(max_energy=np.inf, max_force=np.inf,
                                    max_loads=np.full_like(self.limits.max_loads, np.inf))

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
        """Describe the limits that are set, or return an empty string."""
        return _in_words(self, self.limits)

    def goal_excess(self, point: np.ndarray) -> float:
        """Return how far ``point`` [3] is outside the goal region [m], negative inside."""
        return float(self.goal.distance(self.energy_field, point[None])[0]) - self.goal.tolerance


def least_over(problem: GentleProblem, points: np.ndarray) -> np.ndarray:
    """Return ``points`` [n, 3] in the order of how far they are over a limit, the least first."""
    worst = np.zeros(len(points))
    for one in limited(problem.energy_field, problem.sure_limits):
        worst = np.maximum(worst, one.size(points) / one.limit)
    return points[np.argsort(worst, kind="stable")]


def _in_words(problem: GentleProblem, limits: FieldArrays) -> str:
    kept = [f"{one.words} {one.with_unit(one.limit)}"
            for one in limited(problem.energy_field, limits)]
    return (" at most " + " and ".join(kept)) if kept else ""


def no_way(problem: GentleProblem, proof: str) -> NoWayError:
    """Return the error for a goal to which no path exists, with the ``proof``."""
    counted = _in_words(problem, problem.sure_limits)
    if counted:
        proof += (" The proof includes the largest cross-validation error of the energy field: no "
                  f"path exists with{counted} on the field either.")
    return NoWayError(
        "No path exists in the sampled region: no path "
        f"with{problem.limits_in_words() or ' accepted poses'} leads from the start to the "
        "goal.", proof,
        "Raise the limit, choose another goal, or sample farther (`limber energy --deflection`).")


def not_found(problem: GentleProblem, why: str) -> NoWayError:
    """Return the error for a path that was not found, with ``why`` that proves nothing."""
    return NoWayError(
        f"No path to the goal with{problem.limits_in_words() or ' known poses'} was found, "
        f"{UNPROVEN}.", why,
        "Relax the limits slightly, or sample more poses with `limber energy --samples`.")
