"""One planning problem: start, goal, cost per metre and limits."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from limber.core.errors import Command, InputError, NoPathError, Option, Text
from limber.planning.constraints.limits import Limits
from limber.planning.cost import EdgeWeights, arc_lengths, resample
from limber.planning.field.energy_field import EnergyField, FieldArrays, Quantity, limited
from limber.planning.field.valid_region import nearest_of
from limber.planning.goals.goal import Goal, allowed_points, over_limits, unit_hint
from limber.planning.settings import PlanSettings

_FINE = 0.001  # [m] spacing at which a finished path is costed and its validity checked
_ENDS = 500  # poses in the goal to which a start has its distance


UNPROVEN = "but it is not proven that none exists"
"""Part of messages without a path: more samples may show one. Checked across processes."""


class BlockedError(NoPathError):
    """No path keeps the limits on the field: proven, or none found. ``wall`` [k, 3] [m] are
    positions that block it, least over first; ``nearest`` those reached, nearest to the goal first,
    where the field does not know the target exactly."""

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
    """Any path from ``start`` into ``goal`` within ``limits`` (see ``EnergyField.limited``). The
    bound is for the whole ``asked_goal``, any length, and every branch whose energy is within
    ``field_error`` [J] of the field. The field exceeds the limits ``sure`` only where the branch
    exceeds those asked for (:data:`~.limits.SURELY`): they prove something."""

    energy_field: EnergyField
    limits: FieldArrays
    weights: EdgeWeights
    start: np.ndarray
    goal: Goal
    field_error: float = 0.0
    longest: float = np.inf
    sure: FieldArrays | None = None
    asked_goal: Goal | None = None

    @property
    def bounded_goal(self) -> Goal:
        """The goal to which no path costs less than the bound."""
        return self.asked_goal or self.goal

    def surely_limited(self) -> list[Quantity]:
        """Return the quantities with the limits beyond which a pose is ``sure`` not allowed."""
        if self.sure is None:
            return []
        return [replace(one, limit=one.limit + self.field_error) if one.name == "energy" else one
                for one in limited(self.energy_field, self.sure)]

    def cost(self, path: np.ndarray) -> float:
        """Return the cost of a polyline [n, 3]; infinite over a limit, too long or off the goal.
        Finer than planners' edges: reported values must not depend on their quadrature."""
        from limber.planning.cost import path_cost

        if self.goal_excess(path[-1]) > 1e-9:
            return np.inf
        fine = resample(np.ascontiguousarray(path, float), _FINE)
        if arc_lengths(fine)[-1] > self.longest * (1.0 + 1e-9):
            return np.inf
        return float(path_cost(fine, self.limits, self.weights._replace(step=_FINE)))

    def limits_in_words(self) -> str:
        """Describe the limits that are set, or return an empty string."""
        return _in_words((one, one.limit) for one in limited(self.energy_field, self.limits))

    def goal_excess(self, point: np.ndarray) -> float:
        """Return how far ``point`` [3] is outside the goal region [m], negative inside."""
        return float(self.goal.excess(self.energy_field, point[None])[0])


def least_over(problem: GentleProblem, points: np.ndarray) -> np.ndarray:
    """Return ``points`` [n, 3] in ascending order of their excess over a limit."""
    worst = np.zeros(len(points))
    for one in problem.surely_limited():
        worst = np.maximum(worst, one.size(points) / one.largest)
    return points[np.argsort(worst, kind="stable")]


def _in_words(limits: Iterable[tuple[Quantity, float]]) -> str:
    kept = [f"{one.words} {one.with_unit(limit)}" for one, limit in limits]
    return (" at most " + " and ".join(kept)) if kept else ""


def no_path_error(problem: GentleProblem, proof: str) -> BlockedError:
    """Return the error for a goal that no path reaches, with the ``proof``."""
    counted = _in_words((one, one.largest) for one in problem.surely_limited())
    if counted:
        proof += (" The proof includes the largest cross-validation error of the energy field: on "
                  f"the field no path keeps{counted} together either.")
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
    """Return the requested start [3] [m]. InputError if two are requested, NoPathError if none
    could be drawn."""
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
    """Draw a start evenly from the allowed region, the grasp at least half the largest deflection
    from rest and from the goal. The paper does not say how it drew its "randomized initial
    configurations", but its paths are about as long as its branches. NoPathError if none was
    found."""
    generator = np.random.default_rng([seed, 7])
    points = field.region.draw(4000, generator)
    half = 0.5 * float(np.linalg.norm(field.samples.positions - field.rest, axis=1).max())
    # By the grasp's way: the tip moves farther, and from just outside its goal there is little to
    # save.
    ends = goal.guess(field, _ENDS, np.random.default_rng(0))
    ends = ends[goal.excess(field, ends) <= 0.0]
    fit = np.linalg.norm(points - field.rest, axis=1) >= half
    fit &= nearest_of(points, ends)[0] >= half if len(ends) else goal.excess(field, points) > 0.0
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
