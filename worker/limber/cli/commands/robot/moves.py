"""Motions of the arm alone: `limber robot home`, `goto-start`, `goto-grasp`, `retreat`, `release`,
`open`.

Each is planned from the arm's current position, and moves nothing without --arm.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from limber.cli.cell_tool import ArmedTool, confirmed_by, require_word
from limber.core.errors import Command, InputError, Option, SafetyStop
from limber.core.json_values import plain
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.geometry.settings import GRASP_FRACTION
from limber.stages.stage import About, argument, given

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell
    from limber.robot.interface import Sample
    from limber.robot.motion.trajectory import Trajectory

_OBSERVED_SECONDS = 0.1
_TARE_SECONDS = 0.5


def _stays(values: Mapping[str, Any]) -> str:
    return "" if "pose_count" in values else "The arm is there already. Nothing was moved."


class Home(ArmedTool):
    """Move the empty arm to its home pose, past the cell's obstacles and the branch."""

    about = About("robot home", found=(_stays,), where="", moves_robot="when armed")

    branch: Path | None = given("Branch folder, to keep away from the branch as well.")
    confirm: str | None = confirmed_by("home")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        cell = self.cell()
        return _to(self, cell, self.branch, np.array(cell.arm.home), progress)


class GotoStart(ArmedTool):
    """Move the empty arm to where `limber execute` begins, in the same configuration.

    The plan is checked by a dry run of `limber execute` first, which states that start.
    """

    about = About("robot goto-start", found=(_stays,), where="", moves_robot="when armed")

    branch_folder: Path = argument("The branch folder.")
    name: str = given("Name of the plan.", "path")
    speed: float = Field(0.03, description="Speed that `limber execute` will be given [m/s].")
    confirm: str | None = confirmed_by("goto-start")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.stages.paths.execute import ExecutePlan

        cell = self.cell()
        dry_run = ExecutePlan(branch_folder=self.branch_folder, name=self.name,
                              cell=self.cell_file, speed=self.speed, unwatched=True).run(progress)
        return _to(self, cell, self.branch_folder, np.array(dry_run["start_joints_rad"], float),
                   progress)


class GotoGrasp(ArmedTool):
    """Move the empty arm and its open gripper onto the branch, to where `limber record` begins.

    The arm goes to a place before the branch, past obstacles, then straight along the cell's
    approach; a force ends it. Of all directions across the branch it takes the one from which it
    reaches 6 cm around the grasp, farthest from singularities.
    """

    about = About("robot goto-grasp", where="", moves_robot="when armed",
                  then="limber record {branch_folder} --cell {cell_file}")

    branch_folder: Path = argument("The branch folder.")
    fraction: float = Field(GRASP_FRACTION, gt=0, le=1, description=(
        "Where the gripper comes to, as a fraction of the main path."))
    confirm: str | None = confirmed_by("goto-grasp")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.cell.obstacles import cell_obstacles
        from limber.cell.reach_and_collision import ArmSurroundings, blocked_by
        from limber.cli.closed_loop.cell_layout import grasp_of, gripper_at
        from limber.core.numerics.rigid import matrices, pose_vectors
        from limber.robot.motion.joint_path import away_from_branch
        from limber.store import Branch
        from limber.store.loading import load_skeleton

        cell, skeleton = self.cell(), load_skeleton(Branch.read(self.branch_folder))
        obstacles = cell_obstacles(cell, self.cell_file.parent)
        met, around = blocked_by(cell, obstacles), ArmSurroundings(cell, obstacles, skeleton)
        # The last joints are of the place before the branch.
        joints, _ = gripper_at(
            cell, *grasp_of(skeleton, self.fraction), lambda flange, joints: not around.free(
                joints[-1:]).all() or (met is not None and met(flange, joints) is not None))
        here = cell.arm.forward(joints) @ matrices(np.array(cell.tool.grasp_pose))
        way = away_from_branch(cell, joints, pose_vectors(here)).backwards()
        return _to(self, cell, self.branch_folder, present(way.joints, "joints")[0], progress, way)


class Retreat(ArmedTool):
    """Go back along the last path while the force falls; else open the gripper.

    The path is on disk, so this works after a crash of the program that followed it. Exit code 4 if
    a force over the soft limit remains.
    """

    about = About("robot retreat", moves_robot="when armed")

    confirm: str | None = confirmed_by("retreat")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.robot.driver.link import RobotLink
        from limber.robot.motion.retreat import RetreatPath, followed_path
        from limber.robot.operator_decisions import require_confirmation, retreat_if_chosen

        cell = self.cell()
        followed = followed_path(cell, "Free the branch: limber robot release.")
        sample, pose = stands(cell)
        back = RetreatPath(cell.arm.joint_names, followed).from_here(
            replace(sample, pose=pose), cell.limits.acceleration_m_s2)
        result = {
            "way_began": datetime.fromtimestamp(followed.at, UTC).isoformat(timespec="seconds"),
            "way_m": float(np.linalg.norm(np.diff(back.poses[:, :3], axis=0), axis=1).sum()),
            "duration_s": back.duration, "tare_known": followed.bias is not None,
            "gripper_closed": followed.gripper_closed, "armed": self.arm}
        if not self.arm:
            return result
        require_confirmation("retreat", self.confirm, cell, progress)
        with RobotLink(cell) as link:
            link.wait_for_samples()
            outcome = retreat_if_chosen(cell, link, "retreat", progress)
        result |= outcome
        log_move(self, result)
        force = outcome["force_n"]
        if not (outcome["retreated"] or outcome["gripper_opened"]) or (
                force is not None and force > cell.limits.soft_force_n):
            raise SafetyStop(outcome["outcome"], "", "Free the branch by hand, or ",
                             Command("robot release"), ".", result=result)
        return result


class Release(ArmedTool):
    """Open the gripper, and retreat from the branch opposite to the approach."""

    about = About("robot release", moves_robot="when armed")

    confirm: str | None = confirmed_by("release")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.robot.motion.joint_path import away_from_branch

        cell = self.cell()
        sample, pose = stands(cell)
        motion = away_from_branch(cell, sample.joints, pose)
        return _followed(self, cell, [motion], {}, progress, opens=True)


class Open(ArmedTool):
    """Open the gripper where the arm is; the arm does not move.

    It works while the robot is stopped: no program is needed on the controller.
    """

    about = About("robot open", moves_robot="when armed")

    confirm: str | None = confirmed_by("open")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.robot.motion.retreat import FollowedPathFile
        from limber.robot.ur.grippers import drive_gripper, is_driven

        cell = self.cell()
        if not is_driven(cell):
            raise InputError("Limber does not drive the cell's gripper.",
                             f"tool.gripper is {cell.tool.gripper}.", "Open it by hand.")
        output = cell.tool.close_output if cell.tool.gripper == "digital_output" else None
        result = {"armed": self.arm, "gripper": cell.tool.gripper, "output": output}
        if not self.arm:
            return result
        require_word("open", self.confirm, "A bent branch springs back.", what="gripper")
        drive_gripper(cell, False)
        time.sleep(cell.tool.grip_seconds)
        kept = FollowedPathFile(cell)
        kept.gripped(False)
        kept.close()
        log_move(self, result)
        return result


def _to(move: Home | GotoStart | GotoGrasp, cell: Cell, folder: Path | None, goal: np.ndarray,
        progress: Progress, *then: Trajectory) -> dict[str, Any]:
    """Plan the path of the empty arm to joint angles ``goal`` [n], and follow it if armed, and what
    comes ``then``."""
    from limber.cell.obstacles import cell_obstacles
    from limber.cell.reach_and_collision import ArmSurroundings
    from limber.robot.motion.joint_path import is_at, to_joints
    from limber.store import Branch
    from limber.store.loading import load_skeleton

    require_empty(cell, progress)
    skeleton = None if folder is None else load_skeleton(Branch.read(folder))
    if skeleton is None:
        progress.warn("No branch was given, so the arm keeps away from the cell's obstacles "
                      "alone (", Option("branch"), ").")
    around = ArmSurroundings(cell, cell_obstacles(cell, move.cell_file.parent), skeleton)
    sample, _ = stands(cell)
    motions, clearance = list(then), {}
    if not is_at(sample.joints, goal):
        motion = to_joints(cell, sample.joints, goal, around)
        motions.insert(0, motion)
        clearance["clearance_m"] = float(around.clearance(present(motion.joints, "joints")).min())
    if not motions:
        return {"armed": move.arm, "duration_s": 0.0}
    return _followed(move, cell, motions, clearance, progress)


def _followed(move: Home | GotoStart | GotoGrasp | Release, cell: Cell, motions: list[Trajectory],
              result: dict[str, Any], progress: Progress, *, opens: bool = False) -> dict[str, Any]:
    """Follow motions of the empty gripper if armed, and log them; ``opens`` the gripper before."""
    from limber.robot.driver.link import RobotLink
    from limber.robot.operator_decisions import grip, require_confirmation

    result |= _motion_summary(motions) | {"armed": move.arm}
    if not move.arm:
        return result
    require_confirmation(move.about.name.rpartition(" ")[2], move.confirm, cell, progress)
    with RobotLink(cell) as link:
        link.wait_for_samples()
        if opens:
            grip(cell, link, close=False, progress=progress)
        link.tare(_TARE_SECONDS)
        for motion in motions:
            event = link.follow(motion)
            if event["event"] != "reached":
                break
    result |= {"reached": event["event"] == "reached", "stop_reason": event.get("reason")}
    log_move(move, result)
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


def require_empty(cell: Cell, progress: Progress) -> None:
    """Refuse a motion of the arm alone if the gripper is known to hold the branch."""
    from limber.robot.motion.retreat import read_followed_path

    followed = read_followed_path(cell)
    if followed is not None and followed.gripper_closed:
        raise SafetyStop("The gripper was closed last, and may hold the branch.", "The arm would "
                         "pull at it.", "Use ", Command("robot retreat"), " or ",
                         Command("robot release"), " first.")
    if cell.tool.gripper == "by_hand":
        progress.warn("The gripper is opened by hand: check that it is open.")


def _motion_summary(motions: list[Trajectory]) -> dict[str, Any]:
    first, last = (present(motions[k].joints, "joints") for k in (0, -1))
    return {"duration_s": sum(motion.duration for motion in motions), "start_joints_rad": first[0],
            "end_joints_rad": last[-1], "pose_count": sum(len(one.times) for one in motions),
            "greatest_speed_m_s": max(float(one.greatest_speeds[0]) for one in motions)}


def log_move(move: ArmedTool, result: dict[str, Any]) -> None:
    """Add a line to the log of this user's robots."""
    from limber.robot.motion.retreat import log_path

    path = log_path()
    path.parent.mkdir(parents=True, exist_ok=True)
    line = {"at": datetime.now(UTC).isoformat(timespec="seconds"),
            "command": move.about.name.rpartition(" ")[2],
            "cell": str(move.cell_file.absolute())} | result
    with open(path, "a", encoding="utf-8") as stream:
        stream.write(json.dumps(plain(line)) + "\n")
