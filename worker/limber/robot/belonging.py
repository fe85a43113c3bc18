"""Whether a cell, a branch and what was made for them belong together."""

from limber.errors import InputError
from limber.robot.cell import Cell


def check_branch(cell: Cell, uuid: str | None, folder: object) -> str | None:
    """Return a warning where the cell names no branch.

    Raises:
        InputError: the cell was calibrated for another branch.
    """
    if cell.branch is None:
        return ("The cell file names no branch: that its base.pose was calibrated for this one is "
                "taken on trust. `limber robot calibrate` writes it.")
    if cell.branch != uuid:
        raise InputError(f"The cell was calibrated for branch {cell.branch}, {folder} is {uuid}.",
                         "The robot would reach to where another branch stands.",
                         "Calibrate it for this branch: limber robot calibrate.")
    return None
