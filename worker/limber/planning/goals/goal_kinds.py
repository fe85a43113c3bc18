"""The kinds of goals, and the one requested by a plan's settings."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from limber.core.errors import Command, InputError, NoPathError, Option, Text
from limber.planning.field.energy_field import EnergyField, FieldArrays
from limber.planning.field.grasp_model import GraspModel
from limber.planning.field.sampling import solve_branch
from limber.planning.field.stored_states import States
from limber.planning.field.valid_region import nearest_of
from limber.planning.goals.goal import (
    TIP,
    CellPlace,
    Goal,
    GoalKind,
    GoalRequest,
    Point,
    allowed_points,
    grasp_goal,
)
from limber.planning.goals.region import Ball, BoxRegion, ball, empty_along
from limber.planning.settings import PlanSettings

# A point of the branch where a user asks for it: ``--goal``, ``--tip-goal``, ``--target-box``.


def target_of(asked: GoalRequest) -> Point:
    """Return the requested target, or the tip. InputError if the branch has no target of that
    name."""
    name = asked.settings.target
    names = [target.name for target in asked.grasp_model.branch.targets]
    if name is None:
        return TIP
    if name not in names:
        raise InputError(f"The branch has no target named {name}.",
                         f"Its targets are: {', '.join(names) or 'none'}.",
                         "Define one with ", Command("target"), ".")
    return Point(name, names.index(name))


def _in_ball(asked: GoalRequest, centre: tuple[float, float, float]) -> Goal:
    return Goal(target_of(asked), Ball(centre, asked.settings.goal_tolerance))


def _in_box(asked: GoalRequest, corners: tuple[float, ...]) -> Goal:
    x, y, z, *far = corners
    low, high = (x, y, z), (far[0], far[1], far[2])
    if not np.all(np.less(low, high)):
        raise InputError(f"The target's box is empty {empty_along(low, high)}.",
                         "Its lower corner must be below the upper one in x, y and z.",
                         "Correct ", Option("target_box"), ".")
    return Goal(target_of(asked), BoxRegion(low, high), advice=Text(
        "Choose a larger ", Option("target_box"), ", or one nearer to this region"))


AT_PLACE = GoalKind(
    "goal", lambda asked, place: grasp_goal(place, asked.settings.goal_tolerance), is_place=True)
IN_BALL = GoalKind("tip_goal", _in_ball, is_of_target=True, is_place=True)
IN_BOX = GoalKind("target_box", _in_box, is_of_target=True)


# A chosen goal: a pose drawn from the paper's hemisphere (``--goal-seed``), a distant one, or the
# reach of a second arm.

_REACH = 0.85  # [m] of a UR5, which stands for the second arm
_HALF = 0.5  # of the grasp's way to the default goal
_TIP_TOLERANCE = 0.02  # [m] about a flower's radius
_BEGINS = 0.6  # fraction of the tip's way to the default goal at which that reach begins


def default_goal(field: EnergyField, tolerance: float) -> Goal:
    """Return a goal far from rest that needs no force: the sample of least energy among those over
    three quarters of the largest deflection, moved a little towards rest. Trust is a shell often
    thinner than the tolerance: what counts is the part of the goal along it. The tolerance [m] is
    at most a quarter of that deflection, so that a seedling's goal does not contain its start."""
    chart = field.region.chart.plain
    samples = chart.map(field.samples.positions)
    rest = chart.map(field.rest)[0]
    away = np.linalg.norm(field.samples.positions - field.rest, axis=1)
    far, tolerance = np.flatnonzero(away >= 0.75 * away.max()), min(tolerance, away.max() / 4)
    around = ball(100, np.random.default_rng(0)) * tolerance
    if chart.radius > 0.0:
        around[:, 2] = 0.0
    for index in far[np.argsort(field.samples.energies[far])]:
        for shrink in (1.0, 0.95, 0.9, 0.85):
            centre = rest + shrink * (samples[index] - rest)
            position = chart.curved(centre[None])[0]
            if (field.region.contains(chart.curved(centre + around)).mean() > 0.5
                    and field.region.contains(position)[0]):
                return grasp_goal(position, tolerance)
    raise NoPathError("No distant pose lies well inside the sampled region.",
                      f"Too few of the {len(away)} accepted samples are far from the rest pose.",
                      "Sample more poses with ", Command("energy", Option("samples")), ", or give "
                      "a ", Option("goal"), ".")


def second_arm_goal(field: EnergyField) -> Goal:
    """The paper's goal: the tip with its flower in a second arm's reach, a ball on the side to
    which the branch bends with least energy. NoPathError if there is no far pose."""
    far = default_goal(field, 0.01).centre(field)
    rest, there = field.tip(np.stack([field.rest, far]))
    way = there - rest
    x, y, z = map(float, rest + (_BEGINS + _REACH / np.linalg.norm(way)) * way)
    return Goal(TIP, Ball((x, y, z), _REACH))


def tip_goal(field: EnergyField) -> Goal:
    """A goal as a person states one: a small ball some centimetres from the tip, which is there
    with the grasp half-way to the default goal. NoPathError if there is no far pose."""
    chart = field.region.chart.plain
    rest, far = chart.map(np.stack([field.rest, default_goal(field, 0.01).centre(field)]))
    x, y, z = map(float, field.tip(chart.curved((rest + _HALF * (far - rest))[None]))[0])
    return Goal(TIP, Ball((x, y, z), _TIP_TOLERANCE))


def hemisphere_goal(field: EnergyField, base: np.ndarray, length: float, limits: FieldArrays,
                    tolerance: float, seed: int) -> Goal:
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
    return grasp_goal(points[np.flatnonzero(fit)[0]], min(tolerance, half / 2))


def _drawn(asked: GoalRequest, seed: int) -> Goal:
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
class CellGoal(Goal):
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

    def excess(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        within = super().excess(field, points)
        if not len(self.refused) or not len(self.taken):
            return within
        points = np.ascontiguousarray(points, float).reshape(-1, 3)
        nearer = (self.caution * nearest_of(points, self.taken)[0]
                  - nearest_of(points, self.refused)[0])
        return np.maximum(within, nearer / (1.0 + self.caution))

    def uncertainty(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        # Between invalid poses there may be a valid one: then nothing is proven.
        if len(self.refused):
            return np.full(len(points), np.inf)
        return super().uncertainty(field, points)

    def drawn_in(self, states: States) -> Self:
        found = super().drawn_in(states)._told(states.positions, self._causes(states))
        if not len(found.taken) or not found._causes(states.take(np.array([-1])))[0]:
            return found
        # What the field takes for valid may not be: the branch model says what is.
        chosen = found.taken[_far_apart(found.taken, _SOLVED)]
        known = replace(found, taken=_NOWHERE)._told(chosen, self._by_model(chosen))
        return replace(known if len(known.taken) else found, caution=found.caution * _WARIER)

    def require_end(self, grasp_model: GraspModel, states: States) -> None:
        self.cell_place.require(self.what, self.point.in_states(states)[-1],
                                self._surface(states.displacements[-1]))

    def learnt(self, field: EnergyField) -> Self:
        """Return the goal with the results at poses of the field, for a view those of the branch
        model, and between them. NoPathError if the target is in the region at some of them, and
        valid at none."""
        tell, pairs, halvings = self._by_model, _SOLVED_PAIRS, _SOLVED_HALVINGS
        if self.cell_place.of_surface:
            points = field.samples.positions[
                self.region.distance(self.point.in_states(field.samples)) <= 0.0]
            points = points[_far_apart(points, _SOLVED)] if len(points) else points
        else:
            def tell(grasps: np.ndarray) -> list[str | None]:
                return [self._cause(one, None) for one in self.point.at(field, grasps)]
            pairs, halvings = _PAIRS, _PAIR_HALVINGS
            points = np.concatenate([field.rest[None], field.region.draw(
                _PLACES_DRAWN, np.random.default_rng(0))])
            points = points[Goal.excess(self, field, points) <= 0.0][:_ASKED]
        found = self._told(points, tell(points)) if len(points) else self
        if len(found.refused) and not len(found.taken):
            raise found.refusal()
        return found._sharpened(tell, pairs, halvings) if len(found.refused) else found

    def _sharpened(self, tell: Callable[[np.ndarray], list[str | None]], pairs: int, halvings: int,
                   ) -> Self:
        """Return the goal with poses near its border, between invalid ones and the nearest valid
        ones, as ``tell`` has it of poses [n, 3]."""
        chosen = _far_apart(self.refused, pairs)
        wrong, causes = self.refused[chosen], [self.causes[k] for k in chosen]
        distance = np.linalg.norm(wrong[:, None] - self.taken[None], axis=2)
        right = self.taken[distance.argmin(axis=1)]
        for _ in range(halvings):
            middle = 0.5 * (wrong + right)
            found = tell(middle)
            does = np.array([cause == "" for cause in found])[:, None]
            wrong, right = np.where(does, wrong, middle), np.where(does, middle, right)
            causes = [new or old for new, old in zip(found, causes, strict=True)]
        return self._told(np.concatenate([right, wrong]), [""] * len(right) + causes)

    def _told(self, grasps: np.ndarray, causes: Sequence[str | None]) -> Self:
        """Return the goal with poses [n, 3] added, and why each is not valid: empty if it is, None
        if the branch does not come into the region there, which tells nothing."""
        does = np.array([cause == "" for cause in causes], bool)
        not_so = np.array([bool(cause) for cause in causes], bool)
        return replace(self, taken=np.concatenate([self.taken, grasps[does]]),
                       refused=np.concatenate([self.refused, grasps[not_so]]),
                       causes=(*self.causes, *filter(None, causes)))

    def _by_model(self, grasps: np.ndarray) -> list[str | None]:
        """Return what :meth:`_causes` says of the branch model at ``grasps`` [n, 3]; None where it
        has no equilibrium."""
        causes: list[str | None] = [None] * len(grasps)
        for one in solve_branch(self.grasp_model, grasps, workers=1)[0]:
            causes[one.target] = self._causes(one.state)[0]
        return causes

    def _causes(self, states: States) -> list[str | None]:
        """Return why each state is not valid; see :meth:`_told`."""
        return [self._cause(*one) for one in zip(self.point.in_states(states),
                                                 states.displacements, strict=True)]

    def _cause(self, position: np.ndarray, moved: np.ndarray | None) -> str | None:
        if self.region.distance(position[None])[0] > 0.0:
            return None
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
    return CellGoal(target_of(asked), place.region, advice=place.advice, cell_place=place,
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
