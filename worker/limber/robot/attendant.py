"""What the person beside the robot decides: that it moves, what follows a stop, a hand gripper."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Literal

from limber.errors import InputError

if TYPE_CHECKING:
    from limber.progress import Progress
    from limber.robot.cell import Cell
    from limber.robot.link import RobotLink

AfterStop = Literal["ask", "hold", "retreat"]


def require_confirmation(name: str, typed: str | None) -> None:
    """Let the robot move only when somebody has typed ``name``; asked for at a terminal.

    Raises:
        InputError: nothing was typed, or something else.
    """
    if typed is None and sys.stdin.isatty():
        typed = input(f"The robot will move. Type {name} to go on: ").strip()
    if typed != name:
        raise InputError("Nobody confirmed that the robot may move.", "",
                         f"Give --confirm {name}, with the workspace free and a hand at the "
                         "emergency stop.")


def retreat_if_chosen(link: RobotLink, choice: AfterStop) -> None:
    """After a stop the arm holds, unless ``choice`` or the person at the terminal says retreat."""
    if choice == "ask" and sys.stdin.isatty():
        typed = input("The robot has stopped. Type retreat to go back the way it came; anything "
                      "else holds: ")
        choice = "retreat" if typed.strip() == "retreat" else "hold"
    if choice == "retreat":
        link.acknowledge()
        link.retreat()


def grip(cell: Cell, link: RobotLink, *, close: bool, progress: Progress) -> None:
    """Close or open the gripper; one without a wire by the person at the terminal."""
    if cell.tool.gripper == "digital_output":
        link.gripper(close)
        time.sleep(cell.tool.grip_seconds)
    elif cell.tool.gripper == "by_hand" and sys.stdin.isatty():
        input(f"{'Close' if close else 'Open'} the gripper by hand, then press Enter ")
    elif cell.tool.gripper == "by_hand":
        progress.warn(f"The gripper is {'closed' if close else 'opened'} by hand, and here nobody "
                      "can be asked to: it was taken as done. Run it at a terminal, or state "
                      "tool.gripper in the cell file.")
