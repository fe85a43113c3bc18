"""Run a UR controller in software, for dry runs and tests; it can hold a branch."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from limber.core.errors import InputError, Option
from limber.core.progress import SILENT, Progress
from limber.stages.stage import About, Tool, argument, given, option


class VirtualRobot(Tool):
    """Serve a UR controller on the ports that the real client library uses, loopback only.

    With a branch folder the gripper can hold that branch: its true modulus is --young, its mesh
    differs from the folder's. With --control it is led by hand, paused or stopped by lines such as
    {"action": "local"} and {"action": "freedrive", "joints": [0, -1.5, 1.5, -1.6, -1.6, 0]}. Force
    mode and contact detection are not supported: an unknown command ends the program and is logged.
    """

    about = About("virtual-robot", where="", found=(
        "The virtual {model} made {steps:,} steps; this computer delayed it by {lost_seconds:.2g} "
        "s.",))

    branch_folder: Path | None = argument("A branch for the gripper to hold.", default=None)
    cell: Path | None = given("Cell file with model, address and base. Required with a branch.")
    model: str = Field("ur5e", description=(
        "Model as in a cell file (ur3, ur5 and ur10: 125 Hz, others: 500 Hz); or the URDF file of "
        "another arm with six joints (500 Hz)."))
    address: str = Field("127.0.0.1", description=(
        "Loopback address on which the controller listens."))
    young: tuple[float, ...] = Field((), description="True Young's moduli of the branch [Pa].")
    joints: tuple[float, float, float, float, float, float] | None = Field(
        None, description="Initial joint angles [rad].")
    seed: int = Field(0, description="Seed of the sensors' noise.")
    control: bool = option(
        "Take actions as JSON lines from standard input, and answer each with the robot's state. "
        "Ends with the input.", False, switch=True)
    seconds: float | None = option("End after this time [s]. Default: run until Ctrl-C.")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.cell.cell_file import read_cell
        from limber.cell.known_arms import arm_named
        from limber.robot.driver.real_time import VIRTUAL_ROBOT_PRIORITY, claim_real_time
        from limber.robot.virtual.controller import Controller
        from limber.robot.virtual.gripped_branch import HeldBranch
        from limber.robot.virtual.launch import serve

        cell, model, address = None, self.model, self.address
        if self.cell is not None:
            cell = read_cell(self.cell)
            model, address = cell.robot.model, cell.robot.address
        with tempfile.TemporaryDirectory(prefix="limber-virtual-robot-") as folder:
            load = None
            if self.branch_folder is not None:
                load = HeldBranch(_setting(self.branch_folder, cell, self.young, Path(folder)))
            tool = cell.tool if cell else None
            controller = Controller(
                model, joints=np.array(self.joints) if self.joints else None, seed=self.seed,
                load=load, mass=(tool.mass_kg or 0.0) if tool else 0.0,
                centre=tool.centre_of_mass_m if tool else (0.0, 0.0, 0.0),
                robotiq=tool is not None and tool.gripper == "robotiq",
                ft300=cell.sensor.kind == "ft300" if cell else not arm_named(model).measures_force)
            controller.gripper_output = tool.close_output if tool else 0
            real_time = claim_real_time(VIRTUAL_ROBOT_PRIORITY)
            server = serve(controller, address, control=self.control, seconds=self.seconds,
                           say=progress.say)
        return {"model": controller.arm.name, "address": address, "steps": controller.step_count,
                "real_time": real_time, "lost_seconds": server.lost_seconds}


def _setting(branch_folder: Path, cell: Any, young: tuple[float, ...], folder: Path) -> Any:
    from limber.estimation.simulated_pull import PullSpec
    from limber.robot.virtual.branch_solver import BranchSetting
    from limber.stages.pulls.virtual_pull import load_truth
    from limber.store import Branch

    if cell is None:
        raise InputError("A branch was given without a cell file.", "The cell file states where "
                         "the branch is.", "Give ", Option("cell"), " cell.toml.")
    branch = Branch.read(branch_folder)
    return BranchSetting.of_truth(load_truth(branch, PullSpec(young=young)), cell,
                                  folder / "truth.vtu")
