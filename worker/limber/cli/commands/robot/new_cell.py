"""Begin a cell file: `limber robot new-cell`."""

import sys
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError

from limber.cell.cell_file import Cell, SensorEntry, ToolEntry, cell_template, not_stated, slips
from limber.cell.known_arms import arm_named
from limber.cell.ur_arms import NAMES
from limber.core.errors import InputError
from limber.core.files.atomic import write_atomically
from limber.core.json_values import refusal_of
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.stages.stage import About, Tool, argument, given

_ASKED = ("model", "address", "sensor", "gripper", "mass_kg", "grasp_distance", "base")
_USUAL: dict[str, Any] = {"model": "ur5e", "address": "127.0.0.1", "gripper": "by_hand",
                          "base": (0.6, 0.1, 0.0, 0.0, 0.0, 1.2)}
_RATED = {"ft300": (300.0, 30.0), "ur3e": (30.0, 10.0), "ur5e": (50.0, 10.0),
          "ur10e": (100.0, 10.0), "ur16e": (160.0, 10.0)}
"""Ranges [N, N m] by the makers' data sheets; other arms have the usual ones of a cell file."""


class NewCell(Tool):
    """Write a commented cell file with every section, to be filled in.

    Values that no option gives are asked for at a terminal; without one the usual values are used.
    Mass and grasp of a gripper have no usual values: the file then says that they are to be filled
    in. An existing file is not overwritten.
    """

    about = About("robot new-cell")

    cell_file: Path = argument("The cell file to write.")
    model: str | None = given(f"Model of the robot ({NAMES}), or the URDF file of another arm.")
    address: str | None = given("Address of its controller.")
    sensor: Literal["controller", "ft300", "ft300_usb", "none"] | None = given(
        "Force-torque sensor. Default: the arm's own, where it has one.")
    gripper: Literal["none", "digital_output", "robotiq", "ros", "by_hand"] | None = given(
        "How the gripper is moved.")
    mass_kg: float | None = given("Mass of the gripper with the sensor [kg].")
    grasp_distance: float | None = given("Distance from the flange to the middle of the fingers "
                                         "[m].")
    base: tuple[float, float, float, float, float, float] | None = Field(
        None, description="Pose of the robot's base in the branch's frame [m, rad], until `limber "
        "robot calibrate` finds it.", json_schema_extra={"metavar": "X Y Z RX RY RZ"})

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        if self.cell_file.exists():
            raise InputError(f"{self.cell_file} exists already.", "A cell file is never "
                             "overwritten.", "Give another name.")
        try:
            told = NewCell(cell_file=self.cell_file,
                           **{name: self._answer(name) for name in _ASKED})
        except ValidationError as error:
            wrong = error.errors()[0]
            raise InputError(f"{wrong['input']!r} is not possible for {wrong['loc'][0]}: "
                             f"{refusal_of(wrong)}.", "", "Give another value.") from error
        arm = arm_named(present(told.model, "model"))
        kind = told.sensor or ("controller" if arm.measures_force else "ft300")
        force, torque = _RATED.get(arm.name if kind == "controller" else kind[:5], (100.0, 10.0))
        cell = Cell(robot={"model": told.model, "address": told.address},
                    base={"pose": told.base}, sensor=SensorEntry(
                        kind=kind, force_range_n=force, torque_range_nm=torque,
                        device="/dev/ttyUSB0" if kind == "ft300_usb" else None))
        # Not validated together before it is complete.
        cell = cell.model_copy(update={"tool": ToolEntry(
            mass_kg=told.mass_kg, gripper=told.gripper,
            grasp_pose=(0.0, 0.0, told.grasp_distance or 0.0, 0.0, 0.0, 0.0))})
        left = [f"tool.{name}" for name in not_stated(cell)]
        if not left and (slipped := list(slips(cell))):
            raise InputError("; ".join(slipped) + ".", "", "Give other values.")
        write_atomically(self.cell_file, cell_template(cell))
        if left:
            progress.warn(f"{' and '.join(left)} {'are' if len(left) > 1 else 'is'} to be filled "
                          f"in: measure the gripper, and state it in {self.cell_file}.")
        return {"cell": str(self.cell_file), "model": cell.arm.name, "sensor": kind,
                "to_fill_in": left}

    def _answer(self, name: str) -> Any:
        """The given value, else the one typed at a terminal, else the usual one."""
        value, usual = getattr(self, name), _USUAL.get(name)
        if value is not None or not sys.stdin.isatty():
            return usual if value is None else value
        about = (type(self).model_fields[name].description or name).rstrip(".")
        typed = input(f"{about} [{usual or 'not known yet'}]: ").strip()
        return (typed.replace(",", " ").split() if name == "base" else typed) or usual
