"""Follow a planned path with a robot; a dry run unless --arm is given."""

from __future__ import annotations

import json
import re
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from limber.core.errors import InputError, Option, SafetyStop, Text
from limber.core.files.tables import table_line
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.core.settings import Groups, Settings
from limber.robot.operator_decisions import AfterStop, grip, require_confirmation, retreat_if_chosen
from limber.stages.inputs import NOT_KEPT, BranchInputs, by_name, required
from limber.stages.paths.execute_summary import (
    arm_line,
    execution_summary,
    outcome_line,
    write_preview,
)
from limber.stages.registry import StageDescription
from limber.stages.result import Picture, Result, of_files, shown
from limber.store import Branch

if TYPE_CHECKING:
    from collections.abc import Callable

    from limber.cell.cell_file import Cell
    from limber.robot.driver.link import LiveForce, RobotLink
    from limber.robot.motion.execution import Leg, RobotMotion
    from limber.robot.motion.trajectory import Trajectory
    from limber.robot.recorder import PullPlausibility
    from limber.stages.pulls.record_nudge import Nudge

_SPEED, _HOLD_SECONDS = 0.03, 2.0  # m/s, s: of a plan that states none
_TARE_SECONDS = 1.0


class ExecuteInputs(BranchInputs):
    """A branch folder, one of its plans and the robot's cell."""

    groups: ClassVar[Groups] = {"input": ("name", "cell")}
    common = ("name",)

    name: str = Field("path", description="Name of the plan.")
    cell: Path = required("The robot's cell file.", "cell.toml")


class ExecuteSettings(Settings):
    """Settings for following the path."""

    groups: ClassVar[Groups] = {"motion": ("speed", "hold", "gripper_rotation")}

    speed: float | None = Field(None, gt=0, le=0.25, description=(
        "Speed of the gripper [m/s]. Default: the plan's, no faster than the cell allows."))
    hold: float | None = Field(None, ge=0, le=3600, description=(
        "Time to wait at the path's end [s]. Default: the plan's."))
    gripper_rotation: tuple[float, float, float] | None = Field(
        None, description="Rotation vector of the gripper at the grasp, in the branch's frame "
        "[rad]. Default: the direction across the branch that stays farthest from singularities.")


class ExecuteOptions(Settings):
    """Dry run, or motion."""

    groups: ClassVar[Groups] = {"running": ("arm", "confirm", "after_stop", "unwatched")}
    common = ("arm", "confirm")

    arm: bool = Field(False, description="Move the robot. Default: a dry run.",
                      json_schema_extra={"switch": True, "panel": False})
    confirm: str | None = Field(
        None, description="The plan's name, to confirm that the robot may move. Default: ask at "
        "the terminal.", json_schema_extra=NOT_KEPT)
    after_stop: AfterStop = Field(
        "ask", description="What to do after a stop. ask: ask at the terminal, or hold without "
                           "one.",
        json_schema_extra=NOT_KEPT)
    unwatched: bool = Field(
        False, description="Follow the path also where its forces are too small for the guard to "
        "see an empty gripper, a slip, a broken branch or a wrong sensor.",
        json_schema_extra={"switch": True} | NOT_KEPT)


def execute(folder: Path, name: str, cell_file: Path, settings: ExecuteSettings,
            options: ExecuteOptions, *, progress: Progress = SILENT) -> dict[str, Any]:
    """Check a plan for a robot, and with ``arm`` follow it.

    The branch's force along the path is computed again with the full model; the guard stops if the
    measured force differs from it. If armed, the robot approaches the branch and the gripper
    closes and nudges the branch, which shows a wrong sensor as in `limber record`; the path is
    followed, held and retraced; then the gripper opens and the robot leaves.

    Returns:
        ``armed``, ``reached``, ``stop_reason``, ``after_stop`` (as
        :func:`limber.robot.operator_decisions.retreat_if_chosen` returns it), ``peak_force_n``,
        ``path_error_m`` (None in a dry run) and computed values: duration, predicted peak force,
        distances from singularities and joint limits, required position of the robot.

    Raises:
        InputError: plan, cell and branch do not belong together, or the user did not confirm.
            Or the guard could not see a lost branch on the path, and ``unwatched`` is not set.
        NoPathError: the arm cannot follow the path; the message states where and why.
        SafetyStop: the motion was stopped; the log is nevertheless in the folder.
    """
    if options.arm:
        from limber.cell.cell_file import read_cell
        from limber.robot.robot_state import require_weighed

        require_weighed(read_cell(cell_file))
    planned = planned_motion(folder, name, cell_file, settings, progress=progress,
                             is_to_move=options.arm, is_unwatched=options.unwatched)
    if not options.arm:
        write_preview(planned.branch, name, planned.settings, planned.cell, planned.motion)
        return planned.result | {"armed": False, "reached": None, "stop_reason": None,
                                 "after_stop": None, "peak_force_n": None, "path_error_m": None}
    require_confirmation(name, options.confirm, planned.cell, progress)
    return _armed(planned, name, options, progress)


class Execution(Result):
    """The execution of a plan by a robot, or the results of the dry run.

    >>> limber.open("a.branch").execute("cell.toml", name="to-goal").reached  # doctest: +SKIP
    False
    """

    heading = "Executed by the robot: {name}"
    pictures = (Picture("execution_section.force_along_path", "Force of the gripper on the branch: "
                        "measured (smoothed), and predicted at the gripper's measured position. "
                        "The robot moves to the goal, waits and returns.", ("log",)),)

    name: str = shown("plan")
    armed: bool = shown("armed", meaning="whether the robot moved; otherwise it was a dry run")
    reached: bool | None = shown("reached", meaning="whether it reached the path's end and "
                                                    "returned; None in a dry run")
    stop_reason: str | None = shown("stopped", meaning="reason for the stop; None without one")
    predicted_peak_force: float | None = shown("predicted peak force", ".2f N")
    peak_force: float | None = shown("measured peak force", ".2f N")
    force_within_share: float | None = shown(
        "path with the force within 5 % of the peak, or within the interval", ".1f %",
        meaning="fraction of the path with the force within 5 % of the peak, or the interval")
    force_error_of_peak: float | None = shown(
        "force difference not exceeded on 95 % of the path, of the peak", ".1f %",
        meaning="force difference not exceeded on 95 % of the path, a fraction of the peak")
    path_error: float | None = shown("largest distance from the path", ".2f mm")
    log: Any = of_files("the samples of the robot, a path")

    def of_folder(self, branch: Branch, key: str) -> dict[str, Any]:
        name = key.partition(":")[2]
        return {"name": name, "log": branch.path(f"executions/{name}/samples.csv")}


@dataclass(frozen=True)
class PlannedMotion:
    """What :func:`execute` follows.

    Attributes:
        settings: With the plan's own values where none were given.
        across: The nudge before the path; None where the arm can make none.
        result: Computed values, as :func:`execute` returns them.
    """

    branch: Branch
    cell: Cell
    settings: ExecuteSettings
    motion: RobotMotion
    across: Nudge | None
    result: dict[str, Any]


def planned_motion(folder: Path, name: str, cell_file: Path, settings: ExecuteSettings, *,
                   progress: Progress, is_to_move: bool, is_unwatched: bool,
                   ) -> PlannedMotion:
    """Return the checked motion of a plan.

    Args:
        is_unwatched: A path on which the guard cannot see a lost branch is only a warning.

    Raises:
        InputError, NoPathError: as :func:`execute`.
    """
    branch, cell, settings, stated = _plan_of_cell(folder, name, cell_file, settings, progress)
    if is_to_move:
        from limber.cell.cell_file import require_payload

        require_payload(cell)
    from limber.cell.reach_and_collision import blocked_by
    from limber.robot.motion.execution import robot_motion, turned
    from limber.robot.motion.trajectory import Predicted
    from limber.stages.paths.execute_path import (
        offsets_along,
        path_nudge,
        planned_poses,
        predicted_along,
        require_watched,
        require_within_limits,
    )
    from limber.stages.paths.plan_cell import KeptClear
    from limber.stages.paths.plan_legs import legs_in_cell
    from limber.store.loading import load_grasp_model

    progress(0.02, "inverse kinematics")
    model = load_grasp_model(branch, gravity=True, progress=progress)
    clear = KeptClear.of(cell, Path(cell_file).parent, model, stated.get("clearance_m"))
    # The plan's own rotation of the gripper is the one checked against obstacles.
    rotation = settings.gripper_rotation or (stated.get("robot") or {}).get("gripper_rotation")
    asked = {"speed": present(settings.speed, "speed"), "rotation": rotation,
             "blocked": blocked_by(cell, clear.obstacles, clear.clearance)}
    planned = planned_poses(branch, name, model.rest_position)
    offsets = offsets_along(stated.get("turning"), planned[:, :3])
    planned = turned(planned, offsets) if offsets.any() else planned
    if np.isfinite(planned).all():
        # With the plan's own poses: whether the arm reaches them is known at once, forces are not.
        at_once = Predicted.of_forces(planned, np.zeros((len(planned), 3)))
        robot_motion(cell, at_once, model.reach.axis, **asked)
    progress(0.05, "forces along the path")
    predicted = predicted_along(branch, model, planned[:, :3], stated.get("turning"), clear,
                                progress)
    progress(0.4, "inverse kinematics")
    motion = robot_motion(cell, predicted, model.reach.axis, **asked)
    across = path_nudge(branch, model, cell, motion, asked["blocked"], progress)
    result = execution_summary(cell, motion, across) | clear.describe() | {"legs": legs_in_cell(
        cell, clear.obstacles, motion, predicted.poses[:, :3], np.array(clear.surfaces),
        present(settings.hold, "time at the path's end"), progress)}
    require_within_limits(cell, predicted.poses, predicted.wrenches[:, :3])
    require_watched(cell, motion.path, is_unwatched, progress.warn)
    return PlannedMotion(branch, cell, settings, motion, across, result)


def _plan_of_cell(folder: Path, name: str, cell_file: Path, settings: ExecuteSettings,
                  progress: Progress) -> tuple[Branch, Cell, ExecuteSettings, dict[str, Any]]:
    """Read branch and cell, and the robot data of a plan; refuse those that do not match."""
    from limber.cell.cell_file import check_branch, check_plan, read_cell

    branch, cell = Branch.open(folder), read_cell(cell_file)
    if warning := check_branch(cell, branch.uuid, folder):
        progress.warn(warning)
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", name):
        raise InputError(Text(Option("name"), f" {name!r} names no plan."), "",
                         "See plans/ in the branch folder.")
    stated = _stated_by_plan(branch, name)
    if warning := check_plan(stated.get("robot"), cell):
        progress.warn(warning)
    settings = _as_planned(stated, settings, cell)
    settings, cell = _as_slow_as_checked(stated.get("in_motion"), settings, cell, progress)
    from limber.robot.motion.trajectory import speed_within

    speed_within(cell, present(settings.speed, "speed"), progress.warn)
    return branch, cell, settings, stated


def _stated_by_plan(branch: Branch, name: str) -> dict[str, Any]:
    """Robot, clearance, pace, legs and the check in motion that a plan's file states, if in this
    program's format.
    """
    from limber.planning.plan_file import read_plan_summary

    file = f"plans/{name}.json"
    found = read_plan_summary(branch.path(file)) if branch.has(file) else {}
    kept = ("robot", "in_motion", "timing", "legs", "turning", "clearance_m")
    return {key: found[key] for key in kept if found.get(key) is not None}


def _as_planned(plan: dict[str, Any], settings: ExecuteSettings, cell: Cell) -> ExecuteSettings:
    """Return the settings with the plan's own speed and time at its end where none is given."""
    speed = (plan.get("timing") or {}).get("speed_m_s", _SPEED)
    hold = next((leg["duration_s"] for leg in plan.get("legs", ()) if leg["name"] == "hold"),
                _HOLD_SECONDS)
    own = {"speed": min(speed, cell.limits.speed_m_s), "hold": hold}
    return settings.model_copy(update={
        name: value for name, value in own.items() if getattr(settings, name) is None})


def _as_slow_as_checked(checked: dict[str, Any] | None, settings: ExecuteSettings, cell: Cell,
                        progress: Progress) -> tuple[ExecuteSettings, Cell]:
    """Return settings and cell with the pace at which the plan keeps its limits in motion."""
    if checked is None:
        return settings, cell
    speed, acceleration = checked["speed_m_s"], checked["acceleration_m_s2"]
    asked = present(settings.speed, "speed")
    if asked > speed:
        progress.warn(f"The plan keeps its limits in motion up to {1e3 * speed:.1f} mm/s, so it is "
                      "followed at that speed at most. Plan with a higher ", Option("speed"), " to "
                      "go faster.")
    limits = cell.limits.model_copy(update={
        # The plan's motion law uses that fraction of it along the path, the robot's all of it.
        "acceleration_m_s2": min(cell.limits.acceleration_m_s2, np.sqrt(0.5) * acceleration)})
    return (settings.model_copy(update={"speed": min(asked, speed)}),
            cell.model_copy(update={"limits": limits}))


def _armed(planned: PlannedMotion, name: str, options: ExecuteOptions, progress: Progress,
           ) -> dict[str, Any]:
    from limber.core.numerics.rigid import matrices
    from limber.robot.driver.link import COLUMNS, LiveForce, RobotLink
    from limber.robot.motion.execution import followed
    from limber.stages.paths.execute_path import force_sigma
    from limber.stages.pulls.record_nudge import nudged

    branch, cell, motion, across = planned.branch, planned.cell, planned.motion, planned.across
    log = f"executions/{name}/samples.csv"
    with branch.writing(f"the execution of {name}"):
        stream = branch.stream(log)
        batches: list[np.ndarray] = []
        judging: list[PullPlausibility] = []
        try:
            stream.append(table_line(COLUMNS))

            live = LiveForce(branch.folder, f"Following {name}", cell.limits.soft_force_n)

            def take(rows: np.ndarray) -> None:
                batches.append(rows)
                for row in rows:
                    stream.append(table_line(row, digits=7))
                live.take(rows)
                if judging and judging[-1].reason is None and judging[-1].take(rows):
                    link.stop()
            with live, RobotLink(cell, take) as link:
                before_path = None if across is None else partial(nudged, link, live, across,
                                                                  judging)
                event, on_path = _steps(cell, link, motion, planned.settings, options, batches,
                                        live, before_path, progress)
        finally:
            stream.close()
        for warning in link.warnings:
            progress.warn(warning)
        samples = np.concatenate(batches)[on_path[0]:on_path[1]] if on_path else None
        base = matrices(np.array(cell.base.pose))
        path = (base @ matrices(motion.path.poses))[:, :3, 3]
        found = (followed(samples, path, force_sigma(cell, samples))
                 if samples is not None and len(samples) else None)
        reached = event["event"] == "reached"
        result = planned.result | {
            "armed": True, "reached": reached,
            "stop_reason": None if reached else event["reason"],
            "after_stop": event.get("after_stop"),
            "peak_force_n": found.peak_force if found else None,
            "path_error_m": found.path_error if found else None,
            "force_error_of_peak": found.force_error if found else None,
            "force_within_share": found.force_within if found else None}
        with branch.stage(f"execute:{name}", planned.settings,
                          reads=[f"plans/{name}.csv"]) as stage:
            stage.adopt(log)
            from limber.core.json_values import plain

            stage.path(f"executions/{name}/report.json").write_text(
                json.dumps(plain(result), indent=1) + "\n", encoding="utf-8")
            stage.result.update(result)
    if not reached:
        raise SafetyStop(f"The robot was stopped: {event['reason']}.",
                         f"{event['after_stop']['outcome']} The log is in executions/{name}.",
                         "Check the branch and the robot before anything moves, then plan again "
                         "from the current position.", result=result)
    return result


def _steps(cell: Cell, link: RobotLink, motion: RobotMotion, settings: ExecuteSettings,
           options: ExecuteOptions, batches: list[np.ndarray], live: LiveForce,
           before_path: Callable[[], dict[str, Any]] | None, progress: Progress,
           ) -> tuple[dict[str, Any], tuple[int, int] | None]:
    """Execute the legs in order, the nudge before the path; end at the first that is stopped."""
    from limber.robot.motion.execution import legs_of
    from limber.stages.paths.execute_path import require_watched

    _open_at_start(cell, link, motion)
    progress(0.5, "taring: keep the gripper free")
    live.at("taring")
    tared = link.tare(_TARE_SECONDS)
    require_watched(cell, motion.path, options.unwatched, progress.warn, tared["noise_n"])
    on_path: tuple[int, int] | None = None
    event: dict[str, Any] = {}
    for number, leg in enumerate(legs_of(cell, motion, present(settings.hold, "hold"))):
        progress(0.55 + 0.06 * number, leg.name)
        if leg.name == "path" and before_path is not None:
            event = before_path()
            if event["event"] != "reached":
                break
        live.at(leg.name)
        if leg.trajectory is None:
            _stand(cell, link, leg, progress)
            continue
        begin = sum(map(len, batches))
        event = _followed_to_its_end(link, leg.trajectory)
        if leg.name == "path":
            on_path = (begin, sum(map(len, batches)))
        if event["event"] != "reached":
            break
    if event["event"] != "reached":
        event |= {"after_stop": retreat_if_chosen(cell, link, options.after_stop, progress)}
    return event, on_path


def _stand(cell: Cell, link: RobotLink, leg: Leg, progress: Progress) -> None:
    """Execute a leg on which the gripper stands: it closes, holds or opens."""
    if leg.name == "hold":
        time.sleep(leg.duration)
    else:
        grip(cell, link, close=leg.name == "grasp", progress=progress)


def _open_at_start(cell: Cell, link: RobotLink, motion: RobotMotion) -> None:
    """Open the gripper if Limber drives it: it closes on the branch later, and a tare needs it
    empty. Only at the path's start, as elsewhere it may hold something.
    """
    from limber.core.numerics.rigid import inverted, matrices, pose_vectors
    from limber.robot.motion.retreat import require_start
    from limber.robot.ur.grippers import is_driven

    row = link.wait_for_samples()
    pose = pose_vectors(inverted(matrices(np.array(cell.base.pose))) @ matrices(row[1:7]))
    require_start(pose, row[19:25], motion.approach.poses[0], motion.joints.joints[0],
                  cell.arm.joint_names)
    if is_driven(cell):
        link.gripper(close=False)
        time.sleep(cell.tool.grip_seconds)


def _followed_to_its_end(link: RobotLink, trajectory: Trajectory) -> dict[str, Any]:
    try:
        return link.follow(trajectory)
    except KeyboardInterrupt:
        # Ctrl-C stops the arm before anything else.
        link.stop()
        raise


STAGE = StageDescription(
    "execute", 110, by_name(execute, folder="branch_folder", cell_file="cell"), ExecuteInputs,
    ExecuteSettings, ExecuteOptions, key="execute:{name}", result=Execution,
    reads=("plans/{name}.csv", "mesh.vtu", "skeleton.swc"),
    writes=("executions/{name}/samples.csv", "executions/{name}/report.json"),
    found=(outcome_line, "Predicted peak force {predicted_peak_force_n:N}, measured "
           "{peak_force_n:N}; at most {path_error_m:m} off the path.", arm_line),
    then="limber report {branch_folder}", step="robot", label="Check With Robot",
    moves_robot="when armed")
