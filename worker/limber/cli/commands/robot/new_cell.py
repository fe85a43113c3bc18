"""Begin a cell file: `limber robot new-cell`."""

import sys
from pathlib import Path
from typing import Any, Literal

from limber.cell.cell_file import Cell, SensorEntry, ToolEntry, cell_template, not_stated, slips
from limber.cell.known_arms import arm_named
from limber.core.errors import InputError
from limber.core.files.atomic import write_atomically
from limber.core.progress import SILENT, Progress
from limber.stages.stage import About, Tool, argument, given

_ASKED = {"model": ("Model of the robot (ur3, ur5, ur10, ur3e, ur5e, ur10e, ur16e)", "ur5e"),
          "address": ("Address of its controller", "127.0.0.1"),
          "gripper": ("Gripper (none, digital_output, robotiq, by_hand)", "by_hand"),
          "mass_kg": ("Mass of the gripper with the sensor [kg]", None),
          "grasp_distance": ("Distance from the flange to the middle of the fingers [m]", None)}


class NewCell(Tool):
    """Write a commented cell file with every section, to be filled in.

    Values that no option gives are asked for at a terminal; without one the usual values are used.
    Mass and grasp of a gripper have no usual values: the file then says that they are to be filled
    in. An existing file is not overwritten.
    """

    about = About("robot new-cell")

    cell_file: Path = argument("The cell file to write.")
    model: str | None = given("Model of the robot, or the URDF file of another arm.")
    address: str | None = given("Address of its controller.")
    gripper: Literal["none", "digital_output", "robotiq", "by_hand"] | None = given(
        "How the gripper is moved.")
    mass_kg: float | None = given("Mass of the gripper with the sensor [kg].")
    grasp_distance: float | None = given("Distance from the flange to the middle of the fingers "
                                         "[m].")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        if self.cell_file.exists():
            raise InputError(f"{self.cell_file} exists already.", "A cell file is never "
                             "overwritten.", "Give another name.")
        answers = {name: _answer(name, getattr(self, name)) for name in _ASKED}
        sensor = "controller" if arm_named(answers["model"]).measures_force else "ft300"
        mass, distance = _number(answers, "mass_kg"), _number(answers, "grasp_distance")
        cell = Cell(robot={"model": answers["model"], "address": answers["address"]},
                    base={"pose": (0.6, 0.1, 0.0, 0.0, 0.0, 1.2)}, sensor=SensorEntry(kind=sensor))
        # Not validated together before it is complete.
        cell = cell.model_copy(update={"tool": ToolEntry(
            mass_kg=mass, gripper=answers["gripper"],
            grasp_pose=(0.0, 0.0, distance or 0.0, 0.0, 0.0, 0.0))})
        left = [f"tool.{name}" for name in not_stated(cell)]
        if not left and (wrong := list(slips(cell))):
            raise InputError("; ".join(wrong) + ".", "", "Give other values.")
        write_atomically(self.cell_file, cell_template(cell))
        if left:
            progress.warn(f"{' and '.join(left)} {'are' if len(left) > 1 else 'is'} to be filled "
                          f"in: measure the gripper, and state it in {self.cell_file}.")
        return {"cell": str(self.cell_file), "model": cell.arm.name, "sensor": sensor,
                "to_fill_in": left}


def _number(answers: dict[str, Any], name: str) -> float | None:
    """An answer as a number; None where it was left open."""
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
