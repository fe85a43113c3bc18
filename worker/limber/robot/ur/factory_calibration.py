"""The arm's own dimensions, as its controller reports them: the factory calibration.

A controller of version 3.6 or later sends the corrected Denavit-Hartenberg table once to each
client of its primary interface (port 30001), as subpackage 5 "Kinematics Info" of a robot state
message: per joint a checksum (uint32), then theta, a, d and alpha (double), then the state of the
calibration (uint32), all big-endian. Source: Universal Robots, "Client interface"; the same layout
is read by the maker's ROS driver (primary/robot_state/kinematics_info). Nothing is sent to it.
"""

from __future__ import annotations

import socket
import struct
import time
import zlib
from dataclasses import dataclass, replace

import numpy as np

from limber.cell.arm import Arm
from limber.cell.ur_arms import UrArm

PRIMARY_PORT = 30001
ROBOT_STATE, KINEMATICS = 16, 5

_HEAD = struct.Struct(">iB")  # size with this head, kind
_TABLE = struct.Struct(">6I24dI")
_LONGEST = 1 << 16  # bytes of a message


@dataclass(frozen=True)
class FactoryCalibration:
    """An arm's own Denavit-Hartenberg table: offsets of the angles [rad], lengths along x and z
    [m], twists [rad], shape [6] each, and a checksum per joint, by which two arms differ."""

    theta: np.ndarray
    a: np.ndarray
    d: np.ndarray
    alpha: np.ndarray
    checksums: tuple[int, ...]

    @classmethod
    def of(cls, arm: UrArm) -> FactoryCalibration:
        """Return the calibration of an arm with the lengths of ``arm``."""
        table = arm.table
        checksums = [zlib.crc32(row.tobytes()) for row in table]
        return cls(np.zeros(6), table[:, 1], table[:, 0], table[:, 2], tuple(checksums))

    def forward(self, joints: np.ndarray) -> np.ndarray:
        """Return the flange's frame [4, 4] in the base's at joint angles [6]."""
        frame = np.eye(4)
        for angle, a, d, alpha in zip(joints + self.theta, self.a, self.d, self.alpha, strict=True):
            c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
            frame = frame @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s],
                                      [0.0, sa, ca, d], [0.0, 0.0, 0.0, 1.0]])
        return frame

    def off_nominal(self, arm: Arm, joints: np.ndarray) -> tuple[float, float]:
        """Return how far the flange is from where nominal dimensions put it [m], [rad]."""
        own, nominal = self.forward(joints), arm.forward(joints)
        turned = own[:3, :3].T @ nominal[:3, :3]
        cosine = float(np.clip(0.5 * (np.trace(turned) - 1.0), -1.0, 1.0))
        return float(np.linalg.norm(own[:3, 3] - nominal[:3, 3])), float(np.arccos(cosine))


def one_arm(arm: UrArm, most: float, rng: np.random.Generator) -> UrArm:
    """Return one arm of a series: each of its lengths differs by up to ``most`` [m]."""
    def off(lengths: tuple[float, ...]) -> tuple[float, ...]:
        return tuple(length + most * float(rng.uniform(-1.0, 1.0)) if length else 0.0
                     for length in lengths)
    return replace(arm, d=off(arm.d), a=off(arm.a)) if most > 0.0 else arm


def read_calibration(address: str, seconds: float = 1.0) -> FactoryCalibration | None:
    """Return the calibration of the arm at ``address``; None if its controller does not send it
    within ``seconds`` [s]."""
    end = time.monotonic() + seconds
    data = b""
    try:
        with socket.create_connection((address, PRIMARY_PORT), seconds) as connection:
            while (left := end - time.monotonic()) > 0:
                connection.settimeout(left)
                chunk = connection.recv(65536)
                if not chunk:
                    return None
                data += chunk
                found, data = _taken(data)
                if found is not None:
                    return found
    except (OSError, ValueError):
        # An older controller, a closed port or another server: the calibration is optional.
        return None
    return None


def kinematics_message(calibration: FactoryCalibration) -> bytes:
    """Return the robot state message that carries a calibration, as a controller sends it."""
    table = _TABLE.pack(*calibration.checksums, *calibration.theta, *calibration.a,
                        *calibration.d, *calibration.alpha, 0)
    package = _HEAD.pack(_HEAD.size + len(table), KINEMATICS) + table
    return _HEAD.pack(_HEAD.size + len(package), ROBOT_STATE) + package


def _taken(data: bytes) -> tuple[FactoryCalibration | None, bytes]:
    """The calibration among the complete messages of ``data``, and the bytes left; ValueError if
    these are no messages."""
    while len(data) >= _HEAD.size:
        size, kind = _HEAD.unpack_from(data)
        if not _HEAD.size <= size <= _LONGEST:
            raise ValueError(f"a message of {size} bytes")
        if len(data) < size:
            break
        body, data = data[_HEAD.size:size], data[size:]
        if kind == ROBOT_STATE and (found := _among(body)) is not None:
            return found, data
    return None, data


def _among(body: bytes) -> FactoryCalibration | None:
    """The calibration among the subpackages of a robot state message."""
    while len(body) >= _HEAD.size:
        size, kind = _HEAD.unpack_from(body)
        if not _HEAD.size <= size <= len(body):
            raise ValueError(f"a subpackage of {size} bytes")
        if kind == KINEMATICS and size >= _HEAD.size + _TABLE.size:
            return _of_table(body[_HEAD.size:])
        body = body[size:]
    return None


def _of_table(content: bytes) -> FactoryCalibration | None:
    numbers = _TABLE.unpack_from(content)
    theta, a, d, alpha = np.array(numbers[6:30]).reshape(4, 6)
    if not np.isfinite(numbers[6:30]).all():
        return None
    return FactoryCalibration(theta, a, d, alpha, tuple(numbers[:6]))
