"""Force-torque sensors: from a reading to the wrench of the gripper on the branch.

The frames: the controller reports the wrench of the surroundings on the tool, in the base's axes,
about the tool's centre. An FT300 and a replayed file report the same in the sensor's own frame.
The guard and recordings need the opposite: the wrench of the gripper on the branch, about the
grasp's centre, in the branch's frame. A tare removes bias and weight at its orientation. The change
of the gripper's weight with rotation is removed by computation.
"""

import re
import socket
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import InputError, WorkError
from limber.core.numerics.rigid_kernels import frame_of, inverse_of, turned_wrench, weight_wrench
from limber.robot.interface import Sample
from limber.robot.ur.ft300_modbus import Ft300Line

FT300_PORT = 63351
INDEPENDENT_READINGS = 2
"""Least readings in a smoothed wrench: an FT300 sends fewer than a controller requests."""

_MESSAGE = re.compile(r"\(([^()]*)\)")


@dataclass(frozen=True)
class Reading:
    """One reading.

    Attributes:
        wrench: Wrench of the surroundings on the tool, flange axes, about the flange [N, N m],
        shape [6].
        age: [s].
        raw: Numbers as the sensor sent them, shape [6].
    """

    wrench: np.ndarray
    age: float
    raw: np.ndarray


class ForceTorqueSensor(Protocol):
    """A source of readings.

    Attributes:
        connections: Its own connections, over which readings arrive between the robot's samples.
    """

    connections: tuple[socket.socket, ...]

    def read(self, sample: Sample) -> Reading:
        """Return the newest reading at the time of a sample of the robot.

        Raises:
            ConnectionError: the connection to the sensor was lost.
        """
        ...

    def close(self) -> None:
        """Release the sensor."""
        ...


class ControllerSensor:
    """The controller's own wrench at the tool's centre (in CB3 an estimate from currents)."""

    connections = ()

    def __init__(self, cell: Cell):
        self._tool = frame_of(np.array(cell.tool.grasp_pose))

    def read(self, sample: Sample) -> Reading:
        # From the base's axes to the flange's, from the tool's centre to the flange.
        rotation = self._tool[:3, :3] @ frame_of(sample.pose)[:3, :3].T
        return Reading(turned_wrench(rotation, sample.wrench, self._tool[:3, 3]), 0.0,
                       sample.wrench)

    def close(self) -> None:
        """The sample's own connection stays."""


class Ft300Sensor:
    """A Robotiq FT300 by the text stream of its URCap: about 100 readings a second.

    Raises:
        WorkError: the port does not answer.
    """

    def __init__(self, cell: Cell, timeout: float = 2.0):
        self._frame = frame_of(np.array(cell.sensor.pose))
        address = cell.robot.address
        try:
            self._socket = socket.create_connection((address, FT300_PORT), timeout)
        except OSError as error:
            raise WorkError(f"No FT300 answers at {address} port {FT300_PORT} ({error}).",
                            "The cell file names it as the force sensor.",
                            "Check its cable and that its URCap is installed, or name another "
                            "sensor in the cell file.") from error
        self._socket.setblocking(False)
        self.connections = (self._socket,)
        self._text = ""
        self._last: np.ndarray | None = None
        self._arrived = time.monotonic()

    def read(self, sample: Sample) -> Reading:
        try:
            while chunk := self._socket.recv(65536):
                self._text += chunk.decode("ascii", "replace")
            raise ConnectionError("the FT300 closed the connection")
        except BlockingIOError:
            pass
        for message in _MESSAGE.findall(self._text):
            numbers = parsed_message(message)
            if numbers is not None:
                self._last, self._arrived = numbers, time.monotonic()
        self._text = self._text[self._text.rfind("("):] if "(" in self._text else ""
        if _MESSAGE.fullmatch(self._text.strip()):
            self._text = ""
        age = time.monotonic() - self._arrived
        wrench = np.full(6, np.nan) if self._last is None else self._last
        frame = self._frame
        return Reading(turned_wrench(frame[:3, :3], wrench, frame[:3, 3]), age, wrench)

    def close(self) -> None:
        self._socket.close()


class Ft300UsbSensor:
    """A Robotiq FT300 by Modbus over its USB converter: about 70 readings a second.

    Raises:
        LimberError: as :class:`.Ft300Line`.
    """

    connections = ()

    def __init__(self, cell: Cell):
        self._frame = frame_of(np.array(cell.sensor.pose))
        assert cell.sensor.device is not None
        self._line = Ft300Line(cell.sensor.device)
        self._last = np.full(6, np.nan)
        self._arrived = time.monotonic()

    def read(self, sample: Sample) -> Reading:
        found = self._line.poll()
        if found is not None:
            self._last, self._arrived = found, time.monotonic()
        frame = self._frame
        return Reading(turned_wrench(frame[:3, :3], self._last, frame[:3, 3]),
                       time.monotonic() - self._arrived, self._last)

    def close(self) -> None:
        self._line.close()


class ReplayedSensor:
    """Readings from a CSV file: ``t_s`` and six columns, in the sensor's frame.

    Time starts at the first sample.
    """

    connections = ()

    def __init__(self, cell: Cell, path: Path):
        from limber.recordings.time_series import read_stream

        stream = read_stream(path)
        if stream.values.shape[1] < 6:
            raise InputError(f"{path} has {stream.values.shape[1]} columns besides time.",
                             "A wrench has six.", "Give fx, fy, fz, tx, ty, tz.")
        self._frame = frame_of(np.array(cell.sensor.pose))
        self._times, self._values = stream.times - stream.times[0], stream.values[:, :6]
        self._begin: float | None = None

    def read(self, sample: Sample) -> Reading:
        if self._begin is None:
            self._begin = sample.clock
        time_now = sample.clock - self._begin
        row = max(int(np.searchsorted(self._times, time_now, side="right")) - 1, 0)
        age = max(time_now - self._times[row], 0.0)
        frame, wrench = self._frame, self._values[row]
        return Reading(turned_wrench(frame[:3, :3], wrench, frame[:3, 3]), age, wrench)

    def close(self) -> None:
        """Nothing is open."""


def require_sensor(cell: Cell) -> None:
    """Refuse a cell without a force sensor that the guard can rely on.

    Raises:
        InputError: the cell names no sensor, or names a CB3's own estimate, which is no sensor.
    """
    if cell.sensor.kind == "none":
        raise InputError("The cell file names no force sensor.",
                         "The guard does not move a branch that it cannot feel.",
                         "Set sensor.kind to ft300 or controller.")
    if cell.sensor.kind == "controller" and not cell.arm.measures_force:
        raise InputError(f"The cell uses the force of the {cell.arm.name}'s own controller.",
                         "A CB3 estimates it from motor currents, with drifting errors of several "
                         "newtons.",
                         "Mount a force-torque sensor and set sensor.kind to ft300.")


def open_sensor(cell: Cell) -> ForceTorqueSensor:
    """Return the cell's sensor.

    Raises:
        InputError: as :func:`require_sensor`, or the cell names a replay for a real robot.
        WorkError: it does not answer.
    """
    require_sensor(cell)
    if cell.sensor.kind == "replay":
        if not cell.robot.address.startswith("127."):
            raise InputError(f"The cell file replays forces from {cell.sensor.file}, but the "
                             "robot is at "
                             f"{cell.robot.address}.", "The guard would not feel the real "
                             "branch.", "Replay only with the virtual robot (127.0.0.x), or name "
                             "the mounted sensor.")
        return ReplayedSensor(cell, Path(cell.sensor.file))
    if cell.sensor.kind == "ft300_usb":
        return Ft300UsbSensor(cell)
    if cell.sensor.kind == "ft300":
        return Ft300Sensor(cell)
    return ControllerSensor(cell)


@dataclass
class WrenchChain:
    """Tare, weight, range and filter: from readings to the wrench of the gripper on the branch.

    Attributes:
        cell: Gripper's mass, ranges, frames.
        bias, bias_sigma: Bias from the tare, flange frame, and its standard error, shape [6].
        at_rest: Forces during the tare [N], shape [n, 3].
        count: Readings that the slower output averages; its delay is half of them.
    """

    cell: Cell
    count: int = 5
    bias: np.ndarray = field(default_factory=lambda: np.zeros(6))
    bias_sigma: np.ndarray = field(default_factory=lambda: np.zeros(6))
    at_rest: np.ndarray | None = None
    _taring: list[np.ndarray] | None = None
    _recent: deque[np.ndarray] = field(default_factory=deque)

    def __post_init__(self) -> None:
        self._base = frame_of(np.array(self.cell.base.pose))
        self._tool = frame_of(np.array(self.cell.tool.grasp_pose))
        self._from_tool = inverse_of(self._tool)
        self._own_weight = self.cell.sensor.kind != "controller"

    def delay(self, rate: float) -> float:
        """Return the delay of the smoothed wrench [s]."""
        return 0.5 * (self.count - 1) / rate

    def start_tare(self) -> None:
        """Collect readings of the empty, resting gripper."""
        self._taring = []

    def end_tare(self, least: int = 20) -> np.ndarray:
        """Take the mean of the collected readings as bias; returns its standard error [6].

        Raises:
            WorkError: too few readings, or the gripper was touched: their spread exceeds the noise.
        """
        readings, self._taring = np.array(self._taring or []), None
        if len(readings) < least:
            raise WorkError(f"Only {len(readings)} readings arrived for the "
                            "tare.", f"{least} are needed.",
                            "Check the sensor's connection.")
        spread = readings.std(axis=0)
        allowed = np.r_[np.full(3, 6 * self.cell.sensor.force_sigma_n + 0.3),
                        np.full(3, 6 * self.cell.sensor.torque_sigma_nm + 0.05)]
        if np.any(spread > allowed):
            raise WorkError(f"The force spread by {spread[:3].max():.2g} N during the tare.",
                            "The gripper was touched or moved, or the sensor is faulty.",
                            "Let it hang free and at rest, and tare again.")
        self.bias, self.at_rest = readings.mean(axis=0), readings[:, :3]
        self.bias_sigma = spread / np.sqrt(len(readings))
        return self.bias_sigma

    def wrench(self, sample: Sample, reading: Reading) -> tuple[np.ndarray, np.ndarray]:
        """Return the wrench of the gripper on the branch, at once and smoothed, shape [6] each.

        Branch frame, about the grasp's centre. Readings at the end of the sensor's range are
        infinite: the true wrench is larger by an unknown amount.
        """
        flange = frame_of(sample.pose) @ self._from_tool
        raw = reading.wrench - self._weight(flange)
        if self._taring is not None:
            self._taring.append(raw)
        now = self._on_branch(raw, reading, flange)
        self._recent.append(now)
        if len(self._recent) > self.count:
            self._recent.popleft()
        return now, sum(self._recent) / len(self._recent)

    def between(self, sample: Sample, reading: Reading) -> np.ndarray:
        """Return the wrench of a reading that arrived after ``sample``, shape [6], not averaged.
        """
        flange = frame_of(sample.pose) @ self._from_tool
        return self._on_branch(reading.wrench - self._weight(flange), reading, flange)

    def _on_branch(self, raw: np.ndarray, reading: Reading, flange: np.ndarray) -> np.ndarray:
        entry = self.cell.sensor
        if (np.abs(reading.wrench[:3]).max() >= 0.999 * entry.force_range_n
                or np.abs(reading.wrench[3:]).max() >= 0.999 * entry.torque_range_nm):
            # Not rotated: infinity times zero is no number.
            return np.full(6, np.inf)
        rotation = self._base[:3, :3] @ flange[:3, :3]
        lever = -rotation @ self._tool[:3, 3]
        return -turned_wrench(rotation, raw - self.bias, lever)

    def _weight(self, flange: np.ndarray) -> np.ndarray:
        """The gripper's weight if the sensor does not subtract it itself, flange frame."""
        if not self._own_weight:
            return np.zeros(6)
        tool = self.cell.tool
        return weight_wrench(tool.mass_kg or 0.0, np.array(tool.centre_of_mass_m), flange[:3, :3])


def parsed_message(message: str) -> np.ndarray | None:
    """Return the six numbers of one FT300 message (no brackets), or None if it is incomplete."""
    parts = message.split(",")
    if len(parts) != 6:
        return None
    try:
        return np.array([float(part) for part in parts])
    except ValueError:
        return None
