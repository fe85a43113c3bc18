"""The kinds of goals, and the one requested by a plan's settings."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from limber.core.errors import Command, InputError, NoPathError, Option, Text
from limber.planning.field.energy_field import EnergyField, FieldArrays, refit
from limber.planning.field.grasp_model import GraspModel
from limber.planning.field.sampling import solve_branch
from limber.planning.field.stored_states import States
from limber.planning.field.valid_region import nearest_of
from limber.planning.goals.goal import (
    NEARER,
    Ball,
    BoxRegion,
    CellPlace,
    Convex,
    Goal,
    GoalKind,
    GoalRequest,
    Region,
    allowed_points,
    ball,
    empty_along,
    position_text,
)
from limber.planning.settings import PlanSettings

# The grasp at a position: ``--goal``.


@dataclass(frozen=True)
class GraspGoal:
    """The grasp within ``tolerance`` [m] of ``position`` [m]."""

    position: tuple[float, float, float]
    tolerance: float

    what = "the grasp"
    advice = NEARER

    @property
    def where(self) -> str:
        return f"within {self.tolerance:.3f} m of {position_text(self.position)} m"

    def distance(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(np.asarray(points) - self.position, axis=1)

    def uncertainty(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        return np.zeros(len(points))

    def guess(self, field: EnergyField, count: int, generator: np.random.Generator) -> np.ndarray:
        inside = ball(count, generator) * self.tolerance + self.position
        inside[0] = self.position
        return inside

    def centre(self, field: EnergyField) -> np.ndarray:
        return np.array(self.position, float)

    def missed_by(self, states: States) -> float:
        return float(np.linalg.norm(states.poses[-1, :3] - self.position)) - self.tolerance

    def drawn_in(self, states: States) -> "GraspGoal":
        return self

    def require_end(self, grasp_model: GraspModel, states: States) -> None:
        pass

    def describe(self) -> dict:
        return {"kind": "grasp", "position_m": list(map(float, self.position)),
                "tolerance_m": self.tolerance}

    def describe_end(self, states: States) -> dict:
        return {}


def near(position: np.ndarray, tolerance: float) -> GraspGoal:
    """Return the goal of a grasp within ``tolerance`` [m] of ``position`` [3]."""
    x, y, z = map(float, position)
    return GraspGoal((x, y, z), tolerance)


AT_PLACE = GoalKind(
    "goal", lambda asked, place: near(place, asked.settings.goal_tolerance), is_place=True)


# A point on the branch, its tip or a named target, in a region: ``--tip-goal``, ``--target-box``.

_COVERED = 0.95  # fraction of the samples that the margin covers
_MOST = 0.4  # fraction of a region's depth; where the field is worse, the full model decides
_SHARES = (1.0, 0.5, 0.2)  # fractions of the margin that are tried
_DRAWN = 200  # poses with which they are
_SMALL = 0.02  # [m] depth of a region up to which targets are drawn in all of it
_HALVINGS = 12  # halvings of a path into a region
_GROWN = 8  # most states of the branch model towards a region


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
        leaves the box that was sampled, beyond which the field knows nothing."""
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
        """Points [n, 3] just inside the region on the path to places inside: in a large region
        others are far out of the branch's reach."""
        inside = 0.25 * self.tolerance if self.tolerance < _SMALL else 0.25 * _SMALL
        low, high = np.zeros(len(positions)), np.ones(len(positions))
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            deep = self.region.distance(
                positions + middle[:, None] * (is_inside - positions)) <= -inside
            low, high = np.where(deep, low, middle), np.where(deep, middle, high)
        return positions + high[:, None] * (is_inside - positions)

    def grown(self, field: EnergyField, grasp_model: GraspModel) -> EnergyField:
        """Return the field with states of the branch model on the way from the sample nearest to
        the region into it, where the field has no pose in it; as it is if the way does not end
        there."""
        drawn = self.guess(field, _DRAWN, np.random.default_rng(0))
        nearest = int(self.region.distance(self.target_positions(field.samples)).argmin())
        place, states = field.samples.positions[nearest][None], list[States]()
        while len(states) < _GROWN and (self.distance(field, drawn) > self.tolerance).all():
            found = solve_branch(grasp_model, place, workers=1)[0]
            if not found:
                break
            states.append(found[0].state)
            if len(states) > 1 and self.missed_by(states[-1]) <= 0.0:
                return refit(field, States.joined(*states[1:]))
            tip = self.target_positions(states[-1])
            place = place + _damped_steps(field.tip_gradient(place, self.target),
                                          self._entered(tip, self.region.middle[None]) - tip)
        return field

    def centre(self, field: EnergyField) -> np.ndarray:
        points = self.guess(field, 50, np.random.default_rng(0))
        trusted = points[field.region.contains(points)]
        points = trusted if len(trusted) else points
        return points[np.argmin(self.distance(field, points))]

    def target_positions(self, states: States) -> np.ndarray:
        """Return the target's position in each state [m], shape [n, 3]."""
        return states.tips if self.target is None else states.targets[:, self.target]

    def missed_by(self, states: States) -> float:
        """Return how far outside the region the target is in the last state [m]; inside: below 0.
        """
        return float(self.region.distance(self.target_positions(states))[-1])

    def drawn_in(self, states: States) -> Self:
        """Return the goal moved inwards by the last state's distance from it, at most half."""
        missed = max(self.missed_by(states), 0.0)
        return replace(self, inset=min(self.inset + 1.5 * missed, 0.5 * self.tolerance))

    def require_end(self, grasp_model: GraspModel, states: States) -> None:
        pass

    def describe(self) -> dict:
        return {"kind": "tip" if self.target is None else "target", "target": self.name,
                "position_m": self.region.middle.tolist(), "tolerance_m": self.tolerance,
                "region": self.region.describe()}

    def describe_end(self, states: States) -> dict:
        return {"target_end_m": self.target_positions(states)[-1]}


def _damped_steps(slope: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Gauss-Newton steps [n, 3] for d tip_c / d x_k = ``slope`` [n, k, c], damped where flat."""
    normal = slope @ slope.transpose(0, 2, 1) + 1e-3 * np.eye(3)
    return np.linalg.solve(normal, slope @ missing[:, :, None])[:, :, 0]


def target_of(asked: GoalRequest) -> tuple[int | None, str]:
    """Return number and name of the requested target. InputError if the branch has no target of
    that name."""
    name = asked.settings.target
    names = [target.name for target in asked.grasp_model.branch.targets]
    if name is None:
        return None, "tip"
    if name not in names:
        raise InputError(f"The branch has no target named {name}.",
                         f"Its targets are: {', '.join(names) or 'none'}.",
                         "Define one with ", Command("target"), ".")
    return names.index(name), name


def _in_ball(asked: GoalRequest, centre: tuple[float, float, float]) -> TargetGoal:
    return TargetGoal(Ball(centre, asked.settings.goal_tolerance), *target_of(asked))


def _in_box(asked: GoalRequest, corners: tuple[float, ...]) -> TargetGoal:
    x, y, z, *far = corners
    low, high = (x, y, z), (far[0], far[1], far[2])
    if not np.all(np.less(low, high)):
        raise InputError(f"The target's box is empty {empty_along(low, high)}.",
                         "Its lower corner must be below the upper one in x, y and z.",
                         "Correct ", Option("target_box"), ".")
    return TargetGoal(BoxRegion(low, high), *target_of(asked),
                      advice=Text("Choose a larger ", Option("target_box"), ", or one nearer to "
                                  "this region"))


IN_BALL = GoalKind("tip_goal", _in_ball, is_of_target=True, is_place=True)
IN_BOX = GoalKind("target_box", _in_box, is_of_target=True)


# A chosen goal: a pose drawn from the paper's hemisphere (``--goal-seed``), a distant one, or the
# reach of a second arm.

_REACH = 0.85  # [m] of a UR5, which stands for the second arm
_HALF = 0.5  # of the grasp's way to the default goal
_TIP_TOLERANCE = 0.02  # [m] about a flower's radius
_BEGINS = 0.6  # fraction of the tip's way to the default goal at which that reach begins


def default_goal(field: EnergyField, tolerance: float) -> GraspGoal:
    """Return a goal far from rest that needs no force: the sample of least energy among those over
    three quarters of the largest deflection, moved a little towards rest. Trust is a shell often
    thinner than the tolerance: what counts is the part of the goal along it."""
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
                return near(position, tolerance)
    raise NoPathError("No distant pose lies well inside the sampled region.",
                      f"Too few of the {len(away)} accepted samples are far from the rest pose.",
                      "Sample more poses with ", Command("energy", Option("samples")), ", or give "
                      "a ", Option("goal"), ".")


def second_arm_goal(field: EnergyField) -> TargetGoal:
    """The paper's goal: the tip with its flower in a second arm's reach, a ball on the side to
    which the branch bends with least energy. NoPathError if there is no far pose."""
    far = default_goal(field, 0.01).centre(field)
    rest, there = field.tip(np.stack([field.rest, far]))
    way = there - rest
    x, y, z = map(float, rest + (_BEGINS + _REACH / np.linalg.norm(way)) * way)
    return TargetGoal(Ball((x, y, z), _REACH))


def tip_goal(field: EnergyField) -> TargetGoal:
    """A goal as a person states one: a small ball some centimetres from the tip, which is there
    with the grasp half-way to the default goal. NoPathError if there is no far pose."""
    chart = field.region.chart.plain
    rest, far = chart.map(np.stack([field.rest, default_goal(field, 0.01).centre(field)]))
    x, y, z = map(float, field.tip(chart.curved((rest + _HALF * (far - rest))[None]))[0])
    return TargetGoal(Ball((x, y, z), _TIP_TOLERANCE))


def hemisphere_goal(field: EnergyField, base: np.ndarray, length: float, limits: FieldArrays,
                    tolerance: float, seed: int) -> GraspGoal:
    """A goal drawn as the paper's: evenly in the half ball of the branch's length above its base
    [m], in the trusted field, within limits, at least half the largest deflection from rest.
    NoPathError if none was found."""
    points = field.region.draw(4000, np.random.default_rng([seed, 13]))
    half = 0.5 * float(np.linalg.norm(field.samples.positions - field.rest, axis=1).max())
    fit = (np.linalg.norm(points - base, axis=1) <= length) & (points[:, 2] >= base[2])
    fit &= np.linalg.norm(points - field.rest, axis=1) >= half
    fit &= allowed_points(points, limits)
    if not fit.any():
        raise NoPathError("No pose in the hemisphere is far from rest and keeps the limits.",
                          f"A distant pose is at least {half:.3f} m from rest; the hemisphere's "
                          f"radius is {length:.3f} m.",
                          "Give a ", Option("goal"), ", or relax the limits.")
    return near(points[np.flatnonzero(fit)[0]], tolerance)


def _drawn(asked: GoalRequest, seed: int) -> GraspGoal:
    reach = asked.grasp_model.reach
    return hemisphere_goal(asked.field, reach.base, reach.arc_length, asked.limits,
                           asked.settings.goal_tolerance, seed)


DRAWN = GoalKind("goal_seed", _drawn)


# The target in a region that a robot's cell gives: ``--goal-in``.
#
# The region is an outer bound: within it the arm may not reach every position, and the branch may
# hide the target. Which grasp poses are valid is tested at poses of the field (for an arm, whose
# kinematics depend on the target's position alone) or of the branch model (for a view, past the
# branch's own surface), and by bisection between the two kinds. Elsewhere a pose counts as valid if
# it is nearer to a valid one than to an invalid one. Each planned path adds its own states, so that
# the border is refined where paths end.

_PLACES_DRAWN = 2000  # poses of the field searched for those in the region
_ASKED = 150  # most of these, where only the target's position counts
_PAIRS, _PAIR_HALVINGS = 40, 5  # pairs between which the border is searched; halvings
_SOLVED = 16  # most states of the branch model, where its surface counts as well
_SOLVED_PAIRS, _SOLVED_HALVINGS = 4, 3  # the same with states of the branch model
_WARIER = 3.0  # factor on the caution after each end that is not valid
_NOWHERE = np.empty((0, 3))


@dataclass(frozen=True, kw_only=True)
class CellGoal(TargetGoal):
    """A target at a valid position in a region of the cell. ``taken`` and ``refused`` are grasp
    positions [m] in it where it is valid or not, and ``causes`` why not, as clauses. ``caution`` is
    how many times nearer to a valid one than to an invalid one a plan ends."""

    cell_place: CellPlace
    grasp_model: GraspModel
    taken: np.ndarray = field(default_factory=_NOWHERE.copy)
    refused: np.ndarray = field(default_factory=_NOWHERE.copy)
    causes: tuple[str, ...] = ()
    caution: float = 1.0

    @property
    def where(self) -> str:
        return f"within {self.cell_place.words}"

    def distance(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        within = super().distance(field, points)
        if not len(self.refused) or not len(self.taken):
            return within
        points = np.ascontiguousarray(points, float).reshape(-1, 3)
        nearer = (self.caution * nearest_of(points, self.taken)[0]
                  - nearest_of(points, self.refused)[0])
        return np.maximum(within, self.tolerance + nearer / (1.0 + self.caution))

    def uncertainty(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        # Between invalid poses there may be a valid one: then nothing is proven.
        if len(self.refused):
            return np.full(len(points), np.inf)
        return super().uncertainty(field, points)

    def drawn_in(self, states: States) -> Self:
        found = super().drawn_in(states)._met(states)
        if not len(found.taken) or not self._cause(self.target_positions(states)[-1],
                                                   states.displacements[-1]):
            return found
        # What the field takes for valid may not be: the branch model says what is.
        chosen = found.taken[_far_apart(found.taken, _SOLVED)]
        known = replace(found, taken=_NOWHERE)._solved(chosen)
        return replace(known if len(known.taken) else found, caution=found.caution * _WARIER)

    def require_end(self, grasp_model: GraspModel, states: States) -> None:
        self.cell_place.require(self.what, self.target_positions(states)[-1],
                                self._surface(states.displacements[-1]))

    def learnt(self, field: EnergyField) -> Self:
        """Return the goal with the results at poses of the field. NoPathError if the target is in
        the region at some of them, and valid at none."""
        if self.cell_place.of_surface:
            found = self._of_states(field)
        else:
            points = np.concatenate([field.rest[None], field.region.draw(
                _PLACES_DRAWN, np.random.default_rng(0))])
            points = points[TargetGoal.distance(self, field, points) <= self.tolerance][:_ASKED]
            found = self._asked(points, field.tip(points, self.target), None)._sharpened(
                lambda middle: [self._cause(one, None) for one in field.tip(middle, self.target)],
                _PAIRS, _PAIR_HALVINGS)
        if len(found.refused) and not len(found.taken):
            raise found.refusal()
        return found

    def _sharpened(self, causes_at: Callable[[np.ndarray], list[str]], pairs: int, halvings: int,
                   ) -> Self:
        """Return the goal with poses near its border: between invalid ones and the nearest valid
        ones; ``causes_at`` gives why each of some poses [n, 3] is not valid."""
        if not len(self.taken) or not len(self.refused):
            return self
        chosen = _far_apart(self.refused, pairs)
        wrong, causes = self.refused[chosen], [self.causes[k] for k in chosen]
        distance = np.linalg.norm(wrong[:, None] - self.taken[None], axis=2)
        right = self.taken[distance.argmin(axis=1)]
        for _ in range(halvings):
            middle = 0.5 * (wrong + right)
            found = causes_at(middle)
            does = np.array([not cause for cause in found])[:, None]
            wrong, right = np.where(does, wrong, middle), np.where(does, middle, right)
            causes = [new or old for new, old in zip(found, causes, strict=True)]
        return replace(self, taken=np.concatenate([self.taken, right]),
                       refused=np.concatenate([self.refused, wrong]),
                       causes=(*self.causes, *causes))

    def _of_states(self, field: EnergyField) -> Self:
        """Test states of the branch model at samples of the field in the region, far apart, and
        between them."""
        inside = field.samples.positions[
            self.region.distance(self.target_positions(field.samples)) <= 0.0]
        if not len(inside):
            return self

        def causes_at(middle: np.ndarray) -> list[str]:
            causes = ["the branch has no equilibrium there"] * len(middle)
            for one in solve_branch(self.grasp_model, middle, workers=1)[0]:
                causes[one.target] = self._cause(self.target_positions(one.state)[0],
                                                 one.state.displacements[0])
            return causes
        return self._solved(inside[_far_apart(inside, _SOLVED)])._sharpened(
            causes_at, _SOLVED_PAIRS, _SOLVED_HALVINGS)

    def _solved(self, grasps: np.ndarray) -> Self:
        """Return the goal with what the branch model comes to at ``grasps`` [n, 3]."""
        found = [one.state for one in solve_branch(self.grasp_model, grasps, workers=1)[0]]
        return self._met(States.joined(*found)) if found else self

    def _met(self, states: States) -> Self:
        return self._asked(states.positions, self.target_positions(states), states.displacements)

    def _asked(self, grasps: np.ndarray, positions: np.ndarray, moved: np.ndarray | None) -> Self:
        """Return the goal with poses [n, 3] added that have the target at ``positions`` [n, 3]; the
        nodes are displaced by ``moved`` [n, nodes, 3] there."""
        inside = np.flatnonzero(self.region.distance(positions) <= 0.0)
        causes = [self._cause(positions[k], None if moved is None else moved[k]) for k in inside]
        does = np.array([not cause for cause in causes], bool)
        return replace(self, taken=np.concatenate([self.taken, grasps[inside[does]]]),
                       refused=np.concatenate([self.refused, grasps[inside[~does]]]),
                       causes=(*self.causes, *filter(None, causes)))

    def _cause(self, position: np.ndarray, moved: np.ndarray | None) -> str:
        """Return why a position is not valid, with the nodes displaced by ``moved`` [n, 3]; empty
        if it is."""
        if self.region.distance(position[None])[0] > 0.0:
            return "it lies outside"
        surface = None
        if self.cell_place.of_surface and moved is not None:
            surface = self._surface(moved)
        return self.cell_place.blocked(position, surface)

    def _surface(self, moved: np.ndarray) -> np.ndarray:
        """Return the surface's triangles [f, 3, 3] with nodes displaced by ``moved`` [n, 3]."""
        mesh = self.grasp_model.mesh
        return (mesh.nodes + moved)[mesh.surface_faces()]

    def refusal(self) -> NoPathError:
        """Return the error of a goal that no pose reached, with the causes."""
        count, causes = len(self.refused), Counter(self.causes).most_common()
        counted = (f"{causes[0][0]} at each" if len(causes) == 1 else
                   ", ".join(f"{cause} at {number}" for cause, number in causes))
        return NoPathError(f"{self.cell_place.refusal.format(what=self.what)} at any of the "
                           f"{count} poses that were checked: {counted}.", "At these poses "
                           f"{self.what} lies {self.where}.", self.advice, ", or sample farther (",
                           Command("energy", Option("deflection")), ").")


def _far_apart(points: np.ndarray, count: int) -> np.ndarray:
    """Return numbers of at most ``count`` of ``points`` [n, 3], each far from those before."""
    chosen = [0]
    away = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < min(count, len(points)) and away.max() > 0.0:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


_ENTRIES = {"view": "[camera] at a fixed position", "second_arm": "[second_arm]"}


def _in_cell(asked: GoalRequest, name: str) -> CellGoal:
    if name not in asked.cell:
        raise InputError(Text(Option("goal_in", name), " is given without a cell that has a "
                              f"{_ENTRIES[name]}."), "The cell file states its position.", "Give ",
                         Option("cell"), " with such a file.")
    place = asked.cell[name]
    return CellGoal(place.region, *target_of(asked), advice=place.advice, cell_place=place,
                    grasp_model=asked.grasp_model).learnt(asked.field)


IN_CELL = GoalKind("goal_in", _in_cell, is_of_target=True)
KINDS = [AT_PLACE, IN_BALL, IN_BOX, IN_CELL, DRAWN]
"""An external kind is appended to it."""


def asked_kinds(settings: PlanSettings) -> list[GoalKind]:
    """Return the kinds of goals that settings request."""
    return [kind for kind in KINDS if kind.is_asked(settings)]


def goal_of(request: GoalRequest) -> Goal:
    """Return the requested goal, or a distant pose. InputError if two are requested or one is
    invalid, NoPathError if there is no far pose."""
    settings = request.settings
    asked = asked_kinds(settings)
    if len(asked) > 1:
        raise InputError(f"{' and '.join(kind.option for kind in asked)} are given.",
                         "A path has only one goal.", "Give only one of them.")
    if settings.target is not None and not any(kind.is_of_target for kind in asked):
        *others, last = [kind.option for kind in KINDS if kind.is_of_target]
        raise InputError(
            Text(Option("target", settings.target), " is given without a goal for it."), "A target "
            "alone does not state where it must move.", f"Also give {', '.join(others)} or {last}.")
    if not asked:
        return default_goal(request.field, settings.goal_tolerance)
    return asked[0].make(request, getattr(settings, asked[0].name))


# The view of a fixed camera, and occlusion of a target in it.


@dataclass(frozen=True)
class View(Convex):
    """The view of a pinhole camera in the range of z [m]: its frame [4, 4] in the branch's (x
    right, y down, z ahead), and x / z and y / z at the borders left, right, top, bottom."""

    frame: np.ndarray
    slopes: tuple[float, float, float, float]
    range_m: tuple[float, float]

    @property
    def planes(self) -> np.ndarray:
        left, right, top, bottom = self.slopes
        near, far = self.range_m
        own = np.array([[-1, 0, left, 0], [1, 0, -right, 0], [0, -1, top, 0], [0, 1, -bottom, 0],
                        [0, 0, -1, near], [0, 0, 1, -far]], float)
        own /= np.linalg.norm(own[:, :3], axis=1, keepdims=True)
        normals = own[:, :3] @ self.frame[:3, :3].T
        return np.column_stack([normals, own[:, 3] - normals @ self.frame[:3, 3]])

    @property
    def corners(self) -> np.ndarray:
        left, right, top, bottom = self.slopes
        own = np.array([[x * z, y * z, z] for z in self.range_m for x in (left, right)
                        for y in (top, bottom)])
        return own @ self.frame[:3, :3].T + self.frame[:3, 3]

    @property
    def words(self) -> str:
        near, far = self.range_m
        return (f"the image of the camera at {position_text(self.frame[:3, 3])} m that looks along "
                f"{position_text(self.frame[:3, 2])}, {near:.3f} to {far:.3f} m ahead of it")

    def describe(self) -> dict:
        return {"camera_m": self.frame[:3, 3].tolist(), "axis": self.frame[:3, 2].tolist(),
                "range_m": list(self.range_m)}

    def hidden_by(self, triangles: np.ndarray, point: np.ndarray, slack: float) -> bool:
        """Whether triangles [f, 3, 3] are between camera and ``point``, to which surface within
        ``slack`` [m] belongs (Moeller and Trumbore 1997)."""
        eye = self.frame[:3, 3]
        ray = np.asarray(point, float) - eye
        first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        across = np.cross(ray, second)
        volume = np.einsum("ij,ij->i", first, across)
        # A triangle that the ray lies in hides nothing; rounding would give it a place anywhere.
        size = np.linalg.norm(first, axis=1) * np.linalg.norm(across, axis=1)
        safe = np.where(np.abs(volume) > 1e-9 * size + 1e-30, volume, np.inf)
        to_eye = eye - triangles[:, 0]
        u = np.einsum("ij,ij->i", to_eye, across) / safe
        turned = np.cross(to_eye, first)
        v = (turned @ ray) / safe
        t = np.einsum("ij,ij->i", second, turned) / safe
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        return bool((hit & (t < 1.0 - slack / np.linalg.norm(ray))).any())
