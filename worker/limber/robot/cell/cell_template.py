"""A cell file to fill in: every section and key with its meaning."""

from collections.abc import Iterator
from typing import Any

import tomlkit
from pydantic import BaseModel

from limber.core.json_values import plain
from limber.robot.cell.cell import Cell, ToolEntry

_WRITTEN = ("format_version", "branch", "calibrated")  # by `limber robot calibrate`
_EXAMPLES: dict[str, Any] = {
    "tool": {"grasp_pose": [0.0, 0.0, 0.15, 0.0, 0.0, 0.0], "mass_kg": 0.9,
             "parts": [{"start_m": [0.0, 0.0, 0.0], "end_m": [0.0, 0.0, 0.12],
                        "radius_m": 0.04}]},
    "robot": {"version": "5.11.6", "joint_limits_rad": [[-3.1, 3.1]] * 6},
    "base": {"residual_m": 0.001},
    "sensor": {"file": "forces.csv", "device": "/dev/ttyUSB0",
               "topic": "/ft300/wrench"},
    "camera": {"pose": [0.0, -1.0, 0.5, -1.57, 0.0, 0.0]},
    "second_arm": {"model": "ur5e", "base_pose": [0.6, 0.6, 0.0, 0.0, 0.0, 0.0]},
    "workspace": {"low_m": [-0.4, -0.4, 0.0], "high_m": [0.4, 0.4, 1.2]},
    "obstacles": [{"kind": "box", "name": "table", "size_m": [1.0, 1.0, 0.04],
                   "pose": [0.5, 0.0, -0.02, 0.0, 0.0, 0.0]},
                  {"kind": "mesh", "name": "pot", "file": "pot.stl", "unit": "mm"}]}
"""Values that a user has to replace; they are commented out."""
TO_FILL_IN = ("grasp_pose", "mass_kg")
"""Keys of [tool] for which no value is usual: without them nothing moves."""

_HEAD = """\
# The cell: which robot stands where beside the branch, what it holds, what it must not exceed.
# Lengths in metres, angles in radians, masses in kilograms, forces in newtons. Frames: the branch's
# has z up; the flange's and the base's are those of the controller. Poses are position and rotation
# vector. Lines behind # show what else there is; take the sign away to use them.
#
# Next: limber robot check, then limber robot calibrate, which writes [base].
"""


def cell_template(cell: Cell) -> str:
    """Return the text of a cell file with all sections: what ``cell`` states, and examples."""
    parts = [_HEAD, "format_version = 1\n"]
    for name, entry in type(cell).model_fields.items():
        if name in _WRITTEN:
            continue
        value = getattr(cell, name)
        if name == "obstacles":
            parts += [_obstacle(plain(each), False) for each in value]
            parts += [_obstacle(each, True) for each in _EXAMPLES[name]]
            continue
        kind = _model_of(entry.annotation)
        stated = plain(value) if value is not None else {}
        if name == "tool":
            stated = {key: stated[key] for key in stated if key not in not_stated(cell)}
        lines = "\n".join(_lines(kind, stated, _EXAMPLES.get(name, {}), value is None))
        mark = "# " if value is None else ""
        parts.append(f"# {_first_line(kind)}\n{mark}[{name}]\n{lines}\n")
    return "\n".join(parts)


def not_stated(cell: Cell) -> list[str]:
    """Return the keys of [tool] that a cell with a gripper still has to state."""
    return [] if cell.tool.gripper == "none" else [
        name for name in TO_FILL_IN if getattr(cell.tool, name) == getattr(ToolEntry(), name)]


def _lines(kind: type[BaseModel], stated: dict[str, Any], examples: dict[str, Any],
           is_example: bool) -> Iterator[str]:
    """The keys of a section; those that are not stated are examples, commented out."""
    for name, entry in kind.model_fields.items():
        value, mark = stated.get(name), ""
        if value is None or value == [] or is_example:
            value, mark = examples.get(name, entry.default), "# "
        if entry.description:
            yield f"# {entry.description}"
        if mark and kind is ToolEntry and name in TO_FILL_IN:
            yield "# TO FILL IN, measured at your gripper; the next line is only an example."
        yield f"{mark}{name} = {_written(value)}"


def _obstacle(entry: dict[str, Any], is_example: bool) -> str:
    mark = "# " if is_example else ""
    lines = [f"{mark}{name} = {_written(value)}" for name, value in entry.items()]
    comment = "A box in the way." if entry["kind"] == "box" else "A closed surface in the way."
    return "\n".join([f"# {comment}", f"{mark}[[obstacles]]", *lines]) + "\n"


def _written(value: Any) -> str:
    return tomlkit.item(plain(value), _sort_keys=False).as_string() if not isinstance(
        value, list | tuple) or not any(isinstance(each, dict) for each in value) else (
        "[" + ", ".join(_inline(each) for each in value) + "]")


def _inline(entry: dict[str, Any]) -> str:
    return "{" + ", ".join(f"{key} = {_written(value)}" for key, value in entry.items()) + "}"


def _model_of(annotation: Any) -> type[BaseModel]:
    """The model of a section, also of an optional one."""
    for each in (annotation, *getattr(annotation, "__args__", ())):
        if isinstance(each, type) and issubclass(each, BaseModel):
            return each
    raise TypeError(f"{annotation} is no section")


def _first_line(kind: type[BaseModel]) -> str:
    return (kind.__doc__ or "").strip().split("\n")[0]
