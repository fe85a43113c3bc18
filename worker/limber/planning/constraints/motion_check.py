"""Whether a timed motion keeps its limits with inertia, and the pace at which it does.

The full model is driven along approach and path as fast as the pace allows, by implicit Newmark
steps, and back again from where the branch has come to rest at the path's end. Steps are short
while the gripper accelerates or decelerates and until the resulting vibration has passed its first
peak. In between, where the branch merely follows, a step covers the distance between the poses that
the static check solves.
"""

from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from limber.core.errors import NoPathError, Text
from limber.core.processes import run_tasks
from limber.core.progress import SILENT, Progress
from limber.mechanics import simulate_dynamics
from limber.mechanics.dynamics.motion import DynamicResult, NewmarkSettings
from limber.planning.constraints.limits import Broken, Limits, with_unit
from limber.planning.cost import STEP
from limber.planning.field.energy_field import UNITS, EnergyField, knowing
from limber.planning.field.grasp_model import GraspModel
from limber.planning.field.sampling import displacements_at
from limber.planning.field.stored_states import States
from limber.planning.goals.goal import Goal
from limber.planning.path_on_full_model import ResolvedPath
from limber.planning.timing import Pace, poses_at, time_law

_FINE = 1 / 60  # [s] longest step while speed changes
_RAMP_STEPS = 8  # fewest steps from rest to full speed
_SETTLE = 0.3  # [s] after speed has changed and at the end: the lowest vibrations peak within it
_CHANGES = 0.02  # fraction of the largest acceleration that counts as a change of speed
_LEAST_SLOWING, _MOST_SLOWING = 1.25, 4.0
_TOWARDS = 0.8  # fraction of a limit's reserve for inertia that the next pace uses


@dataclass(frozen=True)
class MotionCheck:
    """A motion on the full model in time, at the last pace, and the limits it breaks, with
    positions. Peaks are by limit with inertia and without, ``excess`` is peak over limit."""

    pace: Pace
    broken: list[str]
    peaks: dict[str, float]
    static_peaks: dict[str, float]
    slowings: int
    excess: dict[str, float]
    step_count: int
    seconds: float

    def describe(self) -> dict:
        """Return it as plain data."""
        return {"speed_m_s": self.pace.speed, "acceleration_m_s2": self.pace.acceleration,
                "slowings": self.slowings, "step_count": self.step_count, "seconds": self.seconds,
                "peaks": {with_unit(name): {"moving": peak, "standing": self.static_peaks[name]}
                          for name, peak in self.peaks.items()}}


def check_motion(grasp_model: GraspModel, path: ResolvedPath, limits: Limits, pace: Pace, *,
                 slowings: int, workers: int | None = None, progress: Progress = SILENT,
                 ) -> MotionCheck:
    """Move along approach, path and back, slowing up to ``slowings`` times until the limits hold.
    The path keeps them at standstill."""
    ahead = path.ahead
    standing = {name: float(np.abs(size).max()) for name, size in ahead.sizes.items()}
    paths = [(ahead.poses, ahead.displacements[0]),
             (ahead.poses[::-1], ahead.displacements[-1])]
    steps, began = 0, perf_counter()
    for attempt in range(slowings + 1):
        part = progress.part(attempt / (slowings + 1), (attempt + 1) / (slowings + 1))
        moved = run_tasks(_moved, [(grasp_model, poses, start, pace, limits)
                                   for poses, start in paths],
                          workers=workers, progress=part, message="the motion in time")
        steps += sum(one.step_count for one in moved)
        peaks = {name: max(one.peaks.get(name, 0.0) for one in moved) for name in limits.asked()
                 if name in standing}
        broken = [words for one in moved for words in one.broken]
        if not broken or attempt == slowings:
            break
        slower = _slower(peaks, standing, limits, not all(one.is_whole for one in moved))
        if slower is None:
            break
        pace = pace.slower(slower)
    excess = {name: peak / getattr(limits, name) for name, peak in peaks.items()}
    return MotionCheck(pace, broken, peaks, standing, attempt, excess, steps,
                       perf_counter() - began)


@dataclass(frozen=True)
class _Moved:
    """One path in time: largest values, broken limits, and whether the branch followed."""

    peaks: dict[str, float]
    broken: list[str]
    is_whole: bool
    step_count: int


def _moved(grasp_model: GraspModel, poses: np.ndarray, start: np.ndarray, pace: Pace,
           limits: Limits, progress: Progress = SILENT) -> _Moved:
    times, grasps = _drive(poses, pace)
    found = simulate_dynamics(
        grasp_model.model, grasp=grasp_model.grasp, times=times, start=start,
        poses=np.hstack([grasps, np.zeros_like(grasps)]),
        settings=NewmarkSettings(max_step=float(np.diff(times).max())), progress=progress)
    values = _sizes(grasp_model, found, limits)
    broken: list[str] = [
        Broken(f"{name.replace('_', ' ')} in motion [{UNITS[name]}]".replace(" []", ""),
               float(size.max()), getattr(limits, name), grasps[size.argmax()]).text
        for name, size in values.items() if size.max() > getattr(limits, name)]
    broken += [Text("in motion ", words) for words in limits.met(
        grasps[:len(found.displacement)], grasp_model.mesh.nodes + found.displacement)]
    if not found.converged:
        last = grasps[len(found.times) - 1]
        where = ", ".join(f"{x:.3f}" for x in last)
        broken.append(Text(f"in motion the branch cannot follow the gripper ({found.message}) at "
                           f"({where}) m").at(last))
    return _Moved({name: float(size.max()) for name, size in values.items()}, broken,
                  found.converged, found.step_count)


def _drive(poses: np.ndarray, pace: Pace) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of the steps [s], [k], and the grasp's positions then [m], [k, 3]."""
    law = time_law(poses[:, :3], pace)
    coarse = STEP / pace.speed
    fine = min(_FINE, pace.speed / pace.acceleration / _RAMP_STEPS, coarse)
    end = law.duration + _SETTLE
    changing = np.abs(law.accelerations) > _CHANGES * pace.acceleration
    cells = np.zeros(int(np.ceil(end / fine)) + 1, bool)
    for first, last in zip(law.times[:-1][changing], law.times[1:][changing], strict=True):
        cells[int(first / fine):int((last + _SETTLE) / fine) + 1] = True
    cells[int(law.duration / fine):] = True
    short = np.flatnonzero(cells) * fine
    times = np.unique(np.concatenate([np.arange(0.0, law.duration, coarse), short, [end]]))
    times = times[times <= end]
    # Two nearly equal instants of the two grids would make a needlessly short step.
    times = times[np.concatenate([[True], np.diff(times) > 0.3 * fine])]
    return times, poses_at(poses, law, times)[:, :3]


def _sizes(grasp_model: GraspModel, found: DynamicResult, limits: Limits) -> dict[str, np.ndarray]:
    """Return the limited quantities at each instant, by the names of ``UNITS``."""
    asked = limits.asked()
    values = {"energy": found.energy, "force": np.linalg.norm(found.reaction_force, axis=1),
              "torque": np.linalg.norm(found.reaction_torque, axis=1)}
    if "axial_force" in asked:
        values["axial_force"] = np.abs([
            grasp_model.axial_force(u, force)
            for u, force in zip(found.displacement, found.reaction_force, strict=True)])
    if {"strain", "stress"} & set(asked):
        loads = [grasp_model.peak_load(u) for u in found.displacement]
        values["strain"], values["stress"] = (np.array([load[k] for load in loads])
                                              for k in (0, 2))
    return {name: size for name, size in values.items() if name in asked}


def _slower(peaks: dict[str, float], standing: dict[str, float], limits: Limits,
            has_failed: bool) -> float | None:
    """Return the factor by which to slow down next; None if no pace keeps a limit. The effect of
    inertia falls with the square of the pace."""
    needed = [_LEAST_SLOWING] if not has_failed else [2.0]
    for name, peak in peaks.items():
        limit = getattr(limits, name)
        if standing[name] >= limit:
            return None
        if peak > limit:
            needed.append(np.sqrt((peak - standing[name]) / (limit - standing[name]) / _TOWARDS))
    return float(min(max(needed), _MOST_SLOWING))


# Check of a planned motion on the full model, and the samples gained if it fails.

_APART = 0.01  # [m] between states of a path that become samples
_MOST_LEARNT = 12  # most of them in a round
_NONE = np.empty((0, 3))
_ROUND_OFF = 1e-12  # fraction of the samples' largest energy
_SLACK = 1e-3  # fraction of the goal's tolerance that is rounding


def broken_on_full_model(path: ResolvedPath, limits: Limits, goal: Goal, nodes: np.ndarray,
                         ) -> list[str]:
    """Return a motion's violations with positions: every pose must be solved within limits and
    constraints, without margins, and the end in the goal. The way back takes the same states."""
    faults: list[str] = []
    for position, reason in zip(path.unsolved, path.reasons, strict=True):
        point_text = ", ".join(f"{x:.3f}" for x in position)
        faults.append(Text(f"no acceptable solution ({reason}) at ({point_text}) m").at(position))
    faults = faults[:1] + ([f"and at {len(faults) - 1} more poses"] if len(faults) > 1 else [])
    whole = path.approach.joined(path.solved)
    faults += [broken.text for broken in limits.broken(whole)]
    if path.is_whole:
        off = goal.missed_by(path.solved)
        if off > goal.tolerance * _SLACK:
            faults.append(f"{goal.what} ends {1e3 * off:.1f} mm outside its goal")
    return faults + limits.met(whole.poses[:, :3], nodes + whole.displacements)


def field_error(field: EnergyField, states: States) -> float:
    """Return the error of the field's energy against states, relative root mean square."""
    size = float(np.sqrt(np.mean(states.energies**2)))
    off = field.energy(states.poses[:, :3]) - np.maximum(states.energies, 0.0)
    # At rest there is only round-off.
    felt = size > _ROUND_OFF * field.samples.energies.max()
    return float(np.sqrt(np.mean(off**2))) / size if felt else 0.0


def learnt(field: EnergyField, grasp_model: GraspModel, path: ResolvedPath, limits: Limits,
           ) -> States:
    """Return states of a rejected path as samples: its end, where limits are broken, and where the
    field's error is largest; and poses without a solution as rejected ones."""
    whole = path.approach.joined(path.solved)
    off = np.abs(field.energy(whole.poses[:, :3]) - whole.energies)
    added = limits.values(whole.poses[:, :3], grasp_model.mesh.nodes + whole.displacements)
    over = [added[each.name] > each.limit for each in limits.constraints]
    broken = np.flatnonzero(np.logical_or.reduce([~limits.kept(whole), *over]))
    order = np.concatenate([[len(off) - 1], broken[:: max(1, 2 * len(broken) // _MOST_LEARNT)],
                            np.argsort(-off)])
    chosen: list[int] = []
    known = field.samples.positions
    for index in order:
        position = whole.poses[index, :3]
        others = np.concatenate([known, whole.poses[chosen, :3]])
        if len(chosen) < _MOST_LEARNT and (
                np.linalg.norm(others - position, axis=1).min() > 0.5 * _APART):
            chosen.append(int(index))
    return as_samples(grasp_model, whole.take(np.array(chosen, int)), limits, path.unsolved)


def as_samples(grasp_model: GraspModel, states: States, limits: Limits,
               unsolved: np.ndarray = _NONE) -> States:
    """Return states with their slopes and the quantities of the ``limits``' constraints;
    ``unsolved`` grasp positions [q, 3] as rejected poses."""
    slopes = [grasp_model.shape_slopes(moved) for moved in states.displacements]
    return replace(
        states, rejected_poses=np.hstack([unsolved, np.zeros_like(unsolved)]),
        shape_slopes=np.reshape(slopes, (len(slopes), 3, states.shape.shape[1])),
        added=limits.values(states.positions, grasp_model.mesh.nodes + states.displacements))


def with_constraints(field: EnergyField, grasp_model: GraspModel, limits: Limits,
                     workers: int | None, progress: Progress) -> EnergyField:
    """Return the field with the constraints' quantities as loads. NoPathError if one is broken
    where the branch hangs."""
    nodes, rest = grasp_model.mesh.nodes, grasp_model.rest.displacement
    if met := limits.met(field.rest[None], nodes + rest[None]):
        raise NoPathError(Text("The branch breaks a limit at its rest pose: ",
                               Text.joined("; ", met), "."), "No path can start there.",
                          "Correct the obstacles in the cell file, or the limit.")
    grasps = field.samples.positions
    displacements = displacements_at(grasp_model, grasps, workers=workers,
                                     progress=progress.part(0.0, 0.1))
    return knowing(field, limits.values(grasps, nodes + displacements))
