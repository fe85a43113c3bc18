"""Begin a cell file: `limber robot new-cell`."""

import sys
from pathlib import Path
from typing import Any

import click

from limber.cli.main import Run, stage_command

_ASKED = {"model": ("Model of the robot (ur3, ur5, ur10, ur3e, ur5e, ur10e, ur16e)", "ur5e"),
          "address": ("Address of its controller", "127.0.0.1"),
          "gripper": ("Gripper (none, digital_output, robotiq, by_hand)", "by_hand"),
          "mass_kg": ("Mass of the gripper with the sensor [kg]", None),
          "grasp_distance_m": ("Distance from the flange to the middle of the fingers [m]", None)}


@stage_command("new-cell")
@click.argument("cell_file", type=click.Path(path_type=Path))
@click.option("--model", help="Model of the robot, or the URDF file of another arm.")
@click.option("--address", help="Address of its controller.")
@click.option("--gripper", type=click.Choice(["none", "digital_output", "robotiq", "by_hand"]),
              help="How the gripper is moved.")
@click.option("--mass-kg", "mass_kg", type=float, help="Mass of the gripper with the sensor [kg].")
@click.option("--grasp-distance", "grasp_distance_m", type=float, help="Distance from the flange "
              "to the middle of the fingers [m].")
def new_cell(run: Run, cell_file: Path, **given: Any) -> dict[str, Any]:
    """Write a commented cell file with every section, to be filled in.

    Values that no option gives are asked for at a terminal; without one the usual values are used.
    Mass and grasp of a gripper have no usual values: the file then says that they are to be filled
    in. An existing file is not overwritten.
    """
    from limber.cell.cell_file import Cell, SensorEntry, ToolEntry, cell_template, not_stated, slips
    from limber.cell.known_arms import arm_named
    from limber.core.errors import InputError
    from limber.core.files.atomic import write_atomically

    if cell_file.exists():
        raise InputError(f"{cell_file} exists already.", "A cell file is never overwritten.",
                         "Give another name.")
    answers = {name: _answer(name, given[name]) for name in _ASKED}
    sensor = "controller" if arm_named(answers["model"]).measures_force else "ft300"
    mass, distance = _number(answers, "mass_kg"), _number(answers, "grasp_distance_m")
    cell = Cell(robot={"model": answers["model"], "address": answers["address"]},
                base={"pose": (0.6, 0.1, 0.0, 0.0, 0.0, 1.2)}, sensor=SensorEntry(kind=sensor))
    # Not validated together before it is complete.
    cell = cell.model_copy(update={"tool": ToolEntry(
        mass_kg=mass, gripper=answers["gripper"],
        grasp_pose=(0.0, 0.0, distance or 0.0, 0.0, 0.0, 0.0))})
    left = [f"tool.{name}" for name in not_stated(cell)]
    if not left and (wrong := list(slips(cell))):
        raise InputError("; ".join(wrong) + ".", "", "Give other values.")
    write_atomically(cell_file, cell_template(cell))
    if left:
        run.progress.warn(f"{' and '.join(left)} {'are' if len(left) > 1 else 'is'} to be filled "
                          f"in: measure the gripper, and state it in {cell_file}.")
    return {"cell": str(cell_file), "model": cell.arm.name, "sensor": sensor,
            "to_fill_in": left}


def _number(answers: dict[str, Any], name: str) -> float | None:
    """An answer as a number; None where it was left open."""
    from limber.core.errors import InputError

    if answers[name] is None:
        return None
    try:
        return float(answers[name])
    except ValueError as error:
        raise InputError(f"{answers[name]!r} is no number ({_ASKED[name][0]}).", "",
                         "Give a number.") from error


def _answer(name: str, value: Any) -> Any:
    """The given value, else the one typed at a terminal, else the usual one."""
    if value is not None:
        return value
    text, usual = _ASKED[name]
    if not sys.stdin.isatty():
        return usual
    return input(f"{text} [{usual or 'not known yet'}]: ").strip() or usual
