"""A point on the branch, its tip or a named target, in a region: ``--tip-goal``, ``--target-box``.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from limber.core.errors import InputError
from limber.planning.field.energy_field import EnergyField, FieldArrays
from limber.planning.field.grasp_model import GraspModel
from limber.planning.goals.allowed_poses import allowed_points
from limber.planning.goals.goal import NEARER, GoalKind, GoalRequest
from limber.planning.goals.regions import Ball, BoxRegion, Region, empty_along
from limber.planning.path_on_full_model import SolvedPoses

_COVERED = 0.95  # fraction of the samples that the margin covers
_MOST = 0.4  # fraction of a region's depth; where the field is worse, the full model decides
_SHARES = (1.0, 0.5, 0.2)  # fractions of the margin that are tried
_DRAWN = 200  # poses with which they are
_SMALL = 0.02  # [m] depth of a region up to which targets are drawn in all of it
_HALVINGS = 12  # halvings of a path into a region


@dataclass(frozen=True)
class TargetGoal:
    """A point on the branch within a region of space.

    Attributes:
        region: Region for the point.
        target: Number of the named target; None: the branch's tip.
        name: Name of the target.
        inset: Distance that plans keep from the region's outside [m]: what an earlier one missed.
        margin: Fraction of the field's error at each pose that plans keep from it as well.
        advice: As for any goal.
    """

    region: Region
    target: int | None = None
    name: str = "tip"
    inset: float = 0.0
    margin: float = 0.0
    advice: str = NEARER

    @property
    def tolerance(self) -> float:
        """Distance of the region's middle from its outside [m]."""
        return self.region.depth

    @property
    def what(self) -> str:
        return f"the {self.name}"

    @property
    def where(self) -> str:
        return f"within {self.region.words}"

    def distance(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        outside = self.region.distance(field.tip(points, self.target))
        return outside + self.tolerance + self._kept_off(field, points)

    def uncertainty(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        return self._kept_off(field, points) + field.place_errors(self.target, points)

    def _kept_off(self, field: EnergyField, points: np.ndarray) -> np.ndarray | float:
        """Return the distance from the region's outside that plans keep at ``points`` [m], [n]."""
        return self.inset + self.margin_at(field, points)

    def margin_at(self, field: EnergyField, points: np.ndarray) -> np.ndarray | float:
        """Return the part of it due to the field's error [m], shape [n]."""
        if self.margin == 0.0:
            return 0.0
        stated = field.place_errors(self.target, points, _COVERED)
        stated = np.where(np.isfinite(stated), stated, 0.0)  # not known: the full model decides
        return self.margin * np.minimum(stated, _MOST * self.tolerance)

    def with_margin(self, field: EnergyField, limits: FieldArrays, start: np.ndarray) -> Self:
        """Return the goal less the field's error in the target's position, or the largest of a few
        fractions of it with which a drawn pose keeps ``limits``; all of it if the ``start`` [3] is
        in it.
        """
        if self.distance(field, start[None])[0] <= self.tolerance:
            return self
        for share in _SHARES:
            part = replace(self, margin=share)
            points = part.guess(field, _DRAWN, np.random.default_rng(0))
            reached = part.distance(field, points) <= part.tolerance
            if allowed_points(np.ascontiguousarray(points[reached]), limits).any():
                return part
        return self

    def guess(self, field: EnergyField, count: int, generator: np.random.Generator) -> np.ndarray:
        # A small region is a thin bent lens in grasp space: draw everywhere, then walk onto it.
        # Points already in it stay: in a large one a walk may lead out of the samples.
        drawn = field.region.draw(20 * count, generator)
        distance = self.distance(field, drawn)
        points = drawn[distance <= self.tolerance][:count]
        found = np.concatenate([points, self._walked(
            field, drawn[np.argsort(distance)[len(points):count]], generator)])
        if (self.distance(field, found) <= self.tolerance).any():
            return found
        # Where the target moves far within millimetres of the grasp, draws miss a region that a
        # sample is in, or near to.
        known = field.samples.positions
        known = known[np.argsort(self.distance(field, known), kind="stable")[:count]]
        return np.concatenate([found, known, self._walked(field, known, generator)])

    def _walked(self, field: EnergyField, points: np.ndarray, generator: np.random.Generator,
                ) -> np.ndarray:
        """Return ``points`` [n, 3] moved so that the target approaches places in the region; none
        leaves the box that was sampled, beyond which the field knows nothing.
        """
        if not len(points):
            return points
        is_inside = self._entered(field.tip(points, self.target),
                                  self.region.draw(len(points), generator))
        for _ in range(8):
            outside = self.distance(field, points) > 0.5 * self.tolerance
            steps = _damped_steps(field.tip_gradient(points, self.target),
                                  is_inside - field.tip(points, self.target))
            points = np.clip(points + np.where(outside[:, None], steps, 0.0), field.region.low,
                             field.region.high)
        return points

    def _entered(self, positions: np.ndarray, is_inside: np.ndarray) -> np.ndarray:
        """Return the points [n, 3] on the path from ``positions`` to ``is_inside`` places in the
        region that are just inside: in a large region the others are far out of the branch's reach.
        """
        inside = 0.25 * self.tolerance if self.tolerance < _SMALL else 0.25 * _SMALL
        low, high = np.zeros(len(positions)), np.ones(len(positions))
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            deep = self.region.distance(
                positions + middle[:, None] * (is_inside - positions)) <= -inside
            low, high = np.where(deep, low, middle), np.where(deep, middle, high)
        return positions + high[:, None] * (is_inside - positions)

    def centre(self, field: EnergyField) -> np.ndarray:
        points = self.guess(field, 50, np.random.default_rng(0))
        trusted = points[field.region.contains(points)]
        points = trusted if len(trusted) else points
        return points[np.argmin(self.distance(field, points))]

    def target_position(self, states: SolvedPoses) -> np.ndarray:
        """Return the target's position in the last state [m], shape [3]."""
        return states.tips[-1] if self.target is None else states.targets[-1, self.target]

    def missed_by(self, states: SolvedPoses) -> float:
        """Return how far outside the region the target is in the last state [m]; inside: below 0.
        """
        return float(self.region.distance(self.target_position(states)[None])[0])

    def drawn_in(self, states: SolvedPoses) -> Self:
        """Return the goal moved inwards by the last state's distance from it, at most half."""
        missed = max(self.missed_by(states), 0.0)
        return replace(self, inset=min(self.inset + 1.5 * missed, 0.5 * self.tolerance))

    def require_end(self, grasp_model: GraspModel, states: SolvedPoses) -> None:
        pass

    def describe(self) -> dict:
        return {"kind": "tip" if self.target is None else "target", "target": self.name,
                "position_m": self.region.middle.tolist(), "tolerance_m": self.tolerance,
                "region": self.region.describe()}

    def describe_end(self, states: SolvedPoses) -> dict:
        return {"target_end_m": self.target_position(states)}


def _damped_steps(slope: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Gauss-Newton steps [n, 3] for d tip_c / d x_k = ``slope`` [n, k, c], damped where flat."""
    normal = slope @ slope.transpose(0, 2, 1) + 1e-3 * np.eye(3)
    return np.linalg.solve(normal, slope @ missing[:, :, None])[:, :, 0]


def target_of(asked: GoalRequest) -> tuple[int | None, str]:
    """Return number and name of the requested target.

    Raises:
        InputError: the branch has no target of that name.
    """
    name = asked.settings.target
    names = [target.name for target in asked.grasp_model.branch.targets]
    if name is None:
        return None, "tip"
    if name not in names:
        raise InputError(f"The branch has no target named {name}.",
                         f"Its targets are: {', '.join(names) or 'none'}.",
                         "Define one with `limber target`.")
    return names.index(name), name


def _in_ball(asked: GoalRequest, centre: tuple[float, float, float]) -> TargetGoal:
    return TargetGoal(Ball(centre, asked.settings.goal_tolerance), *target_of(asked))


def _in_box(asked: GoalRequest, corners: tuple[float, ...]) -> TargetGoal:
    x, y, z, *far = corners
    low, high = (x, y, z), (far[0], far[1], far[2])
    if not np.all(np.less(low, high)):
        raise InputError(f"The target's box is empty {empty_along(low, high)}.",
                         "Its lower corner must be below the upper one in x, y and z.",
                         "Correct --target-box.")
    return TargetGoal(BoxRegion(low, high), *target_of(asked),
                      advice="Choose a larger --target-box, or one nearer to this region")


IN_BALL = GoalKind("tip_goal", _in_ball, is_of_target=True, is_place=True)
IN_BOX = GoalKind("target_box", _in_box, is_of_target=True)
