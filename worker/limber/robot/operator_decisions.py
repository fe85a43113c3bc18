"""Decisions of the person beside the robot: to start, after a stop, to use a hand gripper."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from limber.core.errors import InputError, LimberError, Option, SafetyStop
from limber.robot.driver.link import COLUMNS, RobotLink
from limber.robot.robot_state import show_before_motion
from limber.robot.ur.grippers import drive_gripper, holds, is_driven

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell
    from limber.core.progress import Progress

AfterStop = Literal["ask", "hold", "retreat"]

_FORCE = slice(COLUMNS.index("smooth_fx_n"), COLUMNS.index("smooth_fx_n") + 3)
_FORCE_SECONDS = 1.0
_CONNECTED_SECONDS = 5.0


def require_confirmation(name: str, typed: str | None, cell: Cell, progress: Progress) -> None:
    """Let the robot move only after a person has typed ``name``, asked for at a terminal and after
    the settings of the controller that differ from the cell. InputError if nothing or another text
    was typed; LimberError if the robot does not answer, or cannot be moved."""
    asks = typed is None and sys.stdin.isatty()
    if asks or typed == name:
        show_before_motion(cell, progress.warn)
    if asks:
        typed = input(f"The robot will move. Type {name} to continue: ").strip()
    if typed != name:
        raise InputError("Nobody confirmed that the robot may move.", "",
                         "Give ", Option("confirm", name), ", with the workspace free and a hand "
                         "at the emergency stop.")


def retreat_if_chosen(cell: Cell, link: RobotLink, choice: AfterStop, progress: Progress,
                      ) -> dict[str, Any]:
    """After a stop the arm holds, unless ``choice`` or the person at the terminal is retreat; if
    that leaves the force above the soft limit, the gripper opens. Returns ``choice``,
    ``retreated``, ``gripper_opened``, ``force_n`` left on the branch (None: not known), and
    ``outcome`` in words."""
    if choice == "ask" and sys.stdin.isatty():
        typed = input("The robot has stopped. Type retreat to return along the same path; "
                      "anything else holds: ")
        choice = "retreat" if typed.strip() == "retreat" else "hold"
    decision: dict[str, Any] = {"choice": "hold", "retreated": False, "gripper_opened": False}
    if choice != "retreat":
        decision |= {"force_n": _force_left(link)}
        return decision | {"outcome": f"The arm holds; {_left(decision['force_n'])}."}
    if not link.has_ended:
        found = _gone_back(cell, link, progress)
        if found["retreated"] or not link.has_ended:
            return decision | found
    try:
        # The link's driver has ended. Its path and its tare are on disk.
        with RobotLink(cell) as other:
            other.wait_for_samples(_CONNECTED_SECONDS)
            return decision | _gone_back(cell, other, progress)
    except LimberError as error:
        opened, how = _opened_without_driver(cell)
        return decision | {"choice": "retreat", "gripper_opened": opened, "force_n": None,
                           "outcome":
                           "The arm could not return: its driver has ended, and none could take "
                           f"its place ({str(error).rstrip('.')}); {_left(None)}. {how}."}


def _gone_back(cell: Cell, link: RobotLink, progress: Progress) -> dict[str, Any]:
    """Retreat; if a force above the soft limit remains, open the gripper."""
    event = _retreated(link)
    force = _force_left(link)
    outcome = {"choice": "retreat", "retreated": event["event"] == "reached", "force_n": force}
    went = ("The arm returned along its path" if outcome["retreated"] else
            f"The arm could not return: {event['reason'].rstrip('.')}")
    if outcome["retreated"] and force is not None and force <= cell.limits.soft_force_n:
        return outcome | {"outcome": f"{went}; {_left(force)}."}
    opened, how = _opened(cell, link, progress)
    outcome |= {"gripper_opened": opened, "force_n": _force_left(link)}
    return outcome | {"outcome": f"{went}; {_left(force)}. {how}; {_left(outcome['force_n'])}."}


def _opened_without_driver(cell: Cell) -> tuple[bool, str]:
    """Open the gripper by its output alone; returns whether it opened, and a description."""
    if not is_driven(cell):
        return False, f"Free the branch by hand (tool.gripper is {cell.tool.gripper})"
    try:
        drive_gripper(cell, False)
    except LimberError as error:
        return False, (f"The gripper did not open ({str(error).rstrip('.')}): free the branch by "
                       "hand")
    return True, "The gripper was opened"


def _retreated(link: RobotLink) -> dict[str, Any]:
    """Return the event that ended a retreat; a refusal counts as an immediate stop."""
    try:
        return link.retreat()
    except LimberError as error:
        return {"event": "refused", "reason": str(error)}


def _opened(cell: Cell, link: RobotLink, progress: Progress) -> tuple[bool, str]:
    """Open the gripper; returns whether it opened, and a description."""
    if cell.tool.gripper == "none" or (cell.tool.gripper == "by_hand" and not sys.stdin.isatty()):
        return False, (f"Limber does not open this gripper (tool.gripper is {cell.tool.gripper}): "
                       "free the branch by hand")
    try:
        grip(cell, link, close=False, progress=progress)
    except LimberError as error:
        return False, (f"The gripper did not open ({str(error).rstrip('.')}): free the branch by "
                       "hand")
    return True, "The gripper was opened"


def _force_left(link: RobotLink) -> float | None:
    """The smoothed force on the branch now [N], or None if the driver does not report it."""
    try:
        force = float(np.linalg.norm(link.wait_for_samples(_FORCE_SECONDS)[_FORCE]))
    except LimberError:
        # The driver has ended: its report states so.
        return None
    return force if np.isfinite(force) else None


def _left(force: float | None) -> str:
    return "the force on the branch is unknown" if force is None else (
        f"the force on the branch is {force:.1f} N")


def grip(cell: Cell, link: RobotLink, *, close: bool, progress: Progress) -> None:
    """Close or open the gripper; without a wire, the person at the terminal does it. SafetyStop if
    it closed on nothing, as far as it tells."""
    if is_driven(cell):
        link.gripper(close)
        time.sleep(cell.tool.grip_seconds)
        if close and holds(cell) is False:
            raise SafetyStop("The gripper closed on nothing.", "A pull or a path without the "
                             "branch would be wrong from its first row.",
                             "Move the gripper onto the branch, and open it before.")
    elif cell.tool.gripper == "by_hand" and sys.stdin.isatty():
        input(f"{'Close' if close else 'Open'} the gripper by hand, then press Enter ")
    elif cell.tool.gripper == "by_hand":
        progress.warn(f"The gripper is {'closed' if close else 'opened'} by hand, but there is no "
                      "terminal to ask in, so this was assumed to be done. Run the command in a "
                      "terminal, or state tool.gripper in the cell file.")
