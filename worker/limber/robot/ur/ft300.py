"""A Robotiq FT300: the text stream of its URCap, or Modbus RTU over its USB converter.

The stream has about 100 readings a second, ``( Fx , Fy , Fz , Mx , My , Mz )`` in N and N m. By
Modbus readings come on request, about 70 a second: 19200 baud, 8 data bits, no parity, 1 stop bit,
slave 9. Holding registers 180 to 185 are Fx, Fy, Fz in hundredths of a newton and Mx, My, Mz in
thousandths of a newton metre, signed. Source: Robotiq, "FT 300 instruction manual", Modbus RTU
communication; Modbus application protocol, function 3.
"""

import os
import re
import socket
import struct
import time
from types import ModuleType

import numpy as np

from limber.core.errors import InputError, WorkError

SLAVE, READ, FIRST_REGISTER, COUNT = 9, 3, 180, 6
_SCALE = np.array([100.0, 100.0, 100.0, 1000.0, 1000.0, 1000.0])
_HEAD = bytes([SLAVE, READ, 2 * COUNT])
_LENGTH = len(_HEAD) + 2 * COUNT + 2
_AGAIN_SECONDS = 0.03  # without an answer
_OPEN_SECONDS = 1.0
STREAM_PORT = 63351
_MESSAGE = re.compile(r"\(([^()]*)\)")
_LONGEST = 1000  # characters of a message that has begun


class Ft300Stream:
    """The stream of a robot at ``address``. WorkError if its port does not answer."""

    def __init__(self, address: str):
        try:
            self.connection = socket.create_connection((address, STREAM_PORT), 2.0)
        except OSError as error:
            raise WorkError(f"No FT300 answers at {address} port {STREAM_PORT} ({error}).",
                            "The cell file names it as the force sensor.",
                            "Check its cable and that its URCap is installed, or name another "
                            "sensor in the cell file.") from error
        self.connection.setblocking(False)
        self._text = ""

    def poll(self) -> np.ndarray | None:
        """Return the newest reading that has arrived since the last call, shape [6] in N and N m;
        ConnectionError if the connection was lost."""
        try:
            while chunk := self.connection.recv(65536):
                self._text += chunk.decode("ascii", "replace")
            raise ConnectionError("the FT300 closed the connection")
        except BlockingIOError:
            pass
        whole, end, rest = self._text.rpartition(")")
        self._text = rest[-_LONGEST:]
        readings = map(parsed_message, _MESSAGE.findall(whole + end))
        return next((each for each in reversed(list(readings)) if each is not None), None)

    def close(self) -> None:
        """Close the connection."""
        self.connection.close()


def parsed_message(message: str) -> np.ndarray | None:
    """Return the six numbers of one message (no brackets), or None if it is incomplete."""
    parts = message.split(",")
    if len(parts) != 6:
        return None
    try:
        return np.array([float(part) for part in parts])
    except ValueError:
        return None


def checked(frame: bytes) -> bytes:
    """Return a frame with its checksum (CRC-16 of Modbus, low byte first)."""
    crc = 0xFFFF
    for byte in frame:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
    return frame + struct.pack("<H", crc)


REQUEST = checked(struct.pack(">BBHH", SLAVE, READ, FIRST_REGISTER, COUNT))


class Ft300Line:
    """The serial line to a sensor, such as ``/dev/ttyUSB0``; only opening waits. InputError without
    such lines on this system; WorkError if nothing answers as an FT300."""

    def __init__(self, device: str, seconds: float = _OPEN_SECONDS):
        self.device = device
        terminals = _terminals()
        try:
            self._line = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError as error:
            raise WorkError(f"The FT300's line {device} cannot be opened ({error}).", "",
                            "Check its cable, sensor.device in the cell file, and that your "
                            "account may use it (group dialout).") from error
        self._data, self._asked = b"", 0.0
        try:
            _set_up(terminals, self._line)
            end = time.monotonic() + seconds
            while self.poll() is None:
                if time.monotonic() > end:
                    raise WorkError(f"No FT300 answers on {device} within {seconds:g} s.",
                                    "Its registers were asked for by Modbus.",
                                    "Check that it has power, and that no other program reads it.")
                time.sleep(0.002)
        except BaseException:
            self.close()
            raise

    def poll(self) -> np.ndarray | None:
        """Return a reading that has arrived, shape [6] in N and N m, and ask for the next;
        ConnectionError if the line was lost."""
        try:
            self._data += self._arrived()
            found = self._reading()
            if found is not None or time.monotonic() - self._asked > _AGAIN_SECONDS:
                self._data, self._asked = b"", time.monotonic()
                os.write(self._line, REQUEST)
        except OSError as error:
            raise ConnectionError(f"the FT300's line {self.device} was lost ({error})") from error
        return found

    def _arrived(self) -> bytes:
        try:
            return os.read(self._line, 4096)
        except BlockingIOError:
            return b""

    def _reading(self) -> np.ndarray | None:
        place = self._data.find(_HEAD)
        frame = self._data[place:place + _LENGTH] if place >= 0 else b""
        if len(frame) < _LENGTH or checked(frame[:-2]) != frame:
            return None
        return np.array(struct.unpack_from(f">{COUNT}h", frame, len(_HEAD))) / _SCALE

    def close(self) -> None:
        """Close the line."""
        os.close(self._line)


def _terminals() -> ModuleType:
    try:
        import termios
    except ImportError as error:
        raise InputError("sensor.kind is ft300_usb, but this system has no POSIX serial lines.",
                         "", "Use the sensor's URCap (sensor.kind = \"ft300\"), or Linux or "
                         "macOS.") from error
    return termios


def _set_up(termios: ModuleType, line: int) -> None:
    """Raw bytes at 19200 baud, 8N1."""
    mode = termios.tcgetattr(line)
    mode[0] = mode[1] = mode[3] = 0
    mode[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
    mode[4] = mode[5] = termios.B19200
    termios.tcsetattr(line, termios.TCSANOW, mode)
    termios.tcflush(line, termios.TCIOFLUSH)
