"""Passages of a plan that the field leaves open or closes, looked at on the full model."""

from dataclasses import dataclass, replace

import numpy as np

from limber.core.errors import Command, Option
from limber.core.progress import SILENT, Progress
from limber.planning.constraints.limits import Limits, sampled_sizes, sizes
from limber.planning.constraints.motion_check import learnt
from limber.planning.cost import STEP, resample
from limber.planning.field.energy_field import UNITS, EnergyField, limited
from limber.planning.field.grasp_model import GraspModel
from limber.planning.field.sampling import SolverPool, solve_branch
from limber.planning.field.stored_states import GraspSamples, Solved, samples_of
from limber.planning.goals.goal import Goal
from limber.planning.goals.goal_kinds import near
from limber.planning.path_on_full_model import ResolvedPath, SolvedPoses, resolve_path
from limber.planning.path_problem import UNPROVEN, BlockedError
from limber.planning.planners.least_violation import LeastViolation, easiest_path

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
    learnt: GraspSamples | None = None


def checked_wall(field: EnergyField, grasp_model: GraspModel, limits: Limits, none: BlockedError,
                 goal: Goal, *, workers: int | None = None, progress: Progress = SILENT,
                 ) -> WallCheck:
    """Solve the branch where ``none`` states that the path is blocked. A pose without a solution is
    closed as well: the branch cannot be there. Without any solution nothing is confirmed."""
    wall = _chosen(none.wall)
    points = np.concatenate([wall, _chosen(none.nearest)])
    if not len(points):
        return WallCheck(0, True)
    with SolverPool(grasp_model, workers) as solvers:
        good, _ = solve_branch(solvers, points, progress=progress)
    states = good[1:]
    if not states:
        return WallCheck(0, False)
    samples = samples_of(states, np.empty((0, 3)))
    nodes = grasp_model.mesh.nodes + np.array([one.displacement for one in states])
    samples = replace(samples, added=limits.values(samples.positions, nodes))
    is_wall = np.array([one.target < len(wall) for one in states])
    over, off = _over_and_off(field, limits, samples)
    meets = np.array([_meets(field, goal, one) for one in states])
    if not np.where(is_wall, ~over | off, ~over & meets).any():
        return WallCheck(len(states), True)
    away = np.linalg.norm(samples.positions[:, None] - field.samples.positions[None], axis=2)
    new = np.flatnonzero(away.min(axis=1) > _LEARNT_APART)
    return WallCheck(len(states), False, samples.take(new) if len(new) else None)


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


def _meets(field: EnergyField, goal: Goal, one: Solved) -> bool:
    """Return whether a state is in the goal, or nearer to it than the field's error allows."""
    place = one.pose[None, :3]
    missed = goal.missed_by(SolvedPoses(
        one.pose[None], np.array([one.energy]), one.force[None], one.torque[None],
        np.array([one.strain]), one.strain_place[None], np.array([one.stress]),
        np.array([one.min_det_f]), one.tip[None], one.targets[None],
        np.array([one.axial_force]), one.displacement[None]))
    by_field = float(goal.distance(field, place)[0]) - goal.tolerance
    return missed <= 0.0 or missed < by_field - float(goal.uncertainty(field, place)[0])


def _over_and_off(field: EnergyField, limits: Limits, samples: GraspSamples,
                  ) -> tuple[np.ndarray, np.ndarray]:
    """Return which states break a limit, and which are farther below the field than its error, bool
    [n] each."""
    sizes, points = sampled_sizes(samples), samples.positions
    errors, asked = limits.errors(field), limits.asked()
    places = field.region.chart.plain.map(points)
    over, off = np.zeros(len(points), bool), np.zeros(len(points), bool)
    for one in limited(field, limits.on(field)):
        size = sizes[one.name]
        if size is None:
            continue
        over |= np.abs(size) > asked[one.name]
        if one.name in errors:
            off |= one.size(points) - np.abs(size) > errors[one.name].at(places)
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

    learnt: GraspSamples
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
