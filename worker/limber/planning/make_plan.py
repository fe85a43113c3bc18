"""The shortest and the gentlest path on the energy field, then both on the full model.

The field serves to search. Every energy, force and strain that is reported comes from the finite
elements along the found paths; how far the field was off is reported beside them.
"""

from dataclasses import asdict, dataclass
from time import perf_counter
from typing import Any

import numpy as np

from limber.core.errors import Cancelled, InputError, NoPathError
from limber.core.progress import SILENT, Progress
from limber.planning.constraints.chance import YoungDoubt
from limber.planning.constraints.full_model_check import broken_on_full_model, field_error, learnt
from limber.planning.constraints.limits import Limits
from limber.planning.constraints.motion_check import check_motion
from limber.planning.cost import STEP, PathMeasures, measure_path, resample
from limber.planning.field.energy_field import EnergyField, among_obstacles, refit
from limber.planning.field.grasp_model import GraspModel
from limber.planning.field.sampling import displacements_at
from limber.planning.goals.goal import Goal, GraspGoal, TargetGoal, default_goal, hemisphere_goal
from limber.planning.goals.regions import Ball, BoxRegion, Region, View
from limber.planning.path_on_full_model import ResolvedPath, resolve_side_by_side
from limber.planning.planners.tree_search import SearchTree
from limber.planning.problem import NoWayError
from limber.planning.search_files import CostToGo
from limber.planning.timing import DEFAULT_PACE, Pace
from limber.planning.two_paths import (
    PathPair,
    PlanSettings,
    chosen_engine,
    limits_of,
    plan_within,
    random_start,
)
from limber.planning.undecided_passages import Narrows, asked_in_doubt, said_after

_RESERVE = 1.01  # on what limits are tightened by: the risk changes a little with the path
_OWN = 0.003  # [m] of the surface about a target that does not hide it
_CHANGES = ("energy_saved_percent", "peak_energy_saved_percent", "length_added_percent")
_STILL = 1e-9  # [m] a path that is no longer has no length
_WIDE_GAP = 5.0  # percent, above which a warning says so
_LONGER = 1.05  # a smoothed gentle path may be a little shorter than an unsmoothed RRT* path


@dataclass(frozen=True)
class PlannedMotion:
    """Both paths on the full model.

    Attributes:
        summary: The stage's result.
        baseline, plan: The shortest path (RRT*), and the gentle one.
        field: With what was learnt from plans that were refused.
        trees: What the planners with a tree searched, by their name.
        pace: How fast the motion may be.
        to_go: What a path from anywhere costs at least; None where no bound was asked for.
    """

    summary: dict[str, Any]
    baseline: ResolvedPath
    plan: ResolvedPath
    field: EnergyField
    trees: dict[str, SearchTree]
    pace: Pace = DEFAULT_PACE
    to_go: CostToGo | None = None


def plan_motion(field: EnergyField, grasp_model: GraspModel, settings: PlanSettings, *,
                limits: Limits | None = None, region: Region | None = None,
                doubt: YoungDoubt | None = None, pace: Pace | None = None,
                workers: int | None = None, progress: Progress = SILENT) -> PlannedMotion:
    """Plan both paths on the field, and solve the branch along them.

    ``limits`` are the settings' where not given; those of a robot's cell come in this way, and
    what its camera sees or its second arm reaches as ``region``. With ``doubt`` the limits are kept
    with the settings' confidence: planned is with tighter ones.

    A plan that breaks a limit on the full model, or that the branch cannot follow, is not passed
    on: the states found there join the field's samples and it is planned anew, at most
    ``settings.replans`` times. So is one along which the field is too far off to have been the
    gentlest; the last of those is passed on with a warning. Where no path keeps the limits on the
    field, and its error leaves that in doubt, the states along the way that comes nearest join the
    samples likewise (:mod:`limber.planning.undecided_passages`). And so is a motion that breaks a
    limit by the branch's inertia, however slow it was tried.

    Cancelled (or by Ctrl-C) while the bound closes, it takes the best path so far, which is checked
    as any other; ``stopped`` in the summary says so.

    Raises:
        Cancelled: before there was a path, or the best so far breaks a limit.
        InputError: the start is not allowed, or two goals are given.
        NoPathError: no path, or none that keeps the limits on the full model; says why and where.
        ConvergenceError: the branch cannot be solved along the shortest path.
    """
    goal = _goal(field, grasp_model, settings, region)
    start = _start(field, goal, settings)
    limits = limits or Limits.of(settings)
    if limits.obstacles:
        field = _among(field, grasp_model, limits, workers, progress)
    pace = pace or Pace(settings.speed, settings.acceleration)
    rounds: list[dict[str, Any]] = []
    pair = baseline = moving = None
    planned_limits, aim, risks = limits, goal, []
    narrows: list[Narrows] = []
    for number in range(settings.replans + 1):
        ahead = progress.part(number / (settings.replans + 1), (number + 1) / (
            settings.replans + 1))
        began = perf_counter()
        is_last = number == settings.replans
        try:
            before, pair = pair, plan_within(
                field, start, aim, settings, planned_limits, asked=limits, before=pair,
                progress=ahead.part(0.0, 0.3))
        except NoWayError as none:
            doubt_there = None if is_last else asked_in_doubt(
                field, grasp_model, start, aim, planned_limits, ahead.part(0.3, 1.0))
            if doubt_there is None:
                raise (said_after(none, len(narrows), narrows[-1].told) if narrows
                       else none) from none
            narrows.append(doubt_there)
            progress.warn(f"{none.seen} Poses are added where the energy field's error leaves that "
                          f"in doubt: {doubt_there.told}.")
            field = refit(field, doubt_there.learnt)
            continue
        planned = perf_counter()
        stopped = pair.certificate.stopped
        if stopped:  # the best so far is checked all the same: else it could not be kept
            ahead, progress = ahead.to_the_end(), progress.to_the_end()
        ahead(0.3, "both paths on the full model")
        # The shortest path rarely changes with what was learnt: it is solved once.
        same = before is not None and np.array_equal(before.baseline.points, pair.baseline.points)
        paths = [pair.plan.points] + [pair.baseline.points] * (not same)
        # A refined path has points closer together, so that its chords follow the shell.
        plan, *other = resolve_side_by_side(
            grasp_model, [resample(points, STEP) for points in paths], pair.approach, workers,
            ahead.part(0.3, 0.95))
        baseline = other[0] if other else baseline
        broken = broken_on_full_model(plan, limits, goal, grasp_model.mesh.nodes)
        if isinstance(aim, TargetGoal) and plan.is_whole:
            aim = aim.drawn_in(plan.solved)
        if doubt is not None and not broken:
            risks.append(doubt.risk(grasp_model, plan, limits, settings.confidence))
            broken = risks[-1].told()
            planned_limits = planned_limits.tightened(
                {name: _RESERVE * share for name, share in risks[-1].excess.items() if share > 1.0})
        off = field_error(field, plan.solved)
        is_last = is_last or stopped
        is_near = is_last or pair.stays or off <= settings.field_error / 100.0
        if settings.inertia and not broken and is_near and limits.asked():
            moving = check_motion(
                grasp_model, plan, limits if not risks else risks[-1].left(limits, plan), pace,
                slowings=settings.slowings, workers=workers, progress=ahead.part(0.95, 1.0))
            broken = moving.broken
            planned_limits = planned_limits.tightened(
                {name: _RESERVE * share for name, share in moving.excess.items() if share > 1.0})
        rounds.append({"broken": broken, "sample_count": len(field.samples.poses),
                       "margins": pair.margins, "field_energy_error": off,
                       "plan_seconds": planned - began, "check_seconds": perf_counter() - planned})
        if not broken and is_near:
            break
        if stopped:
            raise Cancelled("The search was stopped.", f"The best path so far is none: "
                            f"{'; '.join(broken)}.", "Run it again when there is time for it.")
        if is_last:
            raise _refused(broken, settings)
        field = refit(field, learnt(field, grasp_model, plan, limits))
    _require_sight(goal, grasp_model, plan)
    summary = _summary(field, goal, start, pair, baseline.require(), plan, settings)
    summary["rounds"] = rounds
    summary["stopped"] = stopped
    if isinstance(goal, TargetGoal):
        summary["target_end_m"] = goal.place(plan.solved)
    if risks:
        summary["confidence"] = {"asked": settings.confidence, "kept_at_least": risks[-1].kept,
                                 "factors": risks[-1].factors,
                                 "of_a_plan_for_the_estimate": risks[0].kept}
    if moving is not None:
        summary["in_motion"] = moving.describe()
        if moving.slowings:
            progress.warn(f"The motion was slowed down to {1e3 * moving.pace.speed:.1f} mm/s: "
                          "faster, the branch's inertia breaks a limit.")
    for message in _doubts(summary, settings.field_error, baseline, plan):
        progress.warn(message)
    return PlannedMotion(summary, baseline, plan, field, {
        name: path.tree for name, path in pair.trees.items()},
        moving.pace if moving is not None else pace, pair.certificate.to_go)


def _among(field: EnergyField, grasp_model: GraspModel, limits: Limits, workers: int | None,
           progress: Progress) -> EnergyField:
    """Return the field that knows how close the branch is to obstacles.

    Raises:
        NoPathError: it meets one where it hangs.
    """
    nodes = grasp_model.mesh.nodes
    at_rest = limits.closeness_of(nodes, grasp_model.rest.displacement[None])[0]
    if at_rest > 1.0:
        raise NoPathError("The branch meets an obstacle where it hangs.",
                          "No path begins there.", "Correct the obstacles in the cell file.")
    displacements = displacements_at(grasp_model, field.samples.positions, workers=workers,
                                     progress=progress.part(0.0, 0.1))
    return among_obstacles(field, limits.closeness_of(nodes, displacements))


def _refused(broken: list[str], settings: PlanSettings) -> NoPathError:
    return NoPathError(
        f"No plan keeps the limits on the full model: {'; '.join(broken)}.",
        f"Planned {settings.replans + 1} times, each time with the states found there added to the "
        "energy field.",
        "Raise the limit, choose a gentler goal, sample more poses with `limber energy --samples`, "
        "or allow more --replans.")


def _goal(field: EnergyField, grasp_model: GraspModel, settings: PlanSettings,
          cells: Region | None) -> Goal:
    given = {"--goal": settings.goal, "--tip-goal": settings.tip_goal,
             "--target-box": settings.target_box, "--in-view": settings.in_view or None,
             "--second-arm": settings.second_arm or None, "--goal-seed": settings.goal_seed}
    asked = [name for name, value in given.items() if value is not None]
    if len(asked) > 1:
        raise InputError(f"{' and '.join(asked)} are given.", "A path ends in one goal.",
                         "Give one of them.")
    if settings.target is not None and asked in ([], ["--goal"], ["--goal-seed"]):
        raise InputError(f"--target {settings.target} is given without a place for it.",
                         "A target alone says not where it shall be.",
                         "Give --tip-goal, --target-box, --in-view or --second-arm as well.")
    if settings.goal is not None:
        return GraspGoal(settings.goal, settings.goal_tolerance)
    if settings.goal_seed is not None:
        reach = grasp_model.reach
        return hemisphere_goal(field, reach.base, reach.arc_length, limits_of(field, settings),
                               settings.goal_tolerance, settings.goal_seed)
    if not asked:
        return default_goal(field, settings.goal_tolerance)
    if settings.tip_goal is not None:
        region: Region = Ball(settings.tip_goal, settings.goal_tolerance)
    elif settings.target_box is not None:
        low, high = settings.target_box[:3], settings.target_box[3:]
        if not np.all(np.less(low, high)):
            raise InputError(f"The box from {low} to {high} m is empty.",
                             "Its lower corner must be below the upper one in x, y and z.",
                             "Correct --target-box.")
        region = BoxRegion(low, high)
    elif cells is None:
        what = "[camera] that stands still" if settings.in_view else "[second_arm]"
        raise InputError(f"{asked[0]} is given, but no cell with a {what}.",
                         "The cell file says where it stands.", "Give --cell with one.")
    else:
        region = cells
    return TargetGoal(region, *_target(grasp_model, settings.target))


def _target(grasp_model: GraspModel, name: str | None) -> tuple[int | None, str]:
    names = [target.name for target in grasp_model.branch.targets]
    if name is None:
        return None, "tip"
    if name not in names:
        raise InputError(f"The branch has no target {name}.",
                         f"It has: {', '.join(names) or 'none'}.",
                         "Name one with `limber target`.")
    return names.index(name), name


def _require_sight(goal: Goal, grasp_model: GraspModel, plan: ResolvedPath) -> None:
    """Raise NoPathError where the branch itself hides the target from the camera at the end."""
    if not (isinstance(goal, TargetGoal) and isinstance(goal.region, View)):
        return
    nodes = grasp_model.mesh.nodes + plan.solved.displacements[-1]
    if goal.region.hidden_by(nodes[grasp_model.mesh.surface_faces()], goal.place(plan.solved),
                             _OWN):
        raise NoPathError(f"At the path's end the branch hides the {goal.name} from the camera.",
                          "Limber checks the line of sight at a path's end, but cannot plan for "
                          "it yet.",
                          "Choose a --target-box on the camera's side, or move the camera.")


def _start(field: EnergyField, goal: Goal, settings: PlanSettings) -> np.ndarray:
    if settings.start is not None and settings.start_seed is not None:
        raise InputError("Both --start and --start-seed are given.",
                         "A path starts in one place.", "Give one of them.")
    if settings.start is not None:
        return np.array(settings.start, float)
    if settings.start_seed is not None:
        return random_start(field, goal, settings, settings.start_seed)
    return field.rest.copy()


def _summary(field: EnergyField, goal: Goal, start: np.ndarray, pair: PathPair,
             baseline: ResolvedPath, plan: ResolvedPath, settings: PlanSettings,
             ) -> dict[str, Any]:
    before, after = baseline.measures, plan.measures
    return {
        "goal": goal.describe() | {"chosen": _is_chosen(settings)},
        "start_m": start, "seed": settings.seed, "planner": settings.planner,
        "engine": chosen_engine(settings.engine),
        "certificate": pair.certificate.describe() | {"full_model": _on_full_model(
            field, goal, pair, after)},
        "paths_on_field": {name: asdict(_on_field(field, points)) | {
            "peak_strain": float(np.abs(field.load(resample(points, STEP), "strain")).max())}
            for name, points in pair.compared.items()},
        "margins": pair.margins,
        "detour": pair.detour and pair.detour.describe(),
        "weights": {"deformation": settings.deformation_weight,
                    "distance": pair.cost.distance,
                    "energy_scale_j": pair.cost.energy_scale,
                    "length_scale_m": pair.cost.length_scale},
        "zero_of_energy": "the hanging state: the branch as scanned, the gripper open; an energy "
        "is the potential of strain and weight, and the gripper's force is its gradient",
        "baseline": asdict(before) | _checked(field, baseline),
        "plan": asdict(after) | _checked(field, plan),
        **(dict.fromkeys(_CHANGES) if pair.stays else dict(zip(_CHANGES, (
            _change(before.energy_integral_jm, after.energy_integral_jm, -1),
            _change(before.peak_energy_j, after.peak_energy_j, -1),
            _change(before.length_m, after.length_m, 1)), strict=True))),
        "convergence": {"baseline": pair.baseline.history, "plan": pair.plan.history},
    }


def _on_full_model(field: EnergyField, goal: Goal, pair: PathPair, found: PathMeasures,
                   ) -> dict[str, Any]:
    """Return what the bound says of every branch whose energy is nowhere farther below the field's
    than 95 % of the samples were, each left out in turn, and how far above that the plan is.

    With c = w E + l and E less an error e, but not below 0, c is nowhere less than l / (l + w e) of
    what it was, and so is the bound. Of a goal for a target it says nothing: where the target is
    the field does not know well enough.
    """
    weights = pair.cost.weights
    cheap = field.samples.energies <= 1.5 * max(found.peak_energy_j, 1e-12)
    missed = np.abs(field.missed[cheap & ~field.region.is_face(), 0])
    error = float(np.quantile(missed, 0.95)) if len(missed) else float(
        np.abs(field.missed[:, 0]).max())
    cost = weights.energy * found.energy_integral_jm + weights.length * found.length_m
    if not np.isfinite(error) or goal.doubt(field) > 0.0:
        return {"field_error_j": error if np.isfinite(error) else None, "lower_bound": None,
                "cost": cost, "gap_percent": None}
    lower = pair.certificate.lower * weights.length / (weights.length + weights.energy * error)
    return {"field_error_j": error, "lower_bound": lower, "cost": cost,
            "gap_percent": 100.0 * (cost / lower - 1.0) if lower > 0.0 else None}


def _is_chosen(settings: PlanSettings) -> bool:
    return not (settings.goal or settings.tip_goal or settings.target_box or settings.in_view
                or settings.second_arm or settings.goal_seed is not None)


def _checked(field: EnergyField, path: ResolvedPath) -> dict[str, Any]:
    """Return the peak strain, and how far the field was from the full model along the path."""
    solved = path.solved
    off = field.energy(solved.poses[:, :3]) - np.maximum(solved.energies, 0.0)
    return {"peak_strain": float(solved.strains.max()),
            "tip_end_m": solved.tips[-1],
            "field_energy_error": field_error(field, solved),
            "field_energy_error_max_j": float(np.abs(off).max()),
            "unsolved_count": path.unsolved_count}


def _on_field(field: EnergyField, points: np.ndarray) -> PathMeasures:
    fine = resample(points, STEP / 5)
    return measure_path(fine, field.energy(fine), np.linalg.norm(field.force(fine), axis=1))


def _doubts(summary: dict[str, Any], field_error: float, *paths: ResolvedPath) -> list[str]:
    if summary["plan"]["length_m"] <= _STILL:
        return ["The start lies in the goal already: the path has no length, and there is nothing "
                "to save."]
    doubts = []
    for key, label, most in (("baseline", "shortest", 15.0), ("plan", "gentle", field_error)):
        error = 100.0 * summary[key]["field_energy_error"]
        if error > most:
            doubts.append(f"Along the {label} path the energy field was off by {error:.2g} % of "
                          f"the full model's energy, over the {most:g} % that may be: sample more "
                          "poses with `limber energy --samples`.")
    gap = summary["certificate"]["gap_percent"]
    if gap is not None and gap > _WIDE_GAP:
        doubts.append(f"The path may cost up to {gap:.1f} % more than the best possible one" + (
            "." if summary["planner"] == "eikonal" else "; `--planner eikonal` comes closest."))
    shortest, gentle = (summary[key]["length_m"] for key in ("baseline", "plan"))
    if shortest > _LONGER * gentle:
        doubts.append("The path that is called shortest is longer than the gentle one: in a large "
                      "goal RRT* aims at a few drawn poses. What is saved against it says little; "
                      "name one goal pose (--goal) to compare paths.")
    unsolved = sum(path.unsolved_count for path in paths)
    if unsolved:
        doubts.append(f"{unsolved} poses along the shortest path had no acceptable solution and "
                      "are left out of its measures.")
    return doubts


def _change(before: float, after: float, sign: int) -> float | None:
    return 100.0 * sign * (after / before - 1.0) if before > 0.0 else None
