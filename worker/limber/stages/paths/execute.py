"""Stage ``execute``."""

from __future__ import annotations

import re
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from limber.core.errors import InputError, LimberError, Option, SafetyStop, Text
from limber.core.files.tables import table_line
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.core.settings import Groups
from limber.robot.operator_decisions import AfterStop, grip, require_confirmation, retreat_if_chosen
from limber.stages.paths.execute_summary import (
    arm_line,
    noticed_lines,
    outcome_line,
    write_preview,
)
from limber.stages.result import Picture, Result, of_files, shown
from limber.stages.stage import About, BranchStage, given, option, required
from limber.store import Branch

if TYPE_CHECKING:
    from collections.abc import Callable

    from limber.cell.cell_file import Cell
    from limber.robot.driver.link import LiveForce, RobotLink
    from limber.robot.motion.execution import Leg, RobotMotion
    from limber.robot.recorder import PullPlausibility
    from limber.stages.paths.execute_path import PlannedMotion

_SPEED, _HOLD_SECONDS = 0.03, 2.0  # m/s, s: of a plan that states none
_TARE_SECONDS = 1.0


class Execution(Result):
    """The execution of a plan by a robot, or the results of the dry run.

    >>> limber.open("a.branch").execute("cell.toml", name="to-goal").reached  # doctest: +SKIP
    False
    """

    heading = "Executed by the robot: {name}"
    pictures = (Picture("figures.force_along_path", "Force of the gripper on the branch: "
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


class ExecutePlan(BranchStage):
    """Follow a planned path with a robot; a dry run unless --arm is given."""

    about = About(
        "execute", 110, Execution, key="execute:{name}",
        reads=("plans/{name}.csv", "mesh.vtu", "skeleton.swc"),
        writes=("executions/{name}/samples.csv", "executions/{name}/report.json"),
        found=(outcome_line, "Predicted peak force {predicted_peak_force_n:N}, measured "
               "{peak_force_n:N}; at most {path_error_m:m} off the path.", arm_line,
               noticed_lines),
        then="limber report {branch_folder}", step="robot", label="Check With Robot",
        moves_robot="when armed")
    groups: ClassVar[Groups] = {"motion": ("speed", "hold", "gripper_rotation")}
    common = ("speed", "hold")

    name: str = given("Name of the plan.", "path", common=True)
    cell: Path = required("The robot's cell file.", "cell.toml")
    speed: float | None = Field(None, gt=0, le=0.25, description=(
        "Speed of the gripper [m/s]. Default: the plan's, no faster than the cell allows."))
    hold: float | None = Field(None, ge=0, le=3600, description=(
        "Time to wait at the path's end [s]. Default: the plan's."))
    gripper_rotation: tuple[float, float, float] | None = Field(
        None, description="Rotation vector of the gripper at the grasp, in the branch's frame "
        "[rad]. Default: the direction across the branch that stays farthest from singularities.")
    arm: bool = option("Move the robot. Default: a dry run.", False, common=True, switch=True,
                       panel=False)
    confirm: str | None = option(
        "The plan's name, to confirm that the robot may move. Default: ask at the terminal.",
        common=True, panel=False)
    after_stop: AfterStop = option(
        "What to do after a stop. ask: ask at the terminal, or hold without one.", "ask",
        panel=False)
    replan: int = option(
        "Most times that the rest of the path is planned anew from where it was stopped: for the "
        "soft force limit, or a branch softer or stiffer than estimated. 0: never.", 0,
        limits={"ge": 0, "le": 20}, panel=False)
    unwatched: bool = option(
        "Follow the path also where its forces are too small for the guard to see an empty "
        "gripper, a slip, a broken branch or a wrong sensor.", False, switch=True, panel=False)

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Check a plan for a robot, and with ``arm`` follow it.

        The branch's force along the path is computed again with the full model; the guard stops if
        the measured force differs from it. If armed, the robot approaches the branch and the
        gripper closes and nudges the branch, which shows a wrong sensor as in `limber record`; the
        path is followed, held and retraced; then the gripper opens and the robot leaves.

        Returns:
            ``armed``, ``reached``, ``stop_reason``, ``after_stop`` (as
            :func:`limber.robot.operator_decisions.retreat_if_chosen` returns it), ``peak_force_n``,
            ``path_error_m`` (None in a dry run) and computed values: duration, predicted peak
            force, distances from singularities and joint limits, required position of the robot.

        Raises:
            InputError: plan, cell and branch do not belong together, or the user did not confirm.
                Or the guard could not see a lost branch on the path, and ``unwatched`` is not set.
            NoPathError: the arm cannot follow the path; the message states where and why.
            SafetyStop: the motion was stopped; the log is nevertheless in the folder.
        """
        if self.arm:
            from limber.cell.cell_file import read_cell
            from limber.robot.robot_state import require_weighed

            require_weighed(read_cell(self.cell))
        planned = planned_motion(self, progress, is_to_move=self.arm)
        if not self.arm:
            write_preview(planned.branch, self.name, planned.asked, planned.cell, planned.motion)
            return planned.result | {"armed": False, "reached": None, "stop_reason": None,
                                     "after_stop": None, "peak_force_n": None, "path_error_m": None}
        progress.warn(noticed_lines(planned.result))
        require_confirmation(self.name, self.confirm, planned.cell, progress)
        return _armed(planned, progress)


def planned_motion(asked: ExecutePlan, progress: Progress, *, is_to_move: bool) -> PlannedMotion:
    """Return the checked motion of a plan; InputError, NoPathError as of
    :meth:`ExecutePlan.run`."""
    branch, cell, asked, stated = _plan_of_cell(asked, progress)
    if is_to_move:
        from limber.cell.cell_file import require_payload

        require_payload(cell)
    from limber.cell.reach_and_collision import blocked_by
    from limber.robot.motion.execution import robot_motion, turned
    from limber.robot.motion.trajectory import Predicted
    from limber.stages.paths.execute_path import (
        PlannedMotion,
        checked_motion,
        offsets_along,
        path_nudge,
        planned_poses,
        predicted_along,
    )
    from limber.stages.paths.plan_cell import KeptClear
    from limber.stages.paths.plan_uncertainty import estimated_uncertainty
    from limber.store.loading import load_grasp_model

    progress(0.02, "inverse kinematics")
    model = load_grasp_model(branch, gravity=True, progress=progress)
    known = estimated_uncertainty(branch, model)
    if known is None:
        progress.warn("There is no estimate, so the uncertainty of Young's modulus is unknown. "
                      "The interval of the predicted force does not include it.")
    clear = KeptClear.of(cell, asked.cell.parent, model, stated.get("clearance_m"))
    # The plan's own rotation of the gripper is the one checked against obstacles.
    rotation = asked.gripper_rotation or (stated.get("robot") or {}).get("gripper_rotation")
    wish: dict[str, Any] = {
        "speed": present(asked.speed, "speed"), "rotation": rotation,
        "blocked": blocked_by(cell, clear.obstacles, clear.clearance)}
    planned = planned_poses(branch, asked.name, model.rest_position)
    offsets = offsets_along(stated.get("turning"), planned[:, :3])
    planned = turned(planned, offsets) if offsets.any() else planned
    if np.isfinite(planned).all():
        # With the plan's own poses: whether the arm reaches them is known at once, forces are not.
        at_once = Predicted.of_forces(planned, np.zeros((len(planned), 3)))
        robot_motion(cell, at_once, model.reach.axis, **wish)
    progress(0.05, "forces along the path")
    predicted = predicted_along(model, known, planned[:, :3], stated.get("turning"), clear,
                                progress)
    progress(0.4, "inverse kinematics")
    motion = robot_motion(cell, predicted, model.reach.axis, **wish)
    across = path_nudge(branch, model, cell, motion, wish["blocked"], progress)
    result = checked_motion(cell, asked, predicted, motion, across, clear, progress)
    return PlannedMotion(branch, cell, asked, stated, model, known, predicted, wish, motion, across,
                         result)


def _plan_of_cell(asked: ExecutePlan, progress: Progress,
                  ) -> tuple[Branch, Cell, ExecutePlan, dict[str, Any]]:
    """Read branch and cell, and the robot data of a plan; refuse those that do not match."""
    from limber.cell.cell_file import check_branch, check_plan, read_cell

    branch, cell = Branch.open(asked.branch_folder), read_cell(asked.cell)
    if warning := check_branch(cell, branch.uuid, asked.branch_folder):
        progress.warn(warning)
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", asked.name):
        raise InputError(Text(Option("name"), f" {asked.name!r} names no plan."), "",
                         "See plans/ in the branch folder.")
    stated = _stated_by_plan(branch, asked.name)
    if warning := check_plan(stated.get("robot"), cell):
        progress.warn(warning)
    asked = _as_planned(stated, asked, cell)
    asked, cell = _as_slow_as_checked(stated.get("in_motion"), asked, cell, progress)
    from limber.robot.motion.trajectory import speed_within

    speed_within(cell, present(asked.speed, "speed"), progress.warn)
    return branch, cell, asked, stated


def _stated_by_plan(branch: Branch, name: str) -> dict[str, Any]:
    """Robot, clearance, pace, legs and check in motion of a plan's file, if in this program's
    format."""
    from limber.planning.plan_file import read_plan_summary

    file = f"plans/{name}.json"
    found = read_plan_summary(branch.path(file)) if branch.has(file) else {}
    kept = ("robot", "in_motion", "timing", "legs", "turning", "clearance_m", "goal",
            "limits")
    return {key: found[key] for key in kept if found.get(key) is not None}


def _as_planned(plan: dict[str, Any], asked: ExecutePlan, cell: Cell) -> ExecutePlan:
    """Return the stage with the plan's own speed and time at its end where none is given."""
    speed = (plan.get("timing") or {}).get("speed_m_s", _SPEED)
    hold = next((leg["duration_s"] for leg in plan.get("legs", ()) if leg["name"] == "hold"),
                _HOLD_SECONDS)
    own = {"speed": min(speed, cell.limits.speed_m_s), "hold": hold}
    return asked.model_copy(update={
        name: value for name, value in own.items() if getattr(asked, name) is None})


def _as_slow_as_checked(checked: dict[str, Any] | None, asked: ExecutePlan, cell: Cell,
                        progress: Progress) -> tuple[ExecutePlan, Cell]:
    """Return stage and cell with the pace at which the plan keeps its limits in motion."""
    if checked is None:
        return asked, cell
    speed, acceleration = checked["speed_m_s"], checked["acceleration_m_s2"]
    wish = present(asked.speed, "speed")
    if wish > speed:
        progress.warn(f"The plan keeps its limits in motion up to {1e3 * speed:.1f} mm/s, so it is "
                      "followed at that speed at most. Plan with a higher ", Option("speed"), " to "
                      "go faster.")
    limits = cell.limits.model_copy(update={
        # The plan's motion law uses that fraction of it along the path, the robot's all of it.
        "acceleration_m_s2": min(cell.limits.acceleration_m_s2, np.sqrt(0.5) * acceleration)})
    return (asked.model_copy(update={"speed": min(wish, speed)}),
            cell.model_copy(update={"limits": limits}))


def _armed(planned: PlannedMotion, progress: Progress) -> dict[str, Any]:
    from limber.core.numerics.rigid import matrices
    from limber.robot.driver.link import COLUMNS, LiveForce, RobotLink
    from limber.robot.motion.execution import followed
    from limber.stages.paths.execute_path import force_sigma
    from limber.stages.pulls.record_nudge import nudged

    branch, cell, across = planned.branch, planned.cell, planned.across
    asked, name = planned.asked, planned.asked.name
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
                planned, event, paths = _steps(planned, link, batches, live, before_path, progress)
        finally:
            stream.close()
        for warning in link.warnings:
            progress.warn(warning)
        rows = np.concatenate(batches)
        base = matrices(np.array(cell.base.pose))
        path = (base @ matrices(planned.motion.path.poses))[:, :3, 3]
        samples = rows[paths[-1]] if paths else rows[:0]
        found = followed(samples, path, force_sigma(cell, samples)) if len(samples) else None
        reached = event["event"] == "reached"
        result = planned.result | {
            "armed": True, "reached": reached,
            "stop_reason": None if reached else event["reason"],
            "after_stop": event.get("after_stop"),
            "peak_force_n": float(np.linalg.norm(
                rows[paths[0].start:paths[-1].stop, 13:16], axis=1).max()) if found else None,
            "path_error_m": found.path_error if found else None,
            "force_error_of_peak": found.force_error if found else None,
            "force_within_share": found.force_within if found else None}
        with branch.stage(f"execute:{name}", asked,
                          reads=[f"plans/{name}.csv"]) as stage:
            stage.adopt(log)
            stage.write(f"executions/{name}/report.json", result)
            stage.result.update(result)
    if not reached:
        raise SafetyStop(f"The robot was stopped: {event['reason']}.",
                         f"{event['after_stop']['outcome']} The log is in executions/{name}.",
                         "Check the branch and the robot before anything moves, then plan again "
                         "from the current position.", result=result)
    return result


def _steps(planned: PlannedMotion, link: RobotLink, batches: list[np.ndarray], live: LiveForce,
           before_path: Callable[[], dict[str, Any]] | None, progress: Progress,
           ) -> tuple[PlannedMotion, dict[str, Any], list[slice]]:
    """Execute the legs in order, the nudge before the path; end at the first that is stopped, if
    its rest is not planned anew. Returns what was followed last, how that ended, and the samples of
    each path."""
    from limber.stages.paths.execute_path import require_watched
    from limber.stages.paths.execute_replan import is_of_modulus, planned_anew

    cell, asked, paths = planned.cell, planned.asked, list[slice]()
    _open_at_start(cell, link, planned.motion)
    progress(0.5, "taring: keep the gripper free")
    live.at("taring")
    tared = link.tare(_TARE_SECONDS)
    require_watched(cell, planned.motion.path, asked.unwatched, progress.warn, tared["noise_n"])
    name, event = _legs(planned, link, batches, live, paths, before_path, progress)
    while (name == "path" and paths and len(paths) <= asked.replan
           and event["event"] != "reached" and is_of_modulus(event["reason"])):
        live.at("planning anew")
        progress.warn(f"The robot was stopped: {event['reason']}. Its path is planned anew "
                      f"({len(paths)} of at most {asked.replan} times); it holds the branch.")
        try:
            planned = planned_anew(planned, event, link, progress.part(0.5, 0.55))
        except LimberError as error:
            progress.warn(f"It was not planned anew: {error}")
            break
        name, event = _legs(planned, link, batches, live, paths, None, progress)
    if event["event"] != "reached":
        event |= {"after_stop": retreat_if_chosen(cell, link, asked.after_stop, progress)}
    return planned, event, paths


def _legs(planned: PlannedMotion, link: RobotLink, batches: list[np.ndarray], live: LiveForce,
          paths: list[slice], before_path: Callable[[], dict[str, Any]] | None, progress: Progress,
          ) -> tuple[str, dict[str, Any]]:
    """Execute the legs in order; return the last one's name, and the event that ended it."""
    from limber.robot.motion.execution import legs_of

    cell, event = planned.cell, dict[str, Any]()
    for number, leg in enumerate(legs_of(cell, planned.motion, present(planned.asked.hold, "hold"),
                                         planned.begun)):
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
        event = link.follow(leg.trajectory)
        if leg.name == "path":
            paths.append(slice(begin, sum(map(len, batches))))
        if event["event"] != "reached":
            break
    return leg.name, event


def _stand(cell: Cell, link: RobotLink, leg: Leg, progress: Progress) -> None:
    """Execute a leg on which the gripper stands: it closes, holds or opens."""
    if leg.name == "hold":
        time.sleep(leg.duration)
    else:
        grip(cell, link, close=leg.name == "grasp", progress=progress)


def _open_at_start(cell: Cell, link: RobotLink, motion: RobotMotion) -> None:
    """Open the gripper if Limber drives it, only at the path's start, as elsewhere it may hold
    something: it closes on the branch later, and a tare needs it empty."""
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
