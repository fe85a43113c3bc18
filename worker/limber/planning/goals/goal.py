"""Where a path may end: the grasp at a place, or a place on the branch in a region."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from limber.core.errors import NoPathError
from limber.core.numerics.compiled import compiled
from limber.planning.field.energy_field import (
    LOADS,
    EnergyField,
    FieldArrays,
    allowed_at,
    energy_at,
)
from limber.planning.goals.regions import Region, ball
from limber.planning.path_on_full_model import SolvedPoses

_MILLIMETRES = 30.0  # times the sampled region's size: nobody asks for what is so far off


class GoalOverLimitsError(NoPathError):
    """None of the poses that were drawn in the goal region keeps the limits."""


class Goal(Protocol):
    """A region of grasp positions."""

    tolerance: float

    def distance(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        """Return how far off the goal the branch is with its grasp at ``points`` [m], [n]."""
        ...

    def doubt(self, field: EnergyField) -> float:
        """Return how much nearer than its ``distance`` the branch may be at most [m]; infinite
        where the field's error is not known."""
        ...

    def guess(self, field: EnergyField, count: int, generator: np.random.Generator) -> np.ndarray:
        """Return grasp positions likely to be in the region, shape [n, 3]."""
        ...

    def centre(self, field: EnergyField) -> np.ndarray:
        """Return one grasp position that stands for the region, the same for any seed, [3]."""
        ...

    def describe(self) -> dict:
        """Return the goal as plain data."""
        ...


@dataclass(frozen=True)
class GraspGoal:
    """The grasp within ``tolerance`` [m] of ``position`` [m]."""

    position: tuple[float, float, float]
    tolerance: float

    def distance(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(np.asarray(points) - self.position, axis=1)

    def doubt(self, field: EnergyField) -> float:
        return 0.0

    def guess(self, field: EnergyField, count: int, generator: np.random.Generator) -> np.ndarray:
        inside = ball(count, generator) * self.tolerance + self.position
        inside[0] = self.position
        return inside

    def centre(self, field: EnergyField) -> np.ndarray:
        return np.array(self.position, float)

    def describe(self) -> dict:
        return {"kind": "grasp", "position_m": list(map(float, self.position)),
                "tolerance_m": self.tolerance}


@dataclass(frozen=True)
class TargetGoal:
    """A place on the branch within a region of space.

    Attributes:
        region: Where it shall be.
        target: Number of the named target; None: the branch's tip.
        name: Of the target.
        inset: What plans stay off the region's outside by [m]: as far as the field was off there.
    """

    region: Region
    target: int | None = None
    name: str = "tip"
    inset: float = 0.0

    @property
    def tolerance(self) -> float:
        """Distance of the region's middle from its outside [m]."""
        return self.region.depth

    def distance(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        outside = self.region.distance(field.tip(points, self.target))
        return outside + self.tolerance + self.inset

    def doubt(self, field: EnergyField) -> float:
        return self.inset + field.place_error(self.target)

    def guess(self, field: EnergyField, count: int, generator: np.random.Generator) -> np.ndarray:
        # A small region is a thin bent lens in grasp space: draw everywhere, then walk onto it.
        # Who is in it already stays: in a large one a walk may lead out of the samples.
        drawn = field.region.draw(20 * count, generator)
        distance = self.distance(field, drawn)
        points = drawn[distance <= self.tolerance][:count]
        return np.concatenate([points, self._walked(
            field, drawn[np.argsort(distance)[len(points):count]], generator)])

    def _walked(self, field: EnergyField, points: np.ndarray, generator: np.random.Generator,
                ) -> np.ndarray:
        """Return ``points`` [n, 3] moved so that the target comes towards places in the region."""
        wanted = self.region.draw(len(points), generator)
        for _ in range(8):
            outside = self.distance(field, points) > 0.5 * self.tolerance
            steps = _damped_steps(field.tip_gradient(points, self.target),
                                  wanted - field.tip(points, self.target))
            points = points + np.where(outside[:, None], steps, 0.0)
        return points

    def centre(self, field: EnergyField) -> np.ndarray:
        points = self.guess(field, 50, np.random.default_rng(0))
        trusted = points[field.region.contains(points)]
        points = trusted if len(trusted) else points
        return points[np.argmin(self.distance(field, points))]

    def place(self, states: SolvedPoses) -> np.ndarray:
        """Return where the target is in the last of the states [m], shape [3]."""
        return states.tips[-1] if self.target is None else states.targets[-1, self.target]

    def missed_by(self, states: SolvedPoses) -> float:
        """Return how far outside the region the target is in the last state [m]; inside: below 0.
        """
        return float(self.region.distance(self.place(states)[None])[0])

    def drawn_in(self, states: SolvedPoses) -> "TargetGoal":
        """Return the goal further in by what the last of the states misses it by, at most half."""
        missed = max(self.missed_by(states), 0.0)
        return replace(self, inset=min(self.inset + 1.5 * missed, 0.5 * self.tolerance))

    def describe(self) -> dict:
        return {"kind": "tip" if self.target is None else "target", "target": self.name,
                "position_m": self.region.middle.tolist(), "tolerance_m": self.tolerance,
                "region": self.region.describe()}


def goal_points(goal: Goal, field: EnergyField, limits: FieldArrays, *, count: int = 200,
                seed: int = 0) -> np.ndarray:
    """Return allowed grasp positions in the goal region, at most ``count``, shape [n, 3].

    Raises:
        NoPathError: the region is out of reach. GoalOverLimitsError: none was drawn that keeps the
            limits; in a narrow valley one may.
    """
    points = goal.guess(field, count, np.random.default_rng(seed))
    reached = points[goal.distance(field, points) <= goal.tolerance]
    trusted = reached[field.region.contains(reached)]
    if len(trusted) == 0:
        raise _out_of_reach(goal, field, seed)
    allowed = trusted[allowed_points(trusted, limits)]
    if len(allowed) == 0:
        raise GoalOverLimitsError(
            f"No pose in the goal region keeps the limits: {over_limits(field, trusted, limits)}.",
            f"{len(trusted)} poses in it were drawn.",
            "Raise the limit (--max-energy, --max-force and others, the workspace), or choose a "
            "goal nearer to the rest pose.")
    return np.ascontiguousarray(allowed)


def over_limits(field: EnergyField, points: np.ndarray, limits: FieldArrays) -> str:
    """Return in words which limits none of ``points`` [n, 3] keeps, and by how much."""
    outside = np.maximum(limits.low - points, points - limits.high).max(axis=1)
    found = [("energy", field.energy(points), limits.max_energy, " J"),
             ("force", np.linalg.norm(field.force(points), axis=1), limits.max_force, " N")]
    found += [(name.replace("_", " "), np.abs(field.load(points, name)), limit, unit)
              for name, limit, unit in zip(LOADS, limits.max_loads, ("", " Pa", " N", " Nm", ""),
                                           strict=True) if limit < np.inf]
    told = [f"the {name} is at least {values.min():.3g}{unit} where {limit:.3g}{unit} is allowed"
            for name, values, limit, unit in found if values.min() > limit]
    if outside.min() > 0.0:
        told.append(f"the workspace is {outside.min():.3f} m away"
                    + unit_doubt(outside.min(), field))
    return " and ".join(told) or "each pose breaks one or the other"


@compiled
def allowed_points(points: np.ndarray, limits: FieldArrays) -> np.ndarray:
    """Return whether each of ``points`` [n, 3] is trusted and within the limits, bool [n]."""
    allowed = np.empty(len(points), np.bool_)
    for i in range(len(points)):
        allowed[i] = allowed_at(points[i], energy_at(points[i], limits), limits)
    return allowed


def default_goal(field: EnergyField, tolerance: float) -> GraspGoal:
    """Return a goal worth planning for: far from rest, and reached without force.

    Of the samples deflected by over three quarters of the largest deflection, the one with the
    least energy, drawn a little towards the rest pose so that the region lies where the field is
    trusted. The trusted region is a shell, often thinner than the tolerance: what counts is how
    much of the goal lies in it along the shell.
    """
    chart = field.region.chart.plain
    samples = chart.map(field.samples.positions)
    rest = chart.map(field.rest)[0]
    away = np.linalg.norm(field.samples.positions - field.rest, axis=1)
    far = np.flatnonzero(away >= 0.75 * away.max())
    around = ball(100, np.random.default_rng(0)) * tolerance
    if chart.radius > 0.0:
        around[:, 2] = 0.0
    for index in far[np.argsort(field.samples.energies[far])]:
        for shrink in (1.0, 0.95, 0.9, 0.85):
            centre = rest + shrink * (samples[index] - rest)
            position = chart.curved(centre[None])[0]
            if (field.region.contains(chart.curved(centre + around)).mean() > 0.5
                    and field.region.contains(position)[0]):
                return GraspGoal(tuple(map(float, position)), tolerance)
    raise NoPathError("No far pose lies well inside the sampled region.",
                      f"Too few of {len(away)} accepted samples are far from the rest pose.",
                      "Sample more poses with `limber energy --samples`, or name a --goal.")


def hemisphere_goal(field: EnergyField, base: np.ndarray, length: float, limits: FieldArrays,
                    tolerance: float, seed: int) -> GraspGoal:
    """Return a goal as the paper draws its candidates: evenly from the half ball above the branch's
    ``base`` [m] with its ``length`` [m] as radius; of those, one that the field knows, that keeps
    the limits and lies at least half the largest deflection away from rest.

    Raises:
        NoPathError: no such pose was found.
    """
    points = field.region.draw(4000, np.random.default_rng([seed, 13]))
    half = 0.5 * float(np.linalg.norm(field.samples.positions - field.rest, axis=1).max())
    fit = (np.linalg.norm(points - base, axis=1) <= length) & (points[:, 2] >= base[2])
    fit &= np.linalg.norm(points - field.rest, axis=1) >= half
    fit &= allowed_points(points, limits)
    if not fit.any():
        raise NoPathError("No pose of the hemisphere lies far from rest and keeps the limits.",
                          f"Far is {half:.3f} m; the hemisphere's radius is {length:.3f} m.",
                          "Give a --goal, or relax the limits.")
    return GraspGoal(tuple(map(float, points[np.flatnonzero(fit)[0]])), tolerance)


def _out_of_reach(goal: Goal, field: EnergyField, seed: int) -> NoPathError:
    points = field.region.draw(2000, np.random.default_rng(seed))
    distance = goal.distance(field, points)
    nearest = points[np.argmin(distance)]
    place = ", ".join(f"{value:.3f}" for value in nearest)
    what = f"the {goal.name}" if isinstance(goal, TargetGoal) else "the grasp"
    return NoPathError(
        f"No sampled pose brings {what} to the goal; the nearest misses it by "
        f"{distance.min():.3f} m, with the grasp at ({place})"
        f"{unit_doubt(float(distance.min()), field)}.",
        f"The tolerance is {goal.tolerance:.3f} m and the branch was sampled from "
        f"{_place(field.region.low)} to {_place(field.region.high)}.",
        "Choose a goal nearer to that, widen --goal-tolerance, or sample farther (`limber "
        "energy --deflection`).")


def unit_doubt(off: float, field: EnergyField) -> str:
    """Return words of doubt about the unit where something is so far ``off`` [m] that it can hardly
    be in metres; nothing else."""
    size = float(np.linalg.norm(field.region.high - field.region.low))
    return " (in millimetres? Lengths are in metres)" if off > _MILLIMETRES * size else ""


def _place(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.3f}" for value in point) + ")"


def _damped_steps(slope: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Gauss-Newton steps [n, 3] for d tip_c / d x_k = ``slope`` [n, k, c], damped where flat."""
    normal = slope @ slope.transpose(0, 2, 1) + 1e-3 * np.eye(3)
    return np.linalg.solve(normal, slope @ missing[:, :, None])[:, :, 0]
