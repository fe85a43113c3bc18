"""One start on one branch of the planning bench: planned, bounded, and solved again."""

import time
from dataclasses import dataclass, field

import numpy as np

from benchmarks.planning_optimum import best_cost
from limber.core.errors import LimberError, NoPathError
from limber.planning.baseline_and_plan import plan_within
from limber.planning.constraints.limits import Limits
from limber.planning.cost import CostWeights, resample
from limber.planning.field.energy_field import EnergyField
from limber.planning.field.grasp_model import GraspModel
from limber.planning.goals.goal import goal_points
from limber.planning.goals.goal_kinds import GraspGoal
from limber.planning.make_plan import plan_motion
from limber.planning.path_on_full_model import resolve_path
from limber.planning.path_problem import GentleProblem, random_start
from limber.planning.settings import PlanSettings

_OPTIMUM_STARTS = 3


@dataclass
class Trial:
    """Result of one start; ``trouble`` if no path was found or the branch could not follow.

    ``branch``, ``seed`` and ``source`` (digest of the sources) identify the trial.
    """

    number: int
    branch: str = ""
    seed: int = 0
    source: str = ""
    all_seconds: float = np.nan
    seconds: float = np.nan
    gap: float = np.nan
    to_optimum: float = np.nan
    bound_to_optimum: float = np.nan
    seconds_to_close: float = np.nan
    tree_to_optimum: float = np.nan
    saved: dict[str, float] = field(default_factory=dict)
    added: dict[str, float] = field(default_factory=dict)
    check_seconds: float = np.nan
    rounds: int = 0
    first_field_error: float = np.nan
    field_error: float = np.nan
    limited: str = ""
    excess: float = np.nan
    moving_seconds: float = np.nan
    moving_ratio: float = np.nan
    slowings: float = np.nan
    trouble: str = ""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is None:  # as JSON has it
                setattr(self, name, np.nan)


def run_trial(model: GraspModel, known: EnergyField, goal: GraspGoal, number: int, seed: int, *,
              limited: bool = True, **whose: str) -> Trial:
    """Plan from rest (number 0) or from a random start, without limits and, if ``limited``, with
    one that binds.
    """
    trial, began = Trial(number, seed=seed, **whose), time.perf_counter()
    settings = PlanSettings(seed=seed)
    try:
        start = known.rest.copy() if number == 0 else random_start(known, goal, settings, seed)
        learnt, path = _measure(trial, model, known, start, goal, settings)
        if limited:
            _with_limit(trial, model, learnt, start, path, settings)
    except LimberError as error:
        trial.trouble = f"{type(error).__name__}: {error}"
    trial.all_seconds = time.perf_counter() - began
    return trial


def _measure(trial: Trial, model: GraspModel, known: EnergyField, start: np.ndarray,
             goal: GraspGoal, settings: PlanSettings) -> tuple[EnergyField, np.ndarray]:
    """Plan without limits; return the field at the end of planning, and the path [n, 3]."""
    asked = settings.model_copy(update={"start": tuple(map(float, start)), "goal": goal.position,
                                        "goal_tolerance": goal.tolerance})
    motion = plan_motion(known, model, asked, workers=1)
    summary, learnt = motion.summary, motion.field
    trial.seconds = max(round["plan_seconds"] for round in summary["rounds"])
    trial.check_seconds = max(round["check_seconds"] for round in summary["rounds"])
    trial.rounds = len(summary["rounds"])
    trial.field_error = summary["rounds"][-1]["field_energy_error"]
    trial.first_field_error = summary["rounds"][0]["field_energy_error"]
    certificate = summary["certificate"]
    trial.gap = certificate["upper_bound"] / certificate["lower_bound"] - 1.0
    scales = summary["weights"]
    weights = CostWeights(scales["deformation"], scales["distance"], scales["energy_scale_j"],
                          scales["length_scale_m"]).weights
    problem = GentleProblem(learnt, learnt.limited(), weights, start, goal)
    points = motion.plan.solved.poses[:, :3]
    cost = problem.cost(points)
    best = best_cost(problem, _OPTIMUM_STARTS, settings.seed)
    trial.to_optimum = cost / best
    trial.bound_to_optimum = certificate["lower_bound"] / min(best, cost)
    close = [level["seconds"] for level in certificate["levels"] if level["upper"] <= 1.02 * best]
    trial.seconds_to_close = min(close, default=np.nan)
    if tree := summary["paths_on_field"].get("D-RRT*"):
        trial.tree_to_optimum = (weights.energy * tree["energy_integral_jm"]
                                 + weights.length * tree["length_m"]) / best
    gentle = summary["paths_on_field"]["eikonal"]
    for name, path in summary["paths_on_field"].items():
        if name.startswith("RRT*") or name == "straight line":
            trial.saved[name] = 100.0 * (1.0 - gentle["energy_integral_jm"]
                                         / path["energy_integral_jm"])
            trial.added[name] = 100.0 * (gentle["length_m"] / path["length_m"] - 1.0)
    return learnt, points


def _with_limit(trial: Trial, model: GraspModel, known: EnergyField, start: np.ndarray,
                free: np.ndarray, settings: PlanSettings) -> None:
    """Plan to the same end under a force halfway from the ends' largest to the free peak."""
    force = np.linalg.norm(known.force(resample(free, 0.002)), axis=1)
    ends = max(force[0], force[-1])
    cap = float(max(0.5 * (ends + force.max()), 1.1 * ends))
    bound = settings.model_copy(update={
        "max_force": cap, "start": tuple(map(float, start)), "iterations": 500,
        "goal": tuple(map(float, free[-1]))})
    try:
        motion = plan_motion(known, model, bound, workers=1)
    except NoPathError as error:
        trial.limited = f"refused: {error.seen}"
        return
    states = motion.plan.approach.joined(motion.plan.solved)
    trial.limited = f"accepted after {len(motion.summary['rounds'])}"
    moving = motion.summary["in_motion"]
    trial.moving_seconds, trial.slowings = moving["seconds"], moving["slowings"]
    trial.moving_ratio = moving["peaks"]["force_n"]["moving"] / cap
    # Every pose again, from rest, at half the spacing: not the states that accepted it.
    path = motion.plan.solved.poses[:, :3]
    again = resolve_path(model, resample(path, 0.0025), motion.plan.approach.poses[:, :3])
    worst = max(states.force_sizes.max(), again.solved.force_sizes.max())
    trial.excess = float(worst / cap - 1.0) if again.is_whole else np.inf


def no_path_seconds(known: EnergyField, goal: GraspGoal) -> dict[str, tuple[float, str]]:
    """Return the time to report that no path exists under a force too low for any pose of the goal,
    and behind a workspace that ends before it; and what was reported instead, if anything.
    """
    settings = PlanSettings(iterations=500)
    reached = goal_points(goal, known, known.limited())
    force = 0.5 * float(np.linalg.norm(known.force(reached), axis=1).min())
    middle = 0.5 * (known.rest + goal.centre(known))
    axis = int(np.argmax(np.abs(goal.centre(known) - known.rest)))
    side = "workspace_high" if (goal.centre(known) - known.rest)[axis] > 0.0 else "workspace_low"
    corner = np.full(3, 20.0 if side == "workspace_high" else -20.0)
    corner[axis] = middle[axis]
    found = {}
    for word, limit in (("force", {"max_force": force}),
                        ("workspace", {side: tuple(map(float, corner))})):
        began, asked = time.perf_counter(), settings.model_copy(update=limit)
        try:
            plan_within(known, known.rest.copy(), goal, asked, Limits.of(asked))
            said = "a path"
        except NoPathError as error:
            said = "" if word in str(error) else str(error)
        found[word] = time.perf_counter() - began, said
    return found
