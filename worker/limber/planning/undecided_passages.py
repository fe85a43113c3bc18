"""Poses sampled where the field's error leaves it undecided whether a path exists."""

from dataclasses import dataclass

import numpy as np

from limber.core.progress import SILENT, Progress
from limber.planning.constraints.full_model_check import learnt
from limber.planning.constraints.limits import Limits, sizes
from limber.planning.cost import STEP, resample
from limber.planning.field.energy_field import EnergyField
from limber.planning.field.grasp_model import GraspModel
from limber.planning.field.grasp_samples import GraspSamples
from limber.planning.field.limited_quantities import UNITS
from limber.planning.goals.goal import Goal
from limber.planning.goals.grasp_goal import near
from limber.planning.path_on_full_model import ResolvedPath, resolve_path
from limber.planning.path_problem import BlockedError
from limber.planning.planners.least_violation import easiest_path


@dataclass(frozen=True)
class Passages:
    """The easiest path to the goal on the full model: the states ``learnt`` there, and in words
    ``summary`` what it takes.
    """

    learnt: GraspSamples
    summary: str


def solved_if_undecided(field: EnergyField, grasp_model: GraspModel, start: np.ndarray, goal: Goal,
                        limits: Limits, progress: Progress = SILENT) -> Passages | None:
    """Solve the branch along the path that exceeds the limits least; None if the field's error
    leaves no doubt that it exceeds them, or nothing new can be learnt there.
    """
    path = easiest_path(field, limits.on(field), start, goal)
    asked, margins = limits.asked(), limits.margins(field)
    reserve = max((margins[name] / limit for name, limit in asked.items()), default=0.0)
    if path is None or path.worst > 1.0 + reserve:
        return None
    if path.worst > 1.0:  # the error there may be less
        open_way = easiest_path(field, limits.in_doubt(field), start, goal)
        if open_way is None or open_way.worst > 1.0:
            return None
    approach = field.rest[None]
    if np.linalg.norm(start - field.rest) >= STEP:
        to_start = easiest_path(field, limits.on(field), field.rest.copy(),
                                near(start, STEP))
        approach = approach if to_start is None else np.concatenate([to_start.points, start[None]])
    solved = resolve_path(grasp_model, resample(path.points, STEP), approach, progress)
    found = learnt(field, grasp_model, solved, limits)
    if not len(found.poses) and not len(found.rejected_poses):
        return None
    return Passages(found, _demand_text(solved, limits))


def _demand_text(solved: ResolvedPath, limits: Limits) -> str:
    if not solved.is_whole:
        return "the branch cannot follow the easiest path on the full model"
    values = sizes(solved.solved)
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
