"""Grippers that open and close on order: Robotiq's by the socket of its URCap, or a digital output.
"""

import re
import socket
import time
from contextlib import closing

from limber.cell.cell_file import Cell
from limber.core.errors import InputError, WorkError
from limber.robot.ur.rtde import SampleStream

# A Robotiq gripper by the socket of its URCap: lines of text on port 63352 of the controller.
#
# ``SET POS 255 SPE 255 FOR 0 GTO 1`` is answered by ``ack``, ``GET POS`` by ``POS 3``. Registers
# are those of the gripper: ACT (activate), GTO (go), POS (0 open, 255 closed), SPE, FOR (0 to 255),
# STA (3: activated), OBJ (0 moving, 1 and 2 stopped by an object while opening or closing, 3 at the
# requested position), FLT (fault, 0 none). Sources: Robotiq, "2F-85 and 2F-140 instruction manual",
# register mapping; the client of the same socket in ur_rtde (robotiq_gripper.cpp, SDU Robotics). It
# works while the arm is stopped: no program is needed.
#
# An activation opens and closes the gripper by itself. It is never done from here: with a branch in
# the jaws that would let it go, or crush it.

ROBOTIQ_PORT = 63352
CLOSED = 255
ACTIVATED, MOVING, HELD_CLOSING = 3, 0, 2

_ANSWER_SECONDS = 0.5
_POLL_SECONDS = 0.02
_VALUE = re.compile(rb"([A-Z]{3}) (\d+)")


class RobotiqGripper:
    """A connection to the gripper at a controller's address, with at most ``seconds`` [s] for an
    answer; a context manager. WorkError if nothing answers, or it is not activated or reports a
    fault."""

    def __init__(self, address: str, seconds: float = _ANSWER_SECONDS):
        self.address = address
        try:
            self._socket = socket.create_connection((address, ROBOTIQ_PORT), seconds)
        except OSError as error:
            raise WorkError(f"No Robotiq gripper answers at {address} port {ROBOTIQ_PORT} "
                            f"({error}).", "The cell file names it as the gripper.",
                            "Check that its URCap is installed, or correct tool.gripper.",
                            ) from error
        self._socket.settimeout(seconds)
        try:
            self._require_ready()
        except WorkError:
            self._socket.close()
            raise

    def __enter__(self) -> "RobotiqGripper":
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def _require_ready(self) -> None:
        if fault := self._get("FLT"):
            raise WorkError(f"The Robotiq gripper reports fault {fault}.", "It may not move.",
                            "See its manual, and activate it on the pendant.")
        if self._get("STA") != ACTIVATED:
            raise WorkError("The Robotiq gripper is not activated.", "Its activation opens and "
                            "closes it, so Limber does not do that.",
                            "Activate it on the pendant, with nothing in the jaws.")

    def drive(self, close: bool, force: float) -> None:
        """Begin to close or open, without waiting, with a share of its greatest force, 0 to 1;
        WorkError without acknowledgement."""
        command = f"SET POS {CLOSED if close else 0} SPE 255 FOR {round(255 * force)} GTO 1"
        if self._asked(command).strip() != b"ack":
            raise WorkError("The Robotiq gripper did not acknowledge its command.", "",
                            "See its status on the pendant.")

    def stopped(self, seconds: float) -> int:
        """Return why it stopped (``OBJ``), waiting at most ``seconds`` [s]; WorkError if it moves
        still."""
        end = time.monotonic() + seconds
        while (why := self._get("OBJ")) == MOVING:
            if time.monotonic() > end:
                raise WorkError(f"The Robotiq gripper still moves after {seconds:g} s.", "",
                                "Raise tool.grip_seconds in the cell file.")
            time.sleep(_POLL_SECONDS)
        return why

    def _get(self, name: str) -> int:
        answer = self._asked(f"GET {name}")
        found = _VALUE.match(answer)
        if found is None or found[1].decode() != name:
            raise WorkError(f"The Robotiq gripper answered {answer!r} instead of {name}.", "",
                            "Check which program listens on this port.")
        return int(found[2])

    def _asked(self, command: str) -> bytes:
        try:
            self._socket.sendall(f"{command}\n".encode())
            answer = self._socket.recv(1024)
        except OSError as error:
            raise WorkError(f"The Robotiq gripper does not answer ({error}).", "",
                            "Check the controller and its URCap.") from error
        if not answer:
            raise WorkError("The Robotiq gripper closed the connection.", "",
                            "Check the controller and its URCap.")
        return answer

    def close(self) -> None:
        """Close the connection; the gripper stays as it is."""
        self._socket.close()


# A digital output of a controller, switched without its control program.
#
# It works while the arm is stopped, and every wait in it has a limit: a gripper has to open even if
# nothing else works.

_SWITCH_SECONDS = 1.0


class _Outputs(SampleStream):
    inputs = ("standard_digital_output_mask", "standard_digital_output")


def switch_output(address: str, number: int, on: bool) -> None:
    """Switch a standard digital output; WorkError without answer, if another program drives the
    outputs, or it did not switch."""
    bit = 1 << number
    stream = _Outputs(address)
    try:
        stream.write({"standard_digital_output_mask": bit,
                      "standard_digital_output": bit if on else 0})
        end = time.monotonic() + _SWITCH_SECONDS
        while time.monotonic() < end:
            for sample in stream.read(0.1):
                if sample.outputs is not None and bool(sample.outputs & bit) == on:
                    return
    except OSError as error:
        raise WorkError(f"The output could not be switched ({error}).", "", "See the pendant."
                        ) from error
    finally:
        stream.close()
    raise WorkError(f"Digital output {number} did not switch within {_SWITCH_SECONDS:g} s.",
                    "Its state as the controller sends it is unchanged.",
                    "Check on the pendant that this output is free for programs.")


def is_driven(cell: Cell) -> bool:
    """Whether Limber drives the gripper itself."""
    return cell.tool.gripper in ("digital_output", "robotiq", "ros")


def drive_gripper(cell: Cell, close: bool) -> None:
    """Close or open the gripper, without waiting until it has. InputError if Limber does not drive
    it; WorkError if it does not answer."""
    tool = cell.tool
    if tool.gripper == "robotiq":
        with RobotiqGripper(cell.robot.address) as gripper:
            gripper.drive(close, tool.grip_force)
    elif tool.gripper == "digital_output":
        switch_output(cell.robot.address, tool.close_output, close)
    elif tool.gripper == "ros":
        from limber.robot.ros.topics import Bridge, grip_by_action

        with closing(Bridge(cell.robot.address)) as bridge:
            grip_by_action(cell, bridge, close)
    else:
        raise InputError("Limber does not drive the cell's gripper.",
                         f"tool.gripper is {tool.gripper}.", "Close and open it by hand.")


def holds(cell: Cell) -> bool | None:
    """Return whether something is in the closed jaws, None if the gripper does not tell; WorkError
    if it does not answer, or moves still."""
    if cell.tool.gripper != "robotiq":
        return None
    with RobotiqGripper(cell.robot.address) as gripper:
        return gripper.stopped(cell.tool.grip_seconds) == HELD_CLOSING
