"""Begin a cell file: `limber robot new-cell`."""

import sys
from pathlib import Path
from typing import Any

import click

from limber.cli.main import Run, stage_command

_ASKED = {"model": ("Model of the robot (ur3, ur5, ur10, ur3e, ur5e, ur10e, ur16e)", "ur5e"),
          "address": ("Address of its controller", "127.0.0.1"),
          "mass_kg": ("Mass of the gripper [kg]", "0.9"),
          "gripper": ("Gripper (none, digital_output, robotiq, by_hand)", "by_hand")}


@stage_command("new-cell")
@click.argument("cell_file", type=click.Path(path_type=Path))
@click.option("--model", help="Model of the robot, or the URDF file of another arm.")
@click.option("--address", help="Address of its controller.")
@click.option("--mass-kg", "mass_kg", type=float, help="Mass of the gripper [kg].")
@click.option("--gripper", type=click.Choice(["none", "digital_output", "robotiq", "by_hand"]),
              help="How the gripper is moved.")
def new_cell(run: Run, cell_file: Path, **given: Any) -> dict[str, Any]:
    """Write a commented cell file with every section, to be filled in.

    Values that no option gives are asked for at a terminal; without one the usual values are used.
    An existing file is not overwritten.
    """
    from limber.core.errors import InputError
    from limber.core.files.atomic import write_atomically
    from limber.robot.cell.cell import Cell, SensorEntry, read_cell
    from limber.robot.cell.cell_template import cell_template
    from limber.robot.known_arms import arm_named

    if cell_file.exists():
        raise InputError(f"{cell_file} exists already.", "A cell file is never overwritten.",
                         "Give another name.")
    answers = {name: _answer(name, value) for name, value in given.items()}
    sensor = "controller" if arm_named(answers["model"]).measures_force else "ft300"
    try:
        mass = float(answers["mass_kg"])
    except ValueError as error:
        raise InputError(f"{answers['mass_kg']!r} is no mass.", "", "Give a number in kg.",
                         ) from error
    cell = Cell(robot={"model": answers["model"], "address": answers["address"]},
                base={"pose": (0.6, 0.1, 0.0, 0.0, 0.0, 1.2)},
                tool={"mass_kg": mass, "gripper": answers["gripper"]},
                sensor=SensorEntry(kind=sensor))
    write_atomically(cell_file, cell_template(cell))
    read_cell(cell_file)
    return {"cell": str(cell_file), "model": cell.arm.name, "sensor": sensor}


def _answer(name: str, value: Any) -> Any:
    """The given value, else the one typed at a terminal, else the usual one."""
    if value is not None:
        return value
    text, usual = _ASKED[name]
    if not sys.stdin.isatty():
        return usual
    return input(f"{text} [{usual}]: ").strip() or usual
