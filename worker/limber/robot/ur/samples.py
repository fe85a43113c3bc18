"""State of the robot at one moment, and a reader that misses none.

ur-rtde's own receiver keeps the newest package only, and its getters return the last one for ever
when the robot is gone. This reader takes the controller's stream from its own socket: every package
arrives in order, with its time of arrival, and a broken connection is detected.
"""

import select
import socket
import struct
import time
from collections.abc import Mapping, Sequence

import numpy as np

from limber.core.errors import WorkError
from limber.robot.interface import Sample
from limber.robot.ur import rtde

RTDE_PORT, DASHBOARD_PORT = 30004, 29999
_MOST_AT_ONCE = 8
_NAMES = ("timestamp", "actual_q", "actual_qd", "actual_TCP_pose", "actual_TCP_speed",
          "actual_TCP_force", "robot_mode", "safety_mode", "runtime_state",
          "target_speed_fraction", "actual_digital_output_bits")
_NEWER = ("tcp_offset", "payload", "payload_cog")  # not known to every version


class SampleStream:
    """The controller's RTDE output, read without loss.

    Args:
        address: Address of the controller.
        timeout: Longest wait for an answer while connecting [s].

    Raises:
        WorkError: the address does not answer, or it is not an RTDE server.
    """

    inputs: tuple[str, ...] = ()
    """Names of RTDE inputs that :meth:`write` sends; a plain stream only reads."""

    def __init__(self, address: str, timeout: float = 2.0):
        self.address = address
        self._data = bytearray()
        self._queue: list[tuple[int, bytes]] = []
        self._arrived = 0.0
        try:
            self._socket = socket.create_connection((address, RTDE_PORT), timeout)
        except OSError as error:
            raise WorkError(f"No robot answers at {address} port {RTDE_PORT} ({error}).",
                            "The robot does not move without its data.",
                            "Check its power, its address and the network.") from error
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._handshake(timeout)
        except (OSError, ValueError) as error:
            self._socket.close()
            raise WorkError(f"{address} port {RTDE_PORT} does not answer as a robot ({error}).",
                            "It accepted the connection, but does not use the RTDE protocol.",
                            "Check the address. If it belongs to a controller, restart the "
                            "controller.") from error

    def _handshake(self, timeout: float) -> None:
        if self._ask(rtde.VERSION_REQUEST, struct.pack(">H", 2), timeout) != b"\1":
            raise ValueError("the controller refused protocol version 2")
        self.version = struct.unpack(">4I", self._ask(rtde.CONTROL_VERSION, b"", timeout))
        self.rate = 125.0 if self.version[0] <= 3 else 500.0
        names = (*_NAMES, *(name for name in _NEWER if rtde.output_types(
            [name], self.version) != ["NOT_FOUND"]))
        reply = self._ask(rtde.OUTPUT_SETUP,
                          struct.pack(">d", self.rate) + ",".join(names).encode(), timeout)
        if not reply or reply[0] == 0 or b"NOT_FOUND" in reply:
            raise ValueError(f"outputs refused: {reply[1:].decode('ascii', 'replace')}")
        self._recipe = rtde.Recipe.of(reply[0], names, rtde.OUTPUT_TYPES)
        if self.inputs:
            reply = self._ask(rtde.INPUT_SETUP, ",".join(self.inputs).encode(), timeout)
            if not reply or reply[0] == 0 or b"IN_USE" in reply or b"NOT_FOUND" in reply:
                raise ValueError(f"inputs refused: {reply[1:].decode('ascii', 'replace')}; another "
                                 "program writes them")
            self._input_recipe = rtde.Recipe.of(reply[0], self.inputs, rtde.INPUT_TYPES)
        if self._ask(rtde.START, b"", timeout) != b"\1":
            raise ValueError("the controller did not start the data stream")
        self._socket.setblocking(False)

    def _ask(self, command: int, body: bytes, timeout: float) -> bytes:
        self._socket.sendall(rtde.frame(command, body))
        end = time.monotonic() + timeout
        while True:
            while self._queue:
                kind, reply = self._queue.pop(0)
                if kind == command:
                    return reply
            left = end - time.monotonic()
            if left <= 0 or not select.select([self._socket], [], [], left)[0]:
                raise ValueError(f"no answer within {timeout:g} s")
            self._fill()

    def _fill(self) -> None:
        chunk = self._socket.recv(65536)
        if not chunk:
            raise ConnectionError("the robot closed the connection")
        self._arrived = time.monotonic()
        self._data += chunk
        self._queue += rtde.split_frames(self._data)

    def read(self, timeout: float, beside: Sequence[socket.socket] = ()) -> list[Sample]:
        """Return the next samples, waiting at most ``timeout`` [s] for the first.

        After a delay they arrive in small batches, so that the caller can act in between.

        Args:
            beside: Other connections: data there ends the wait as well, without samples.

        Raises:
            ConnectionError: the connection to the robot was lost.
        """
        if not self._queue:
            ready = select.select([self._socket, *beside], [], [], timeout)[0]
            if self._socket in ready:
                try:
                    self._fill()
                except (OSError, ValueError) as error:
                    raise ConnectionError(f"connection to {self.address} lost: {error}") from error
        taken, self._queue = self._queue[:_MOST_AT_ONCE], self._queue[_MOST_AT_ONCE:]
        return [self._sample(body) for kind, body in taken if kind == rtde.DATA]

    def write(self, values: Mapping[str, float]) -> None:
        """Send a value for each of :attr:`inputs`.

        Raises:
            OSError: the connection is broken.
        """
        self._socket.sendall(self._input_recipe.packed(values))

    def skip(self) -> None:
        """Drop the data that has arrived so far."""
        while select.select([self._socket], [], [], 0)[0]:
            self._fill()
        self._queue.clear()

    def _sample(self, body: bytes) -> Sample:
        values = self._recipe.unpacked(body[1:])
        return Sample(
            clock=values["timestamp"], arrived=self._arrived, joints=np.array(values["actual_q"]),
            joint_speeds=np.array(values["actual_qd"]), pose=np.array(values["actual_TCP_pose"]),
            speed=np.array(values["actual_TCP_speed"]),
            wrench=np.array(values["actual_TCP_force"]), robot_mode=values["robot_mode"],
            safety_mode=values["safety_mode"], runtime_state=values["runtime_state"],
            slider=values["target_speed_fraction"],
            tool=_array(values.get("tcp_offset")), payload=values.get("payload"),
            payload_centre=_array(values.get("payload_cog")),
            outputs=values["actual_digital_output_bits"])

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


def _array(numbers: Sequence[float] | None) -> np.ndarray | None:
    return None if numbers is None else np.array(numbers)


class Dashboard:
    """The controller's dashboard: its description, and the second channel to stop it.

    Raises:
        WorkError: it does not answer.
    """

    def __init__(self, address: str, timeout: float = 2.0):
        self.address = address
        try:
            self._socket = socket.create_connection((address, DASHBOARD_PORT), timeout)
            self._file = self._socket.makefile("r", encoding="utf-8", errors="replace")
            self._file.readline()
        except OSError as error:
            raise WorkError(f"The dashboard of {address} does not answer ({error}).",
                            "The dashboard is the second way to stop the robot.",
                            "Check the network. The e-Series can disable the dashboard in its "
                            "settings.",
                            ) from error

    def ask(self, command: str) -> str:
        """Return the reply to a command.

        Raises:
            ConnectionError: there is no reply.
        """
        try:
            self._socket.sendall(f"{command}\n".encode())
            return self._file.readline().strip()
        except OSError as error:
            raise ConnectionError(f"dashboard of {self.address}: {error}") from error

    def stop(self) -> None:
        """Send the stop, without waiting."""
        self._socket.sendall(b"stop\n")

    def close(self) -> None:
        """Close the connection."""
        self._file.close()
        self._socket.close()
