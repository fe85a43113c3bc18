"""Read a robot and compare it with its cell: `limber robot check`."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from limber.cli.cell_tool import CellTool
from limber.core.errors import InputError, Option, Text, WorkError
from limber.core.files.reading import json_content
from limber.core.progress import SILENT, Progress
from limber.stages.stage import About, given, option

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell
    from limber.robot.robot_state import Observed

_SECONDS = 1.0


def _from_files_line(values: Mapping[str, Any]) -> str:
    if not values["offline"]:
        return ""
    plan = values["plan"]
    return (f"{values['cell_file']}: arm {Path(values['arm']).name}; its base is known to "
            f"{1000 * values['base_position_sigma_m']:.1f} mm"
            f"{f', and the arm can follow {plan}' if plan else ''}. No robot was asked.")


class Check(CellTool):
    """Read model, version, settings, mode and force, and compare them with the cell.

    The robot does not move, and nothing is written to the controller. Each difference is stated
    with both values. `limber record` and `limber execute` set tool and payload themselves after
    showing them, and restore them. With --offline only the cell file, its calibration and a plan
    are checked.
    """

    about = About("robot check", found=(
        "A {arm} with controller version {version} answers at {address}; "
        "{samples_per_second:.0f} samples a second. Nothing was moved or written.",
        _from_files_line))

    offline: bool = option("Read files only: no robot is needed.", False, switch=True)
    branch: Path | None = given("Branch folder that the cell must belong to; with --offline.")
    plan: str | None = given("Plan of the branch folder whose motion the arm must be able to "
                             "follow; with --offline.")
    realsense: bool = option("Compare [camera] with the connected RealSense camera too.", False,
                             switch=True)

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.robot.robot_state import unweighed

        if ((self.branch or self.plan) and not self.offline) or (self.plan and self.branch is None):
            raise InputError(
                Text(Option("branch"), " and ", Option("plan"), " are checked from files."),
                "A plan belongs to a branch.", "Give ", Option("offline", True), " ",
                Option("branch"), " FOLDER, and ", Option("plan"), " NAME if you want.")
        cell = self.cell()
        if reason := unweighed(cell):
            progress.warn(f"{reason}. Weigh it before the arm moves a branch (limber robot weigh).")
        camera = _camera(cell, progress) if self.realsense else {}
        return camera | (_from_files(self, cell, progress) if self.offline
                         else _from_robot(cell, progress))


def _from_files(check: Check, cell: Cell, progress: Progress) -> dict[str, Any]:
    """Check a cell, its calibration and a plan without a robot."""
    from limber.cell.cell_file import check_branch
    from limber.cell.obstacles import cell_obstacles
    from limber.robot.ros.topics import Topics, is_ros, wrench_topic
    from limber.stages.paths.execute import ExecutePlan, planned_motion
    from limber.store import Branch

    folder, plan = check.branch, check.plan
    if is_ros(cell):
        Topics.of_cell(cell)
        wrench_topic(cell)
    for text in _not_stated(cell):
        progress.warn(text)
    result: dict[str, Any] = {
        "arm": cell.arm.name, "obstacles": len(cell_obstacles(cell, check.cell_file.parent)),
        "base_position_sigma_m": cell.base.position_sigma_m,
        "base_rotation_sigma_rad": cell.base.rotation_sigma_rad,
        "calibration_residual_m": cell.base.residual_m}
    if plan is None and folder is not None and (
            warning := check_branch(cell, Branch.read(folder).uuid, folder)):
        progress.warn(warning)
    if plan is not None and folder is not None:
        planned = planned_motion(
            ExecutePlan(branch_folder=folder, name=plan, cell=check.cell_file, unwatched=True),
            progress, is_to_move=True)
        result |= {"plan": plan, "motion": planned.result}
    return result


def _not_stated(cell: Cell) -> list[str]:
    """What a cell file leaves open, and what that means."""
    tool = cell.tool
    return [text for is_so, text in (
        (cell.base.residual_m is None, "base.pose was not calibrated by Limber. It is believed "
         f"within {1000 * cell.base.position_sigma_m:.1f} mm (limber robot calibrate)."),
        (cell.branch is None, "The cell names no branch, so it is taken for each one."),
        (tool.mass_kg is None, "tool.mass_kg is not stated. No motion starts without it."),
        (not any(tool.grasp_pose[:3]) and tool.gripper != "none",
         "tool.grasp_pose is not stated: the flange itself would go to the branch."),
        (tool.mass_kg and not any(tool.centre_of_mass_m),
         "tool.centre_of_mass_m is not stated, so the gripper's weight counts as if it were in the "
         "flange; its torque is then taken for one of the branch."),
        (not tool.parts,
         "tool.parts is empty, so the gripper itself is not checked against obstacles."),
        (not cell.obstacles, "No obstacle is stated: nothing but the branch is avoided."),
    ) if is_so]


def _camera(cell: Cell, progress: Progress) -> dict[str, Any]:
    """Compare the connected camera with the cell's."""
    from limber.robot.depth_camera import RealSense, camera_differences

    with RealSense() as camera:
        differences = camera_differences(cell, camera.camera)
    for each in differences:
        progress.warn(f"{each}.")
    return {"camera_differences": differences}


def _from_robot(cell: Cell, progress: Progress) -> dict[str, Any]:
    from limber.robot.robot_state import observe

    try:
        seen = observe(cell, _SECONDS)
    except WorkError as error:
        raise WorkError(error.seen, error.why, error.fix, " With ", Option("offline", True),
                        " the files are checked without a robot.") from error
    version = seen.facts.get("version")
    if cell.robot.version and version and cell.robot.version != version:
        progress.warn(f"The cell was calibrated with controller version {cell.robot.version}; "
                      f"the controller now has {version}.")
    if seen.is_busy(cell):
        progress.warn("A program is running on the controller. It has to be stopped on the "
                      "pendant before a motion.")
    for each in seen.differences:
        progress.warn(f"{each}.")
    for warning in seen.implausible(cell):
        progress.warn(f"The force sensor: {warning}.")
    force = seen.readings[:, :3]
    return seen.facts | _computer(progress) | {
        "arm": cell.arm.name, "address": cell.robot.address,
        "payload_kg": cell.tool.mass_kg, "sensor": cell.sensor.kind,
        "differences": [vars(each) for each in seen.differences],
        "samples_per_second": len(seen.samples) / _SECONDS,
        "force_without_tare_n": force.mean(axis=0), "force_sigma_n": force.std(axis=0),
        "nominal_kinematics_off_m": seen.nominal_off(cell),
        "calibrated_kinematics_off_m": seen.calibrated_off(cell),
        "factory_calibration": _calibration(cell, seen)}


def _calibration(cell: Cell, seen: Observed) -> dict[str, Any] | None:
    """The arm's own dimensions as its controller reports them, and what they change here."""
    if (own := seen.calibration) is None:
        return None
    off_m, off_rad = own.off_nominal(cell.arm, seen.samples[-1].joints)
    return {"theta_rad": own.theta, "a_m": own.a, "d_m": own.d, "alpha_rad": own.alpha,
            "checksums": own.checksums, "flange_off_nominal_m": off_m,
            "flange_off_nominal_rad": off_rad}


def _computer(progress: Progress) -> dict[str, bool]:
    """Real-time privileges of the loop that moves a robot, asked for by a process of its own: a
    program that runs this command would keep the priority, and its memory locked."""
    told = subprocess.run([sys.executable, "-m", "limber.robot.driver.real_time"],
                          capture_output=True, text=True, check=True).stdout
    summary = json_content(told, "the loop's process", "its privileges")
    for name, text in (
            ("real_time", "The loop has no real-time priority. Other programs can delay it"),
            ("kept_in_memory", "The driver's memory is not locked (on Linux `ulimit -l`). Memory "
             "that was swapped out can delay it"),
            ("kept_awake", "The computer's processors may sleep while idle (on Linux, write access "
             "to /dev/cpu_dma_latency prevents this). Those of a virtual machine wake late")):
        if not summary[name]:
            progress.warn(f"{text}, which stops the robot.")
    return summary
