"""Read a robot and compare it with its cell: `limber robot check`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from limber.cli.main import Run, stage_command

if TYPE_CHECKING:
    from limber.robot.cell.cell import Cell
    from limber.robot.robot_state import Observed

_SECONDS = 1.0


@stage_command("check")
@click.argument("cell_file", type=click.Path(path_type=Path))
def check(run: Run, cell_file: Path) -> dict[str, Any]:
    """Read model, version, settings, mode and force, and compare them with the cell.

    The robot does not move, and nothing is written to the controller. Each difference is stated
    with both values. `limber record` and `limber execute` set tool and payload themselves after
    showing them, and restore them.
    """
    from limber.robot.cell.cell import read_cell
    from limber.robot.robot_state import observe

    cell = read_cell(cell_file)
    seen = observe(cell, _SECONDS)
    version = seen.facts.get("version")
    if cell.robot.version and version and cell.robot.version != version:
        run.progress.warn(f"The cell was calibrated with controller version {cell.robot.version}; "
                          f"the controller now has {version}.")
    if seen.program_runs:
        run.progress.warn("A program is running on the controller. It has to be stopped on the "
                          "pendant before a motion.")
    for each in seen.differences:
        run.progress.warn(f"{each}.")
    for warning in seen.implausible(cell):
        run.progress.warn(f"The force sensor: {warning}.")
    computer = _computer(run)
    force = seen.readings[:, :3]
    run.close(f"A {cell.arm.name} with controller version {version} answers at "
              f"{cell.robot.address}; {len(seen.samples) / _SECONDS:.0f} samples a second. "
              "Nothing was moved or written.")
    return seen.facts | computer | {
        "arm": cell.arm.name, "payload_kg": cell.tool.mass_kg, "sensor": cell.sensor.kind,
        "differences": [vars(each) for each in seen.differences],
        "samples_per_second": len(seen.samples) / _SECONDS,
        "force_without_tare_n": force.mean(axis=0), "force_sigma_n": force.std(axis=0),
        "nominal_kinematics_off_m": seen.nominal_off(cell),
        "calibrated_kinematics_off_m": seen.calibrated_off(cell),
        "factory_calibration": _calibration(cell, seen)}


def _calibration(cell: Cell, seen: Observed) -> dict[str, Any] | None:
    """The arm's own dimensions as its controller reports them, and what they change here."""
    own = seen.calibration
    if own is None:
        return None
    off_m, off_rad = own.off_nominal(cell.arm, seen.samples[-1].joints)
    return {"theta_rad": own.theta, "a_m": own.a, "d_m": own.d, "alpha_rad": own.alpha,
            "checksums": own.checksums, "flange_off_nominal_m": off_m,
            "flange_off_nominal_rad": off_rad}


def _computer(run: Run) -> dict[str, bool]:
    """Real-time privileges of the loop that moves a robot."""
    from limber.robot.driver.real_time import claim_real_time, keep_awake, spare_what_is_loaded

    summary = {"real_time": claim_real_time(), "kept_in_memory": spare_what_is_loaded(),
               "kept_awake": keep_awake()}
    if not summary["real_time"]:
        run.progress.warn("The loop has no real-time priority. Other programs can delay it, which "
                          "stops the robot.")
    if not summary["kept_in_memory"]:
        run.progress.warn("The driver's memory is not locked (on Linux `ulimit -l`). Memory that "
                          "was swapped out can delay it, which stops the robot.")
    if not summary["kept_awake"]:
        run.progress.warn("The computer's processors may sleep while idle (on Linux, write access "
                          "to /dev/cpu_dma_latency prevents this). Those of a virtual machine "
                          "wake late, which stops the robot.")
    return summary
