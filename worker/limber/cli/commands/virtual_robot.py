"""Run a UR controller in software, for dry runs and tests; it can hold a branch."""

import tempfile
from pathlib import Path
from typing import Any

import click
import numpy as np

from limber.cli.main import Run, stage_command
from limber.core.errors import Option


@stage_command("virtual-robot")
@click.argument("branch_folder", required=False, type=click.Path(path_type=Path))
@click.option("--cell", "cell_file", type=click.Path(path_type=Path),
              help="Cell file with model, address and base. Required with a branch.")
@click.option("--model", default="ur5e", show_default=True,
              help="ur3, ur5, ur10 (125 Hz), ur3e, ur5e, ur10e, ur16e (500 Hz); or the URDF file "
                   "of another arm with six joints (500 Hz).")
@click.option("--address", default="127.0.0.1", show_default=True,
              help="Loopback address on which the controller listens.")
@click.option("--young", help="True Young's moduli of the branch [Pa], A,B,C,D.")
@click.option("--joints", type=float, nargs=6, help="Initial joint angles [rad].")
@click.option("--seed", default=0, show_default=True, help="Seed of the sensors' noise.")
@click.option("--seconds", type=float, help="End after this time [s]. Default: run until Ctrl-C.")
def command(run: Run, branch_folder: Path | None, cell_file: Path | None, model: str,
            address: str, young: str | None, joints: tuple[float, ...], seed: int,
            seconds: float | None) -> dict[str, Any]:
    """Serve a UR controller on the ports that the real client library uses, loopback only.

    With a branch folder the gripper can hold that branch: its true modulus is --young, its mesh
    differs from the folder's. Force mode, freedrive and contact detection are not supported: an
    unknown command ends the program and is logged.
    """
    from limber.cell.cell_file import read_cell
    from limber.cell.known_arms import arm_named
    from limber.robot.driver.real_time import VIRTUAL_ROBOT_PRIORITY, claim_real_time
    from limber.robot.virtual.controller import Controller
    from limber.robot.virtual.gripped_branch import HeldBranch
    from limber.robot.virtual.launch import serve

    cell = read_cell(cell_file) if cell_file else None
    if cell is not None:
        model, address = cell.robot.model, cell.robot.address
    with tempfile.TemporaryDirectory(prefix="limber-virtual-robot-") as folder:
        load = None
        if branch_folder is not None:
            load = HeldBranch(_setting(branch_folder, cell, young, Path(folder)))
        tool = cell.tool if cell else None
        controller = Controller(
            model, joints=np.array(joints) if joints else None, seed=seed, load=load,
            mass=(tool.mass_kg or 0.0) if tool else 0.0,
            centre=tool.centre_of_mass_m if tool else (0.0, 0.0, 0.0),
            robotiq=tool is not None and tool.gripper == "robotiq",
            ft300=cell.sensor.kind == "ft300" if cell else not arm_named(model).measures_force)
        controller.gripper_output = tool.close_output if tool else 0
        real_time = claim_real_time(VIRTUAL_ROBOT_PRIORITY)
        server = serve(controller, address, seconds=seconds, say=run.say)
    run.close(f"The virtual {controller.arm.name} made {controller.step_count:,} steps; this "
              f"computer delayed it by {server.lost_seconds:.2g} s.")
    return {"model": controller.arm.name, "address": address, "steps": controller.step_count,
            "real_time": real_time, "lost_seconds": server.lost_seconds}


def _setting(branch_folder: Path, cell: Any, young: str | None, folder: Path) -> Any:
    from limber.core.errors import InputError
    from limber.estimation.simulated_pull import PullSpec
    from limber.robot.virtual.branch_solver import BranchSetting
    from limber.stages.pulls.virtual_pull import load_truth
    from limber.store import Branch

    if cell is None:
        raise InputError("A branch was given without a cell file.", "The cell file states where "
                         "the branch is.", "Give ", Option("cell"), " cell.toml.")
    branch = Branch.read(branch_folder)
    moduli = tuple(float(part) for part in young.split(",")) if young else ()
    return BranchSetting.of_truth(load_truth(branch, PullSpec(young=moduli)), cell,
                                  folder / "truth.vtu")
