"""Commands of a robot's cell: what they have in common."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from limber.core.errors import InputError, Option, Text
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


def views_in_turn(count: int) -> Iterator[object]:
    """Return what waits before each view but the first until the camera was moved; InputError
    where several views have no terminal to ask in."""
    if count > 1 and not sys.stdin.isatty():
        raise InputError(Text(Option("views", count), " needs a terminal, and standard input is "
                              "none."), "", "Run it in a terminal, or take one view at a time.")
    return (number and input(f"View {number + 1} of {count}: move the camera, then press Enter ")
            for number in range(count))


def confirmed_by(word: str) -> Any:
    """Return the field of the confirmation by a word, else asked for at the terminal."""
    return option(f"The word {word}, to confirm that the robot may move. Default: ask at the "
                  "terminal.", panel=False)


def require_word(word: str, given: str | None, why: str = "", what: str = "robot") -> None:
    """InputError if the confirmation that something may move is not the ``word``."""
    if given != word:
        raise InputError(f"Nobody confirmed that the {what} may move.", why, "Give ",
                         Option("confirm", word), ", with the workspace free and a hand at the "
                         "emergency stop.")
