"""Commands of a robot's cell: what they have in common."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from limber.stages.stage import Tool, argument, option

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell


class CellTool(Tool):
    """A command of a cell file."""

    cell_file: Path = argument("The robot's cell file.")

    def cell(self) -> Cell:
        """Read the cell; InputError if it is refused."""
        from limber.cell.cell_file import read_cell

        return read_cell(self.cell_file)


class ArmedTool(CellTool):
    """A command that moves the robot, if armed."""

    arm: bool = option("Move the robot. Default: a dry run.", False, switch=True, panel=False)


def confirmed_by(word: str) -> Any:
    """Return the field of the confirmation by a word, else asked for at the terminal."""
    return option(f"The word {word}, to confirm that the robot may move. Default: ask at the "
                  "terminal.", panel=False)
