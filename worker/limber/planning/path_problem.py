"""One planning problem: start, goal, cost per metre and limits."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from limber.core.errors import Command, InputError, NoPathError, Option, Text
from limber.planning.constraints.limits import Limits
from limber.planning.cost import EdgeWeights, arc_lengths, resample
from limber.planning.field.energy_field import EnergyField, FieldArrays, limited
from limber.planning.field.radial import LocalError
from limber.planning.goals.goal import Goal, allowed_points, over_limits, unit_hint
from limber.planning.settings import PlanSettings

_FINE = 0.001  # [m] spacing at which a finished path is costed and its validity checked


UNPROVEN = "but it is not proven that none exists"
"""Part of messages without a path: more samples may show one. Checked across processes."""


class BlockedError(NoPathError):
    """No path from the start to the goal keeps the limits on the field: proven, or none found.

    ``wall`` are grasp positions where limits block the path, those least over them first [m], shape
    [k, 3]; ``nearest`` positions that are reached, those nearest to the goal first, if the field
    does not know the target's position exactly.
    """

    wall: np.ndarray = np.empty((0, 3))
    nearest: np.ndarray = np.empty((0, 3))

    @property
    def is_proven(self) -> bool:
        """Whether the field, including its error, allows no path."""
        return UNPROVEN not in self.seen

    def behind(self, wall: np.ndarray, nearest: np.ndarray | None = None) -> "BlockedError":
        """Return the error with the positions where the path is blocked."""
        self.wall = wall
        self.nearest = self.nearest if nearest is None else nearest
        return self


@dataclass(frozen=True)
class GentleProblem:
    """Any path from ``start`` [3] into ``goal`` within ``limits`` (see ``EnergyField.limited``).

    ``weights`` are the cost of an edge. For a lower bound, ``field_error`` [J] is subtracted from
    the energy, so that the bound holds for every branch whose energy is within it. No path may be
    longer than ``longest`` [m]; bounds ignore that limit, and also hold with it. Paths may end in a
    part of the requested goal only; the bound is for all of it, ``asked_goal`` (by default the
    same).

    ``beyond`` are limits that the field exceeds only where the branch exceeds the requested ones
    (:meth:`~limber.planning.constraints.limits.Limits.beyond`). Bounds and proofs use them alone;
    without them no limit proves anything. They allow for the field's largest error anywhere;
    ``errors``, by limit, give how much smaller it is at a position.
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
    asked_goal: Goal | None = None

    @property
    def bounded_goal(self) -> Goal:
        """The goal to which no path costs less than the bound."""
        return self.asked_goal or self.goal

    def spare(self, name: str, points: np.ndarray) -> np.ndarray:
        """Return by how much the limit ``beyond`` may be less at ``points`` [n, 3], shape [n]."""
        error = self.errors.get(name)
        if error is None or not np.isfinite(error.most):
            return np.zeros(len(points))
        return error.most - error.at(self.energy_field.region.chart.plain.map(points))

    @property
    def sure_limits(self) -> FieldArrays:
        """The limits ``beyond`` which a pose is surely not allowed; infinite if unknown."""
        if self.beyond is not None:
            return self.beyond
        return self.limits._replace(max_energy=np.inf, max_force=np.inf,
                                    max_loads=np.full_like(self.limits.max_loads, np.inf))

    def cost(self, path: np.ndarray) -> float:
        """Return the cost of a polyline [n, 3]; infinite if it breaks a limit, is too long or
        misses the goal.

        Finer than the planners' edges: reported values must not depend on their quadrature.
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
    """Return ``points`` [n, 3] in ascending order of their excess over a limit."""
    worst = np.zeros(len(points))
    for one in limited(problem.energy_field, problem.sure_limits):
        worst = np.maximum(worst, one.size(points) / one.limit)
    return points[np.argsort(worst, kind="stable")]


def _in_words(problem: GentleProblem, limits: FieldArrays) -> str:
    kept = [f"{one.words} {one.with_unit(one.limit)}"
            for one in limited(problem.energy_field, limits)]
    return (" at most " + " and ".join(kept)) if kept else ""


def no_path_error(problem: GentleProblem, proof: str) -> BlockedError:
    """Return the error for a goal that no path reaches, with the ``proof``."""
    counted = _in_words(problem, problem.sure_limits)
    if counted:
        proof += (" The proof includes the largest cross-validation error of the energy field: no "
                  f"path exists with{counted} on the field either.")
    return BlockedError("No path exists in the sampled region: no path "
                        f"with{problem.limits_in_words() or ' accepted poses'} leads from the "
                        "start to the goal.", proof, "Raise the limit, choose another goal, or "
                        "sample farther (", Command("energy", Option("deflection")), ").")


def not_found(problem: GentleProblem, why: str) -> BlockedError:
    """Return the error for a path that was not found, with ``why``, which proves nothing."""
    return BlockedError(f"No path to the goal with{problem.limits_in_words() or ' known poses'} "
                        f"was found, {UNPROVEN}.", why, "Relax the limits slightly, or sample more "
                        "poses with ", Command("energy", Option("samples")), ".")


# The start of a path: at rest, at a given position, or drawn.


def start_of(field: EnergyField, goal: Goal, settings: PlanSettings) -> np.ndarray:
    """Return the requested start [m], shape [3].

    Raises:
        InputError: two are requested. NoPathError: none could be drawn.
    """
    if settings.start is not None and settings.start_seed is not None:
        raise InputError(Text("Both ", Option("start"), " and ", Option("start_seed"), " are "
                              "given."),
                         "A path has only one start.", "Give only one of them.")
    if settings.start is not None:
        return np.array(settings.start, float)
    if settings.start_seed is not None:
        return random_start(field, goal, settings, settings.start_seed)
    return field.rest.copy()


def random_start(field: EnergyField, goal: Goal, settings: PlanSettings, seed: int) -> np.ndarray:
    """Return a random deformed configuration far from rest and from the goal, shape [3].

    The paper's trials start from "randomized initial configurations", without stating how they were
    drawn. Here: uniform over the allowed region, at least half the largest deflection away from
    rest and from the goal's middle, and a quarter of it from its border.

    Raises:
        NoPathError: no such configuration was found.
    """
    generator = np.random.default_rng([seed, 7])
    points = field.region.draw(4000, generator)
    half = 0.5 * float(np.linalg.norm(field.samples.positions - field.rest, axis=1).max())
    fit = np.linalg.norm(points - field.rest, axis=1) >= half
    away = goal.distance(field, points)
    fit &= (away >= half) & (away >= goal.tolerance + 0.5 * half)
    fit &= allowed_points(points, Limits.of(settings).on(field))
    if not fit.any():
        raise NoPathError("No allowed deformed start is far from rest and far from the goal.",
                          f"The distance must be at least {half:.3f} m.",
                          "Give a ", Option("start"), ", or relax the limits.")
    return points[np.flatnonzero(fit)[0]]


def check_start(field: EnergyField, start: np.ndarray, limits: FieldArrays) -> None:
    """Raise InputError if the start [3] is not allowed, with the reason."""
    if allowed_points(start[None], limits)[0]:
        return
    position = ", ".join(f"{value:.3f}" for value in start)
    if not field.region.contains(start)[0]:
        away = float(np.linalg.norm(start - field.rest))
        raise InputError(f"The start ({position}) m lies outside the sampled "
                         f"region{unit_hint(away, field)}.", "The branch's energy is not known "
                         "there.", "Choose a start nearer to rest, or sample farther (",
                         Command("energy", Option("deflection")), ").").at(start)
    raise InputError(f"The start breaks a limit: {over_limits(field, start[None], limits)}.",
                     "A start must keep the limits.", "Raise the limit, or choose another start."
                     ).at(start)
