"""The shortest and the gentlest path on the energy field, then both on the full model.

The field is used for the search only. All reported energies, forces and strains are computed by
finite elements along the paths found; the error of the field is reported beside them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from dataclasses import field as fresh
from time import perf_counter
from typing import Any

import numpy as np

from limber.core.errors import Cancelled, Command, NoPathError, Option, Text
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.planning.baseline_and_plan import PathPair, plan_within, with_bound
from limber.planning.certificate.lower_bound import ENOUGH
from limber.planning.constraints.chance import Risk, YoungUncertainty
from limber.planning.constraints.limits import SURELY, Limits
from limber.planning.constraints.motion_check import (
    MotionCheck,
    as_samples,
    broken_on_full_model,
    check_motion,
    field_error,
    learnt,
    with_constraints,
)
from limber.planning.cost import STEP, arc_lengths, resample
from limber.planning.field.energy_field import UNITS, EnergyField, limited, refit
from limber.planning.field.grasp_model import GraspModel
from limber.planning.field.sampling import solve_branch
from limber.planning.field.stored_states import States
from limber.planning.goals.goal import CellPlace, Goal, GoalRequest, grasp_goal
from limber.planning.goals.goal_kinds import goal_of
from limber.planning.path_on_full_model import ResolvedPath, resolve_path
from limber.planning.path_problem import UNPROVEN, BlockedError, start_of
from limber.planning.plan_file import doubts_of, summary_of
from limber.planning.planners.least_violation import LeastViolation, easiest_path
from limber.planning.planners.rrt_star import SearchTree
from limber.planning.search_files import CostToGo
from limber.planning.settings import PlanSettings
from limber.planning.timing import DEFAULT_PACE, Pace

# Passages of a plan that the field leaves open or closes, looked at on the full model.

# Check of a proof that no path exists on the full model.
#
# The proof is about the field including its error, and that error was measured at other positions.
# So before the proof is passed on, the branch is solved where cells block the path: at those least
# over a limit, along the border of the region reached from the start, and, for a goal of a target,
# where that region comes nearest to it. If the full model keeps the limits or meets the goal there,
# or differs from the field by more than its error, the proof does not hold, and the states found
# become samples.

_STATES = 12  # solved states of the branch
_APART = 0.01  # [m] between them and from known samples
_LEARNT_APART = 0.5 * _APART


@dataclass(frozen=True)
class WallCheck:
    """Full-model result at ``solved`` states of a blocked path. They bear the proof out also if
    only the sampled region's border blocks; otherwise ``learnt`` has them as samples."""

    solved: int
    bears_out: bool
    learnt: States | None = None


def checked_wall(field: EnergyField, grasp_model: GraspModel, limits: Limits, none: BlockedError,
                 goal: Goal, *, workers: int | None = None, progress: Progress = SILENT,
                 ) -> WallCheck:
    """Solve the branch where ``none`` states that the path is blocked. A pose without a solution is
    closed as well: the branch cannot be there. Without any solution nothing is confirmed."""
    wall = _chosen(none.wall)
    points = np.concatenate([wall, _chosen(none.nearest)])
    if not len(points):
        return WallCheck(0, True)
    good, _ = solve_branch(grasp_model, points, workers=workers, progress=progress)
    if not good:
        return WallCheck(0, False)
    samples = States.joined(*(one.state for one in good))
    samples = replace(samples, added=limits.values(
        samples.positions, grasp_model.mesh.nodes + samples.displacements))
    is_wall = np.array([one.target < len(wall) for one in good])
    over, off = _over_and_off(field, limits, samples)
    meets = np.array([_meets(field, goal, one.state) for one in good])
    if not np.where(is_wall, ~over | off, ~over & meets).any():
        return WallCheck(len(good), True)
    away = np.linalg.norm(samples.positions[:, None] - field.samples.positions[None], axis=2)
    new = np.flatnonzero(away.min(axis=1) > _LEARNT_APART)
    return WallCheck(len(good), False, samples.take(new) if len(new) else None)


def _chosen(wall: np.ndarray) -> np.ndarray:
    """Return places [k, 3] of a wall [n, 3], its first one first, each apart from the others; half
    of them the earliest ones, half those far from all before."""
    chosen: list[np.ndarray] = []
    for cell in wall:
        if len(chosen) == _STATES // 2:
            break
        if all(np.linalg.norm(cell - other) > _APART for other in chosen):
            chosen.append(cell)
    while chosen and len(chosen) < _STATES:
        away = np.linalg.norm(wall[:, None] - np.array(chosen)[None], axis=2).min(axis=1)
        if away.max() <= _APART:
            break
        chosen.append(wall[int(away.argmax())])
    return np.reshape(chosen, (-1, 3))


def _meets(field: EnergyField, goal: Goal, state: States) -> bool:
    """Return whether a state is in the goal, or nearer to it than the field's error allows."""
    place, missed = state.positions, goal.missed_by(state)
    by_field = float(goal.excess(field, place)[0])
    return missed <= 0.0 or missed < by_field - float(goal.uncertainty(field, place)[0])


def _over_and_off(field: EnergyField, limits: Limits, samples: States,
                  ) -> tuple[np.ndarray, np.ndarray]:
    """Return which states break a limit, and which are farther below the field than its error, bool
    [n] each."""
    sizes, points = samples.sizes, samples.positions
    errors, asked = limits.errors(field), limits.asked()
    places = field.region.chart.plain.map(points)
    over, off = np.zeros(len(points), bool), np.zeros(len(points), bool)
    for one in limited(field, limits.on(field)):
        if one.name not in sizes:
            continue
        size = sizes[one.name]
        over |= size > asked[one.name]
        if one.name in errors:
            off |= one.size(points) - size > errors[one.name].at(places)
    return over, off


def confirmed(none: BlockedError, check: WallCheck) -> BlockedError:
    """Return the error, stating that the full model confirms it."""
    if not check.solved:
        return none
    return BlockedError(none.seen, f"{none.why} {check.solved} states of the full model, where the "
                      "way is closed, confirm it.", none.fix)


def not_confirmed(limits: Limits, easiest: LeastViolation | None) -> BlockedError:
    """Return the error of a proof that the full model does not confirm; ``easiest`` is the path
    that exceeds the limits least."""
    least = "" if easiest is None or easiest.worst <= 1.0 else (
        f" By the field the easiest way takes {100.0 * easiest.worst:.0f} % of a limit, within its "
        "error.")
    return BlockedError(f"No path to the goal with{limits.in_words() or ' known poses'} was found, "
                        f"{UNPROVEN}.", "The energy field, its error counted, leaves no path, but "
                        f"the full model does not confirm that where the way is closed.{least}",
                        "Relax the limits slightly, or sample more poses with ",
                        Command("energy", Option("samples")), ".")


# Poses sampled where the field's error leaves it undecided whether a path exists.


@dataclass(frozen=True)
class Passages:
    """The easiest path to the goal on the full model: the states ``learnt`` there, and in words
    ``summary`` what it takes."""

    learnt: States
    summary: str


def solved_if_undecided(field: EnergyField, grasp_model: GraspModel, start: np.ndarray, goal: Goal,
                        limits: Limits, progress: Progress = SILENT) -> Passages | None:
    """Solve the branch along the path that exceeds the limits least; None if the field's error
    leaves no doubt that it exceeds them, or nothing new can be learnt there."""
    path = easiest_path(field, limits.on(field), start, goal)
    asked, margins = limits.asked(), limits.margins(field)
    reserve = max((margins[name] / limit for name, limit in asked.items()), default=0.0)
    if path is None or path.worst > 1.0 + reserve:
        return None
    if path.worst > 1.0:  # the error there may be less
        open_way = easiest_path(field, limits.on(field, SURELY), start, goal)
        if open_way is None or open_way.worst > 1.0:
            return None
    approach = field.rest[None]
    if np.linalg.norm(start - field.rest) >= STEP:
        to_start = easiest_path(field, limits.on(field), field.rest.copy(),
                                grasp_goal(start, STEP))
        approach = approach if to_start is None else np.concatenate([to_start.points, start[None]])
    solved = resolve_path(grasp_model, resample(path.points, STEP), approach, progress)
    found = learnt(field, grasp_model, solved, limits)
    if not len(found.poses) and not len(found.rejected_poses):
        return None
    return Passages(found, _demand_text(solved, limits))


def _demand_text(solved: ResolvedPath, limits: Limits) -> str:
    if not solved.is_whole:
        return "the branch cannot follow the easiest path on the full model"
    values = solved.solved.sizes
    shares = {name: float(values[name].max()) / limit for name, limit in limits.asked().items()
              if name in values}
    if not shares:
        return "the easiest path was solved on the full model"
    name = max(shares, key=shares.__getitem__)
    peak = int(values[name].argmax())
    position = ", ".join(f"{x:.3f}" for x in solved.solved.poses[peak, :3])
    return (f"on the full model the easiest path needs a {name.replace('_', ' ')} of "
            f"{values[name][peak]:.3g} {UNITS[name]}".rstrip() + f", at ({position}) m")


def with_added_poses(none: BlockedError, count: int, summary: str) -> BlockedError:
    """Return the error, stating which poses were solved on the full model before."""
    times = "once" if count == 1 else f"{count} times"
    return BlockedError(none.seen, f"{none.why} The field's error made this uncertain, so poses "
                      f"were added {times}: {summary}.", none.fix)


FIELD_ERROR = 3.0
"""Largest error of the field's energy along a plan, compared with the full model [%] (RMS). If it
is larger, the states found join the field, and planning is repeated."""
_REPLANS = 3  # of the same plan at most: each takes as long as the first
_SLOWINGS = 4  # of the motion at most, until it keeps the limits
_LAST, _LAST_EVERY = 4, 2  # states at a path's end that become samples; every second one
_KNOWN = 0.1  # of the margin in the goal, where the states at a plan's end are samples
_RESERVE = 1.01  # factor on the tightening of limits: the risk changes a little with the path


@dataclass(frozen=True)
class PlannedMotion:
    """Both paths on the full model.

    Attributes:
        summary: The stage's result.
        baseline, plan: The shortest path (RRT*), and the gentle one.
        field: Field including the states learnt from refused plans.
        trees: Search trees of the planners that grow one, by their name.
        pace: How fast the motion may be.
        to_go: Lower bound on the cost of a path from any position; None if no bound was requested.
    """

    summary: dict[str, Any]
    baseline: ResolvedPath
    plan: ResolvedPath
    field: EnergyField
    trees: dict[str, SearchTree]
    pace: Pace = DEFAULT_PACE
    to_go: CostToGo | None = None


def plan_motion(field: EnergyField, grasp_model: GraspModel, settings: PlanSettings, *,
                limits: Limits | None = None, cell: Mapping[str, CellPlace] | None = None,
                uncertainty: YoungUncertainty | None = None, pace: Pace | None = None,
                workers: int | None = None, progress: Progress = SILENT) -> PlannedMotion:
    """Plan both paths on the field, and solve the branch along them.

    ``limits`` are the settings' if not given; they carry the limits of a robot's cell, and ``cell``
    what its camera sees or its second arm reaches. With ``doubt``, the limits are kept with the
    settings' confidence: the plan uses tighter ones.

    A plan that breaks a limit on the full model, or that the branch cannot follow, is not passed
    on: the states found there join the field's samples and the plan is repeated, at most
    :data:`_REPLANS` times. The same holds for a plan along which the field's error is too large
    for it to be the gentlest; the last of those is passed on with a warning. If no path keeps the
    limits on the field, and its error leaves that undecided, the states along the path that comes
    nearest join the samples likewise (:mod:`limber.planning.make_plan`). The same holds
    for a motion that breaks a limit by the branch's inertia at any pace tried.

    Cancelled (or by Ctrl-C) while the bound closes, it takes the best path so far, which is checked
    as any other; ``stopped`` in the summary records this.

    Raises:
        Cancelled: before there was a path, or the best so far breaks a limit.
        InputError: the start is not allowed, or two goals are given.
        NoPathError: there is no path, or none that keeps the limits on the full model; states why
        and where.
        ConvergenceError: the branch cannot be solved along the shortest path.
    """
    own = Limits.of(settings)
    goal = goal_of(GoalRequest(field, grasp_model, settings, own.on(field), cell or {}))
    field = goal.grown(field, grasp_model)
    start, limits = start_of(field, goal, settings), limits or own
    if limits.constraints:
        field = with_constraints(field, grasp_model, limits, workers, progress)
    aim = goal.with_margin(field, limits.on(field), start)
    rounds = _Rounds(grasp_model, settings, limits, goal, start, uncertainty, workers, field, aim,
                     limits, pace or Pace(settings.speed), progress)
    count = _REPLANS + 1
    for number in range(count):
        ahead = rounds.progress.part(number / count, (number + 1) / count)
        if rounds.plan_once(ahead, is_last=number == _REPLANS):
            break
    return rounds.found()


@dataclass
class _Rounds:
    """Rounds of planning on the field, checking on the full model, and learning. ``aim`` and
    ``planned_limits`` are tightened by what earlier plans missed; ``baseline`` is that of
    ``baseline_points``; ``holding`` is passed on if a less deep plan does not hold."""

    grasp_model: GraspModel
    settings: PlanSettings
    limits: Limits
    goal: Goal
    start: np.ndarray
    uncertainty: YoungUncertainty | None
    workers: int | None
    field: EnergyField
    aim: Goal
    planned_limits: Limits
    pace: Pace
    progress: Progress
    pair: PathPair | None = None
    plan: ResolvedPath | None = None
    baseline: ResolvedPath | None = None
    baseline_points: np.ndarray | None = None
    risks: list[Risk] = fresh(default_factory=list)
    passages: list[Passages] = fresh(default_factory=list)
    moving: MotionCheck | None = None
    round_records: list[dict[str, Any]] = fresh(default_factory=list)
    holding: dict[str, Any] | None = None

    def plan_once(self, ahead: Progress, is_last: bool) -> bool:
        """Plan and check; return whether the plan may be passed on. If not, samples were added."""
        if self.holding is None:
            return self._tried(ahead, is_last)
        pair = self.holding["pair"]
        try:
            return self._tried(ahead, is_last=True)
        except (NoPathError, Cancelled, KeyboardInterrupt) as end:
            if not isinstance(end, NoPathError):
                ahead, self.progress = ahead.to_the_end(), self.progress.to_the_end()
                pair = replace(pair, unbounded=None,
                               certificate=replace(pair.certificate, stopped=True))
        vars(self).update(self.holding)
        self._completed(pair, ahead.part(0.95, 1.0))
        return True

    def _tried(self, ahead: Progress, is_last: bool) -> bool:
        began = perf_counter()
        pair = self._planned(ahead, is_last)
        if pair is None:
            return False
        planned, self.pair = perf_counter(), pair
        stopped = pair.certificate.stopped
        if stopped:  # the best path so far is checked too: otherwise it could not be kept
            ahead, self.progress = ahead.to_the_end(), self.progress.to_the_end()
        plan = self.plan = self._solved(pair, ahead)
        is_last = is_last or stopped
        off = field_error(self.field, plan.solved)
        is_near = is_last or pair.stays or off <= FIELD_ERROR / 100.0
        broken = self._broken(plan, is_near, ahead)
        self.round_records.append({
            "broken": broken, "sample_count": len(self.field.samples.poses),
            "margins": pair.margins, "field_energy_error": off,
            "plan_seconds": planned - began, "check_seconds": perf_counter() - planned})
        if not broken and is_near:
            if not is_last and self._is_too_deep(pair, plan):
                return False
            self._completed(pair, ahead.part(0.95, 1.0))
            return True
        if stopped:
            raise Cancelled("The search was stopped.",
                            "The best path found so far is not allowed: "
                            f"{'; '.join(broken)}.", "Run it again and let it finish.")
        if is_last:
            raise _refused(broken)
        self.field = refit(self.field, learnt(self.field, self.grasp_model, plan, self.limits))
        return False

    def _is_too_deep(self, pair: PathPair, plan: ResolvedPath) -> bool:
        """Whether the field's error decides how deep in the goal the plan ends. If so, its last
        states become samples, and it is kept for the case that no better one holds."""
        end = pair.plan.points[-1:]
        if pair.stays or (
                self.aim.margin_at(self.field, end) < ENOUGH * arc_lengths(pair.plan.points)[-1]):
            return False
        self.holding = {"pair": pair, "plan": plan, "moving": self.moving, "risks": self.risks[:]}
        states = plan.solved.take(np.arange(len(plan.solved.poses))[::-_LAST_EVERY][:_LAST])
        self.field = refit(self.field, as_samples(self.grasp_model, states, self.limits))
        self.aim = replace(self.aim, margin=_KNOWN * self.aim.margin)
        return True

    def _planned(self, ahead: Progress, is_last: bool) -> PathPair | None:
        """Return paths on the field; None if poses were added instead. BlockedError if none was
        found, or none exists and the full model confirms it."""
        try:
            pair = self._within_goal(ahead.part(0.0, 0.3))
        except BlockedError as none:
            found = None if is_last else solved_if_undecided(
                self.field, self.grasp_model, self.start, self.aim, self.planned_limits,
                ahead.part(0.3, 1.0))
            if found is None:
                self._closed(none, is_last, ahead.part(0.3, 1.0))
                return None
            self.passages.append(found)
            self.progress.warn(
                f"{none.seen} The energy field's error makes this uncertain, so poses are added: "
                f"{found.summary}.")
            self.field = refit(self.field, found.learnt)
            return None
        if pair.in_doubt is not None and pair.repeats(self.pair):
            raise pair.in_doubt
        return pair

    def _within_goal(self, ahead: Progress) -> PathPair:
        """Return paths on the field that end as deep in the goal as the field's error and earlier
        plans ask for; if none is found, less deep ones. NoPathError if none ends in it."""
        # Probably the first plan to a region ends too deep in it, and a later one is refused.
        is_bounded = self.holding is not None or (self.pair is None and not self.aim.margin)

        try:
            return plan_within(self.field, self.start, self.aim, self.settings,
                               self.planned_limits, asked=self.limits, asked_goal=self.goal,
                               before=self.pair, is_bounded=is_bounded,
                               progress=ahead.part(0.0, 0.5))
        except NoPathError as none:
            aim, proven = self.aim, isinstance(none, BlockedError) and none.is_proven
            if proven or not (aim.margin or aim.inset):
                raise
            if aim.margin:
                self.progress.warn(
                    f"No path was found that ends deeper in the goal than the energy field's error "
                    f"of {aim.what}'s position. The path is planned without this margin. The full "
                    "model decides whether its end is in the goal.")
            # Less what an earlier plan missed it by, the goal may be too small; that plan's states
            # are samples by now.
            self.aim = replace(aim, margin=0.0, inset=aim.inset if aim.margin else 0.0)
            return self._within_goal(ahead.part(0.5, 1.0))

    def _closed(self, none: BlockedError, is_last: bool, ahead: Progress) -> None:
        """Pass on that there is no path, or learn evidence against it. BlockedError if no evidence
        against it was found, or no round is left."""
        if none.is_proven:
            ahead(0.0, "checking on the full model where the way is closed")
            check = checked_wall(self.field, self.grasp_model, self.limits, none, self.goal,
                                 workers=self.workers, progress=ahead)
            if check.learnt is not None and not is_last:
                self.progress.warn(
                    "No path exists by the energy field, but the full model differs from it where "
                    f"the way is closed: {len(check.learnt.poses)} poses are added.")
                self.field = refit(self.field, check.learnt)
                return
            none = confirmed(none, check) if check.bears_out else not_confirmed(
                self.limits, easiest_path(self.field, self.limits.on(self.field), self.start,
                                          self.goal))
        if self.passages:
            none = with_added_poses(none, len(self.passages), self.passages[-1].summary)
        raise none

    def _solved(self, pair: PathPair, ahead: Progress) -> ResolvedPath:
        """Return the plan on the full model, and keep the baseline there unless the plan is
        probably refused."""
        ahead(0.3, "both paths on the full model")
        if pair.unbounded is None:
            self._with_baseline(pair, ahead.part(0.6, 0.95))
        return self._on_full_model(pair.plan.points, pair, ahead.part(0.3, 0.6))

    def _with_baseline(self, pair: PathPair, ahead: Progress) -> None:
        # The shortest path rarely changes with new samples: it is solved once.
        points = pair.baseline.points
        if self.baseline_points is None or not np.array_equal(self.baseline_points, points):
            self.baseline = self._on_full_model(points, pair, ahead)
            self.baseline_points = points

    def _on_full_model(self, points: np.ndarray, pair: PathPair, ahead: Progress) -> ResolvedPath:
        # A refined path has points closer together, so that its chords follow the shell. Another
        # process would take longer to begin than to solve it.
        return resolve_path(self.grasp_model, resample(points, STEP), pair.approach, ahead)

    def _completed(self, pair: PathPair, ahead: Progress) -> None:
        """Add to a plan that holds what it lacks: a close bound, the baseline on the full model."""
        self.pair = with_bound(pair, ahead)
        self._with_baseline(pair, ahead)

    def _broken(self, plan: ResolvedPath, is_near: bool, ahead: Progress) -> list[str]:
        """Return the limits that a plan breaks, at standstill, with other moduli, or in motion; the
        next one is planned with limits tightened accordingly."""
        broken = broken_on_full_model(plan, self.limits, self.goal, self.grasp_model.mesh.nodes)
        if plan.is_whole:
            self.aim = self.aim.drawn_in(plan.solved)
            broken += self._unfit_end(plan)
        if self.uncertainty is not None and not broken:
            risk = self.uncertainty.risk(
                self.grasp_model, plan, self.limits, present(self.settings.confidence, "confidence")
            )
            self.risks.append(risk)
            broken = risk.exceeded_limits()
            self._tighten(risk.excess)
        if self.settings.effort.inertia and not broken and is_near and self.limits.asked():
            limits = self.risks[-1].left(self.limits, plan) if self.risks else self.limits
            self.moving = check_motion(
                self.grasp_model, plan, limits, self.pace, slowings=_SLOWINGS,
                workers=self.workers, progress=ahead.part(0.95, 1.0))
            broken = self.moving.broken
            self._tighten(self.moving.excess)
        return broken

    def _unfit_end(self, plan: ResolvedPath) -> list[str]:
        """Return why the plan's end is not valid, if so: the next one ends elsewhere."""
        try:
            self.goal.require_end(self.grasp_model, plan.solved)
        except NoPathError as error:
            return [error.seen.rstrip(".")]
        return []

    def _tighten(self, excess: dict[str, float]) -> None:
        self.planned_limits = self.planned_limits.tightened(
            {name: _RESERVE * share for name, share in excess.items() if share > 1.0})

    def found(self) -> PlannedMotion:
        """Return the last plan with all its results, and warn of what is uncertain."""
        pair, plan = present(self.pair, "paths on the field"), present(self.plan, "plan")
        baseline = present(self.baseline, "shortest path").require()
        self.goal.require_end(self.grasp_model, plan.solved)
        summary = summary_of(self.field, self.goal, self.start, pair, baseline, plan,
                             self.settings)
        summary |= {"rounds": self.round_records, "stopped": pair.certificate.stopped,
                    **self.goal.describe_end(plan.solved)}
        if self.risks:
            summary["confidence"] = {
                "asked": self.settings.confidence, "kept_at_least": self.risks[-1].kept,
                "factors": self.risks[-1].factors,
                "of_a_plan_for_the_estimate": self.risks[0].kept}
        if self.moving is not None:
            self.pace = self.moving.pace
            summary["in_motion"] = self.moving.describe()
            if self.moving.slowings:
                self.progress.warn(
                    f"The motion was slowed down to {1e3 * self.pace.speed:.1f} mm/s. At a higher "
                    "speed the branch's inertia breaks a limit.")
        for message in doubts_of(summary, FIELD_ERROR, baseline, plan):
            self.progress.warn(message)
        trees = {name: path.tree for name, path in pair.trees.items() if path.tree is not None}
        return PlannedMotion(summary, baseline, plan, self.field, trees, self.pace,
                             pair.certificate.to_go)


def _refused(broken: list[str]) -> NoPathError:
    return NoPathError(
        Text("No plan keeps the limits on the full model: ", Text.joined("; ", broken), "."), "The "
        f"path was planned {_REPLANS + 1} times. After each plan, the states found on the full "
        "model were added to the energy field.", "Raise the limit, choose a gentler goal, or "
        "sample more poses with ", Command("energy", Option("samples")), ".")
