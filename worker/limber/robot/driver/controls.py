"""The registry of drivers: one function that opens each kind of controller."""

from collections.abc import Callable
from contextlib import closing

from limber.cell.cell_file import Cell
from limber.core.errors import Command, InputError, WorkError
from limber.robot.interface import ArmControl
from limber.robot.ros.topics import Topics, is_ros
from limber.robot.ur.factory_calibration import FactoryCalibration, read_calibration
from limber.robot.ur.rtde import Dashboard
from limber.robot.ur.ur_control import UrControl

_JOINTS = 6  # joints for which samples and recordings have columns


def _virtual(cell: Cell) -> ArmControl:
    """Open the virtual robot, which uses the protocol of Universal Robots."""
    if not cell.robot.address.startswith("127."):
        raise InputError(f"{cell.arm.name} has no driver for the controller at robot.address "
                         f"{cell.robot.address}.", "Its URDF file describes the arm, but not the "
                         "controller.", "Use the virtual robot (127.0.0.x), or register a driver.")
    return UrControl(cell)


def _ros(cell: Cell) -> ArmControl:
    """Open the robot behind a rosbridge."""
    from limber.robot.ros.ros_control import RosControl, RosServo

    return (RosControl if Topics.of_cell(cell).output == "trajectory" else RosServo)(cell)


_CONTROLS: dict[str, Callable[[Cell], ArmControl]] = {
    "ur": UrControl, "virtual": _virtual, "ros": _ros}


def _opened(cell: Cell) -> Callable[[Cell], ArmControl] | None:
    """What opens the controller of a cell: of its arm, or the rosbridge at its address."""
    return _CONTROLS.get("ros" if is_ros(cell) else cell.arm.controller)


def register_control(kind: str, opened: Callable[[Cell], ArmControl]) -> None:
    """Register ``opened`` to drive arms whose ``controller`` is ``kind``.

    Args:
        opened: Takes the cell, connects to its controller, and raises if the arm cannot move now.
    """
    _CONTROLS[kind] = opened


def calibration_of(cell: Cell) -> FactoryCalibration | None:
    """Return the dimensions that a cell's controller reports of its arm; None if it reports none.
    """
    if _opened(cell) not in (UrControl, _virtual):
        return None
    return read_calibration(cell.robot.address)


def stop_from_outside(cell: Cell, seconds: float) -> bool:
    """Stop an arm whose driver has ended by its controller's dashboard, connecting for at most
    ``seconds`` [s]; returns whether the stop was sent, as other controllers have no such
    channel."""
    if _opened(cell) not in (UrControl, _virtual):
        return False
    try:
        dashboard = Dashboard(cell.robot.address, seconds)
        try:
            dashboard.stop()
        finally:
            dashboard.close()
    except (WorkError, OSError):
        return False
    return True


def set_payload(cell: Cell) -> None:
    """Set a cell's payload where no driver can put back what it was before, as in ROS, which does
    not report it. LimberError as :func:`control_of`."""
    if is_ros(cell):
        with closing(control_of(cell)) as control:
            control.connect()


def control_of(cell: Cell) -> ArmControl:
    """Open the controller of a cell's arm; nothing moves yet. InputError if no driver is registered
    for its kind, or the joints do not fit the columns of samples; LimberError if it does not
    answer, or its arm cannot be moved."""
    opened = _opened(cell)
    if opened is None:
        raise InputError(f"No driver is registered for controller {cell.arm.controller!r} of the "
                         f"arm {cell.arm.name}.",
                         "Limber can plan for this arm, but cannot move it.",
                         "Register a driver with limber.robot.driver.controls.register_control. "
                         f"Drivers exist for {', '.join(_CONTROLS)}.")
    if len(cell.arm.joint_names) != _JOINTS:
        raise InputError(f"A {cell.arm.name} has {len(cell.arm.joint_names)} joints.", "Samples "
                         f"and recordings of a motion hold exactly {_JOINTS} joints.", "Use it "
                         "only for planning and for the dry run of ", Command("execute"), ".")
    return opened(cell)
