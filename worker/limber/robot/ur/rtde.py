"""The real-time data exchange (RTDE) protocol, version 2, of a controller.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide". A frame is its size (two bytes,
big-endian, itself and the command counted), a command byte and a body.
"""

import select
import socket
import struct
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from limber.core.errors import WorkError
from limber.robot.interface import Sample

VERSION_REQUEST, CONTROL_VERSION = ord("V"), ord("v")
TEXT_MESSAGE, DATA = ord("M"), ord("U")
OUTPUT_SETUP, INPUT_SETUP = ord("O"), ord("I")
START, PAUSE = ord("S"), ord("P")

_FORMATS = {"DOUBLE": "d", "UINT8": "B", "BOOL": "?", "UINT32": "I", "INT32": "i", "UINT64": "Q",
            "VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i", "VECTOR6UINT32": "6I"}
_COUNTS = {"VECTOR3D": 3, "VECTOR6D": 6, "VECTOR6INT32": 6, "VECTOR6UINT32": 6}

_BY_TYPE = {
    "DOUBLE": "timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum "
              "actual_main_voltage actual_robot_voltage actual_robot_current "
              "standard_analog_input0 standard_analog_input1 standard_analog_output0 "
              "standard_analog_output1 io_current tool_analog_input0 tool_analog_input1 "
              "tool_output_current tool_temperature tcp_force_scalar payload "
              "joint_position_deviation_ratio collision_detection_ratio",
    "VECTOR6D": "target_q target_qd target_qdd target_current target_moment actual_q actual_qd "
                "actual_current actual_current_window joint_control_output actual_TCP_pose "
                "actual_TCP_speed actual_TCP_force target_TCP_pose target_TCP_speed "
                "joint_temperatures actual_joint_voltage ft_raw_wrench payload_inertia tcp_offset",
    "VECTOR3D": "actual_tool_accelerometer elbow_position elbow_velocity payload_cog",
    "VECTOR6INT32": "joint_mode",
    "INT32": "robot_mode safety_mode safety_status tool_output_mode time_scale_source "
             "script_control_line",
    "UINT32": "runtime_state robot_status_bits safety_status_bits analog_io_types tool_mode "
              "tool_output_voltage input_bit_registers0_to_31 input_bit_registers32_to_63 "
              "output_bit_registers0_to_31 output_bit_registers32_to_63",
    "UINT64": "actual_digital_input_bits actual_digital_output_bits",
    "UINT8": "tool_digital_output0_mode tool_digital_output1_mode",
}
OUTPUT_TYPES: dict[str, str] = {name: kind for kind, names in _BY_TYPE.items()
                                for name in names.split()}
OUTPUT_TYPES |= {f"output_int_register_{n}": "INT32" for n in range(48)}
OUTPUT_TYPES |= {f"output_double_register_{n}": "DOUBLE" for n in range(48)}
OUTPUT_TYPES |= {f"output_bit_register_{n}": "BOOL" for n in range(64, 128)}

INPUT_TYPES: dict[str, str] = {
    "speed_slider_mask": "UINT32", "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8", "standard_digital_output": "UINT8",
    "configurable_digital_output_mask": "UINT8", "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8", "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8", "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE", "standard_analog_output_1": "DOUBLE",
    "input_bit_registers0_to_31": "UINT32", "input_bit_registers32_to_63": "UINT32",
    "external_force_torque": "VECTOR6D"}
INPUT_TYPES |= {f"input_int_register_{n}": "INT32" for n in range(48)}
INPUT_TYPES |= {f"input_double_register_{n}": "DOUBLE" for n in range(48)}
INPUT_TYPES |= {f"input_bit_register_{n}": "BOOL" for n in range(64, 128)}

# First version of the e-Series and of CB3 that knows a name; it is NOT_FOUND in earlier ones.
_SINCE = {"ft_raw_wrench": ((5, 9), None), "payload": ((5, 11), (3, 15)),
          "payload_cog": ((5, 11), (3, 15)), "payload_inertia": ((5, 11), (3, 15)),
          "script_control_line": ((5, 9), (3, 14)), "tcp_offset": ((5, 23), None),
          "collision_detection_ratio": ((5, 15), None), "time_scale_source": ((5, 17), None),
          "joint_position_deviation_ratio": ((5, 15), None),
          "actual_current_window": ((5, 17), None)}


@dataclass(frozen=True)
class Recipe:
    """A list of names that are sent together, in order."""

    number: int
    names: tuple[str, ...]
    types: tuple[str, ...]
    layout: struct.Struct = field(compare=False)

    @classmethod
    def of(cls, number: int, names: Sequence[str], types: Mapping[str, str]) -> "Recipe":
        kinds = tuple(types[name] for name in names)
        return cls(number, tuple(names), kinds,
                   struct.Struct(">" + "".join(_FORMATS[kind] for kind in kinds)))

    def packed(self, values: Mapping[str, Any]) -> bytes:
        """Return a data frame with the recipe's values; vectors are sequences."""
        flat: list[Any] = []
        for name, kind in zip(self.names, self.types, strict=True):
            value = values[name]
            if kind in _COUNTS:
                flat.extend(value)
            else:
                flat.append(value)
        return frame(DATA, bytes([self.number]) + self.layout.pack(*flat))

    def unpacked(self, body: bytes) -> dict[str, Any]:
        """Return the values of a data frame's body without its recipe number; of a shorter body the
        complete ones, as ur-rtde sends some commands by a recipe with more fields than they have
        arguments."""
        values, offset = {}, 0
        for name, kind in zip(self.names, self.types, strict=True):
            part = struct.Struct(">" + _FORMATS[kind])
            if offset + part.size > len(body):
                break
            numbers = part.unpack_from(body, offset)
            values[name] = numbers if kind in _COUNTS else numbers[0]
            offset += part.size
        return values


def frame(command: int, body: bytes) -> bytes:
    """Return a frame."""
    return struct.pack(">HB", len(body) + 3, command) + body


def split_frames(data: bytearray) -> list[tuple[int, bytes]]:
    """Remove the complete frames from the front of ``data``: command and body of each; ValueError
    for an impossible size, as of no RTDE server."""
    frames = []
    while len(data) >= 3:
        size, command = struct.unpack_from(">HB", data)
        if size < 3:
            raise ValueError(f"a frame of {size} bytes")
        if len(data) < size:
            break
        frames.append((command, bytes(data[3:size])))
        del data[:size]
    return frames


def output_types(names: Sequence[str], version: tuple[int, ...]) -> list[str]:
    """Return the type of each output name, ``NOT_FOUND`` if this version has none."""
    def kind(name: str) -> str:
        e_series, cb3 = _SINCE.get(name, ((5, 0), (3, 0)))
        first = cb3 if version[0] == 3 else e_series
        known = first is not None and version[:2] >= first
        return OUTPUT_TYPES.get(name, "NOT_FOUND") if known else "NOT_FOUND"
    return [kind(name) for name in names]


def input_types(names: Sequence[str], taken: Mapping[str, object], owner: object) -> list[str]:
    """Return the type of each input name; ``IN_USE`` if another connection writes it."""
    return [INPUT_TYPES.get(name, "NOT_FOUND") if taken.get(name, owner) is owner else "IN_USE"
            for name in names]


# State of the robot at one moment, and a reader that misses none.
#
# ur-rtde's own receiver keeps the newest package only, and its getters return the last one for ever
# when the robot is gone. This reader takes the controller's stream from its own socket: every
# package arrives in order, with its time of arrival, and a broken connection is detected.

RTDE_PORT, DASHBOARD_PORT = 30004, 29999
_MOST_AT_ONCE = 8
_NAMES = ("timestamp", "actual_q", "actual_qd", "actual_TCP_pose", "actual_TCP_speed",
          "actual_TCP_force", "robot_mode", "safety_mode", "runtime_state",
          "target_speed_fraction", "actual_digital_output_bits")
_NEWER = ("tcp_offset", "payload", "payload_cog")  # not known to every version


class SampleStream:
    """The RTDE output of the controller at ``address``, read without loss; ``timeout`` [s] holds
    while connecting. WorkError if it does not answer, or is no RTDE server."""

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
        if self._ask(VERSION_REQUEST, struct.pack(">H", 2), timeout) != b"\1":
            raise ValueError("the controller refused protocol version 2")
        self.version = struct.unpack(">4I", self._ask(CONTROL_VERSION, b"", timeout))
        self.rate = 125.0 if self.version[0] <= 3 else 500.0
        names = (*_NAMES, *(name for name in _NEWER if output_types(
            [name], self.version) != ["NOT_FOUND"]))
        reply = self._ask(OUTPUT_SETUP,
                          struct.pack(">d", self.rate) + ",".join(names).encode(), timeout)
        if not reply or reply[0] == 0 or b"NOT_FOUND" in reply:
            raise ValueError(f"outputs refused: {reply[1:].decode('ascii', 'replace')}")
        self._recipe = Recipe.of(reply[0], names, OUTPUT_TYPES)
        if self.inputs:
            reply = self._ask(INPUT_SETUP, ",".join(self.inputs).encode(), timeout)
            if not reply or reply[0] == 0 or b"IN_USE" in reply or b"NOT_FOUND" in reply:
                raise ValueError(f"inputs refused: {reply[1:].decode('ascii', 'replace')}; another "
                                 "program writes them")
            self._input_recipe = Recipe.of(reply[0], self.inputs, INPUT_TYPES)
        if self._ask(START, b"", timeout) != b"\1":
            raise ValueError("the controller did not start the data stream")
        self._socket.setblocking(False)

    def _ask(self, command: int, body: bytes, timeout: float) -> bytes:
        self._socket.sendall(frame(command, body))
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
        self._queue += split_frames(self._data)

    def read(self, timeout: float, beside: Sequence[socket.socket] = ()) -> list[Sample]:
        """Return the next samples, waiting at most ``timeout`` [s] for the first, or until data
        comes ``beside``; after a delay in small batches, so that the caller can act in between.
        ConnectionError if the connection was lost."""
        if not self._queue:
            ready = select.select([self._socket, *beside], [], [], timeout)[0]
            if self._socket in ready:
                try:
                    self._fill()
                except (OSError, ValueError) as error:
                    raise ConnectionError(f"connection to {self.address} lost: {error}") from error
        taken, self._queue = self._queue[:_MOST_AT_ONCE], self._queue[_MOST_AT_ONCE:]
        return [self._sample(body) for kind, body in taken if kind == DATA]

    def write(self, values: Mapping[str, float]) -> None:
        """Send a value for each of :attr:`inputs`; OSError if the connection is broken."""
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
    """The controller's dashboard: its description, and the second channel to stop it; WorkError if
    it does not answer."""

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
        """Return the reply to a command; ConnectionError if there is none."""
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
