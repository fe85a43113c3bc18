"""A cell's gripper, driven without a control program: it has to open even if nothing else works."""

from limber.cell.cell_file import Cell
from limber.core.errors import InputError
from limber.robot.ur.digital_output import switch_output
from limber.robot.ur.robotiq import HELD_CLOSING, RobotiqGripper


def is_driven(cell: Cell) -> bool:
    """Whether Limber drives the gripper itself."""
    return cell.tool.gripper in ("digital_output", "robotiq")


def drive_gripper(cell: Cell, close: bool) -> None:
    """Close or open the gripper, without waiting until it has.

    Raises:
        InputError: Limber does not drive it. WorkError: it does not answer.
    """
    tool = cell.tool
    if tool.gripper == "robotiq":
        with RobotiqGripper(cell.robot.address) as gripper:
            gripper.drive(close, tool.grip_force)
    elif tool.gripper == "digital_output":
        switch_output(cell.robot.address, tool.close_output, close)
    else:
        raise InputError("Limber does not drive the cell's gripper.",
                         f"tool.gripper is {tool.gripper}.", "Close and open it by hand.")


def holds(cell: Cell) -> bool | None:
    """Return whether something is in the closed jaws; None if the gripper does not tell.

    Raises:
        WorkError: it does not answer, or it moves still.
    """
    if cell.tool.gripper != "robotiq":
        return None
    with RobotiqGripper(cell.robot.address) as gripper:
        return gripper.stopped(cell.tool.grip_seconds) == HELD_CLOSING
