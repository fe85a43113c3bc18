"""Motions of the arm alone: `limber robot home`, `goto-start`, `retreat`, `release`, `open`.

Each is planned from the arm's current position, and moves nothing without --arm.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from limber.cli.main import Run, stage_command
from limber.core.errors import Command, Option

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell
    from limber.robot.driver.link import RobotLink
    from limber.robot.interface import Sample
    from limber.robot.motion.trajectory import Trajectory

_OBSERVED_SECONDS = 0.1
_TARE_SECONDS = 0.5


def move_command(name: str) -> Callable[[Callable[..., dict[str, Any]]], click.Command]:
    """Make a command ``function(run, cell_file, armed, **options)`` for a motion of the arm alone.
    """
    def wrap(function: Callable[..., dict[str, Any]]) -> click.Command:
        function = click.option(
            "--arm", "armed", is_flag=True, help="Move the robot. Default: a dry run.")(function)
        function = click.option(
            "--confirm", help=f"The word {name}, to confirm that the robot may move. Default: ask "
            "at the terminal.")(function)
        function = click.argument("cell_file", type=click.Path(path_type=Path))(function)
        return stage_command(name)(function)
    return wrap


@move_command("home")
@click.option("--branch", "folder", type=click.Path(path_type=Path),
              help="Branch folder, to keep away from the branch as well.")
def home(run: Run, cell_file: Path, confirm: str | None, armed: bool, folder: Path | None,
         ) -> dict[str, Any]:
    """Move the empty arm to its home pose, past the cell's obstacles and the branch."""
    from limber.cell.cell_file import read_cell

    cell = read_cell(cell_file)
    return _to(run, cell_file, cell, folder, np.array(cell.arm.home), "home", armed, confirm)


@move_command("goto-start")
@click.argument("branch_folder", type=click.Path(path_type=Path))
@click.option("--name", default="path", show_default=True, help="Name of the plan.")
@click.option("--speed", default=0.03, show_default=True,
              help="Speed that `limber execute` will be given [m/s].")
def goto_start(run: Run, cell_file: Path, confirm: str | None, armed: bool, branch_folder: Path,
               name: str, speed: float) -> dict[str, Any]:
    """Move the empty arm to where `limber execute` begins, in the same configuration.

    The plan is checked by a dry run of `limber execute` first, which states that start.
    """
    from limber.cell.cell_file import read_cell
    from limber.stages.paths.execute import ExecutePlan

    cell = read_cell(cell_file)
    dry_run = ExecutePlan(branch_folder=branch_folder, name=name, cell=cell_file, speed=speed,
                          unwatched=True).run(run.progress)
    goal = np.array(dry_run["start_joints_rad"], float)
    return _to(run, cell_file, cell, branch_folder, goal, "goto-start", armed, confirm)


@move_command("retreat")
def retreat(run: Run, cell_file: Path, confirm: str | None, armed: bool) -> dict[str, Any]:
    """Go back along the last path while the force falls; else open the gripper.

    The path is on disk, so this works after a crash of the program that followed it. Exit code 4 if
    a force over the soft limit remains.
    """
    from limber.cell.cell_file import read_cell
    from limber.core.errors import SafetyStop
    from limber.robot.driver.link import RobotLink
    from limber.robot.motion.retreat import RetreatPath, followed_path
    from limber.robot.operator_decisions import require_confirmation, retreat_if_chosen

    cell = read_cell(cell_file)
    followed = followed_path(cell, "Free the branch: limber robot release.")
    sample, pose = stands(cell)
    back = RetreatPath(cell.arm.joint_names, followed).from_here(
        _with_pose(sample, pose), cell.limits.acceleration_m_s2)
    result = {"way_began": datetime.fromtimestamp(followed.at, UTC).isoformat(timespec="seconds"),
              "way_m": float(np.linalg.norm(np.diff(back.poses[:, :3], axis=0), axis=1).sum()),
              "duration_s": back.duration, "tare_known": followed.bias is not None,
              "gripper_closed": followed.gripper_closed, "armed": armed}
    if not armed:
        return result
    require_confirmation("retreat", confirm, cell, run.progress)
    with RobotLink(cell) as link:
        link.wait_for_samples()
        outcome = retreat_if_chosen(cell, link, "retreat", run.progress)
    result |= outcome
    log_move(cell_file, "retreat", result)
    force = outcome["force_n"]
    if not (outcome["retreated"] or outcome["gripper_opened"]) or (
            force is not None and force > cell.limits.soft_force_n):
        raise SafetyStop(outcome["outcome"], "", "Free the branch by hand, or ",
                         Command("robot release"), ".", result=result)
    return result


@move_command("release")
def release(run: Run, cell_file: Path, confirm: str | None, armed: bool) -> dict[str, Any]:
    """Open the gripper, and retreat from the branch opposite to the approach."""
    from limber.cell.cell_file import read_cell
    from limber.robot.driver.link import RobotLink
    from limber.robot.motion.joint_path import away_from_branch
    from limber.robot.operator_decisions import grip, require_confirmation

    cell = read_cell(cell_file)
    sample, pose = stands(cell)
    motion = away_from_branch(cell, sample.joints, pose)
    result = _motion_summary(motion) | {"armed": armed}
    if not armed:
        return result
    require_confirmation("release", confirm, cell, run.progress)
    with RobotLink(cell) as link:
        link.wait_for_samples()
        grip(cell, link, close=False, progress=run.progress)
        return _followed(run, cell_file, "release", link, motion, result)


@move_command("open")
def open_gripper(run: Run, cell_file: Path, confirm: str | None, armed: bool) -> dict[str, Any]:
    """Open the gripper where the arm is; the arm does not move.

    It works while the robot is stopped: no program is needed on the controller.
    """
    from limber.cell.cell_file import read_cell
    from limber.core.errors import InputError
    from limber.robot.motion.retreat import FollowedPathFile
    from limber.robot.ur.grippers import drive_gripper, is_driven

    cell = read_cell(cell_file)
    if not is_driven(cell):
        raise InputError("Limber does not drive the cell's gripper.",
                         f"tool.gripper is {cell.tool.gripper}.", "Open it by hand.")
    result = {"armed": armed, "gripper": cell.tool.gripper,
              "output": cell.tool.close_output if cell.tool.gripper == "digital_output" else None}
    if not armed:
        return result
    if confirm != "open":
        raise InputError("Nobody confirmed that the gripper may open.",
                         "A bent branch springs back.", "Give ", Option("confirm", "open"), ".")
    drive_gripper(cell, False)
    time.sleep(cell.tool.grip_seconds)
    kept = FollowedPathFile(cell)
    kept.gripped(False)
    kept.close()
    log_move(cell_file, "open", result)
    return result


def _to(run: Run, cell_file: Path, cell: Cell, folder: Path | None, goal: np.ndarray, word: str,
        armed: bool, confirm: str | None) -> dict[str, Any]:
    """Plan the path of the empty arm to joint angles ``goal`` [n], and follow it if ``armed``."""
    from limber.cell.obstacles import cell_obstacles
    from limber.cell.reach_and_collision import ArmSurroundings
    from limber.robot.driver.link import RobotLink
    from limber.robot.motion.joint_path import is_at, to_joints
    from limber.robot.operator_decisions import require_confirmation
    from limber.store import Branch
    from limber.store.loading import load_skeleton

    require_empty(cell, run)
    skeleton = None if folder is None else load_skeleton(Branch.read(folder))
    if skeleton is None:
        run.progress.warn("No branch was given, so the arm keeps away from the cell's obstacles "
                          "alone (", Option("branch"), ").")
    around = ArmSurroundings(cell, cell_obstacles(cell, cell_file.parent), skeleton)
    sample, _ = stands(cell)
    if is_at(sample.joints, goal):
        run.close("The arm is there already. Nothing was moved.")
        return {"armed": armed, "duration_s": 0.0}
    motion = to_joints(cell, sample.joints, goal, around)
    assert motion.joints is not None
    result = _motion_summary(motion) | {"armed": armed, "clearance_m": float(
        around.clearance(motion.joints).min())}
    if not armed:
        return result
    require_confirmation(word, confirm, cell, run.progress)
    with RobotLink(cell) as link:
        link.wait_for_samples()
        return _followed(run, cell_file, word, link, motion, result)


def _followed(run: Run, cell_file: Path, word: str, link: RobotLink, motion: Trajectory,
              result: dict[str, Any]) -> dict[str, Any]:
    """Tare, follow a motion of the empty gripper, and log it."""
    from limber.core.errors import SafetyStop

    link.tare(_TARE_SECONDS)
    try:
        event = link.follow(motion)
    except KeyboardInterrupt:
        # Ctrl-C stops the arm before anything else.
        link.stop()
        raise
    result |= {"reached": event["event"] == "reached", "stop_reason": event.get("reason")}
    log_move(cell_file, word, result)
    if not result["reached"]:
        raise SafetyStop(f"The robot was stopped: {event['reason']}.", "The arm holds where it "
                         "stopped.", "Check what it met, then ", Command("robot retreat"), ".",
                         result=result)
    return result


def stands(cell: Cell) -> tuple[Sample, np.ndarray]:
    """Current position of the arm: a sample, and the pose of the gripper's middle [6]."""
    from limber.robot.calibration import gripper_pose
    from limber.robot.robot_state import observe

    sample = observe(cell, _OBSERVED_SECONDS).samples[-1]
    return sample, gripper_pose(cell, sample)


def _with_pose(sample: Sample, pose: np.ndarray) -> Sample:
    from dataclasses import replace

    return replace(sample, pose=pose)


def require_empty(cell: Cell, run: Run) -> None:
    """Refuse a motion of the arm alone if the gripper is known to hold the branch."""
    from limber.core.errors import SafetyStop
    from limber.robot.motion.retreat import read_followed_path

    followed = read_followed_path(cell)
    if followed is not None and followed.gripper_closed:
        raise SafetyStop("The gripper was closed last, and may hold the branch.", "The arm would "
                         "pull at it.", "Use ", Command("robot retreat"), " or ",
                         Command("robot release"), " first.")
    if cell.tool.gripper == "by_hand":
        run.progress.warn("The gripper is opened by hand: check that it is open.")


def _motion_summary(motion: Trajectory) -> dict[str, Any]:
    assert motion.joints is not None
    return {"duration_s": motion.duration, "start_joints_rad": motion.joints[0],
            "end_joints_rad": motion.joints[-1], "pose_count": len(motion.times),
            "greatest_speed_m_s": float(motion.greatest_speeds[0])}


def log_move(cell_file: Path, word: str, result: dict[str, Any]) -> None:
    """Add a line to the log of this user's robots."""
    import json

    from limber.core.json_values import plain
    from limber.robot.motion.retreat import log_path

    path = log_path()
    path.parent.mkdir(parents=True, exist_ok=True)
    line = {"at": datetime.now(UTC).isoformat(timespec="seconds"), "command": word,
            "cell": str(cell_file.absolute())} | result
    with open(path, "a", encoding="utf-8") as stream:
        stream.write(json.dumps(plain(line)) + "\n")
