"""Checks that a cell, a branch and the files made for them belong together."""

from typing import Any

import numpy as np

from limber.core.errors import InputError
from limber.robot.cell.cell import Cell

_SAME_M, _SAME_RAD = 1e-3, 5e-3


def require_payload(cell: Cell) -> None:
    """Refuse to move an arm whose payload is not stated.

    Raises:
        InputError: the cell does not state the gripper's mass.
    """
    if cell.tool.mass_kg is None:
        raise InputError("The cell file does not state tool.mass_kg, so the payload is not set.",
                         "The controller and the guard would interpret the gripper's weight as a "
                         "force on it.", "Weigh the gripper and state its mass; 0 for a "
                                                "bare flange.")


def check_plan(made_for: dict[str, Any] | None, cell: Cell) -> str | None:
    """Return a warning if a plan was made without a robot's cell.

    Args:
        made_for: What the plan's file states about its robot.

    Raises:
        InputError: it was made for another robot, another branch or another pose of the base.
    """
    if not made_for:
        return ("The plan was made without a cell (`limber plan --cell`), so obstacles and the "
                "gripper's shape were not checked.")
    if made_for.get("model") != cell.arm.name:
        raise InputError(f"The plan was made for a {made_for.get('model')}, but the cell has a "
                         f"{cell.arm.name}.", "The two arms differ in reach.",
                         "Plan again with this cell.")
    if made_for.get("branch") not in (None, cell.branch):
        raise InputError(f"The plan was made with a cell of branch {made_for['branch']}, but this "
                         "cell belongs to branch "
                         f"{cell.branch}.", "The robot would move to the position of another "
                         "branch.", "Plan again with this cell.")
    base = made_for.get("base_pose")
    if base is not None:
        off = np.abs(np.array(base, float) - np.array(cell.base.pose))
        if off[:3].max() > _SAME_M or off[3:].max() > _SAME_RAD:
            raise InputError(
                f"The plan was made with the robot's base {1e3 * off[:3].max():.1f} mm and "
                f"{np.degrees(off[3:].max()):.2f} degrees away from its pose in the cell file.",
                "The cell was calibrated again after planning, so reach and obstacles have "
                "changed.",
                "Plan again with this cell.")
    return None


def check_branch(cell: Cell, uuid: str, folder: object) -> str | None:
    """Return a warning if the cell names no branch.

    Raises:
        InputError: the cell was calibrated for another branch.
    """
    if cell.branch is None:
        return ("The cell file names no branch, so it is assumed that base.pose was calibrated "
                "for this one. `limber robot calibrate` writes the name.")
    if cell.branch != uuid:
        raise InputError(f"The cell was calibrated for branch {cell.branch}, but {folder} is "
                         f"branch {uuid}.",
                         "The robot would move to the position of another branch.",
                         "Calibrate it for this branch: limber robot calibrate.")
    return None
