"""Which controllers can be driven: one function that opens each kind."""

from collections.abc import Callable

from limber.core.errors import InputError
from limber.robot.cell.cell import Cell
from limber.robot.driver.ur_control import UrControl
from limber.robot.interface import ArmControl

_JOINTS = 6  # of which samples and recordings have columns


def _virtual(cell: Cell) -> ArmControl:
    """The virtual robot, which speaks as a controller of Universal Robots does."""
    if not cell.robot.address.startswith("127."):
        raise InputError(f"{cell.arm.name} has no driver for the controller at robot.address "
                         f"{cell.robot.address}.", "Its URDF file describes the arm, but not the "
                                                   "controller.",
                         "Use the virtual robot (127.0.0.x), or register a driver.")
    return UrControl(cell)


_CONTROLS: dict[str, Callable[[Cell], ArmControl]] = {"ur": UrControl, "virtual": _virtual}


def register_control(kind: str, opened: Callable[[Cell], ArmControl]) -> None:
    """Let arms whose ``controller`` is ``kind`` be driven by what ``opened`` returns.

    Args:
        opened: Takes the cell, finds its controller and refuses one that cannot be moved now.
    """
    _CONTROLS[kind] = opened


def control_of(cell: Cell) -> ArmControl:
    """Open the controller of a cell's arm; nothing moves yet.

    Raises:
        InputError: no driver of this kind of controller is there, or the arm has more joints than
            samples have columns.
        LimberError: it does not answer, or is not in a state to be moved.
    """
    opened = _CONTROLS.get(cell.arm.controller)
    if opened is None:
        raise InputError(f"No driver is registered for controller {cell.arm.controller!r} of the "
                         f"arm {cell.arm.name}.",
                         "Limber can plan for this arm, but cannot move it.",
                         "Register a driver with limber.robot.driver.controls.register_control. "
                         f"Drivers exist for {', '.join(_CONTROLS)}.")
    if len(cell.arm.joint_names) != _JOINTS:
        raise InputError(f"A {cell.arm.name} has {len(cell.arm.joint_names)} joints.",
                         f"Samples and recordings of a motion hold exactly {_JOINTS} joints.",
                         "Use it only for planning and for the dry run of `limber execute`.")
    return opened(cell)
