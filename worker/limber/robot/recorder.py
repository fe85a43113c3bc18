"""A pull while it is recorded: samples of the robot become lines of a growing ``robot.csv``."""

import json
import select
import socket
from typing import Protocol

import numpy as np

from limber.errors import WorkError
from limber.recordings.recording import POSE_COLUMNS, WRENCH_COLUMNS
from limber.robot.kinematics import inverted, matrices, pose_vectors

HEADER = ",".join(("t_s", *POSE_COLUMNS, *WRENCH_COLUMNS))


class Lines(Protocol):
    """What lines are appended to, as a stream of the branch folder."""

    def append(self, line: str) -> None:
        """Append one line."""
        ...


class PullRecorder:
    """Writes samples as poses of the grasped piece of branch, and the wrench on it.

    The piece is at its rest pose, not turned, when the gripper closes; from then on it moves with
    the gripper as one body.

    Attributes:
        count: Samples written.
        peak_force: [N].
        last: The last sample taken, shape [37] as in :data:`limber.robot.link.COLUMNS`.
    """

    def __init__(self, lines: Lines, point: np.ndarray):
        self._lines, self._point = lines, np.asarray(point, float)
        self._offset: np.ndarray | None = None
        self.first: float | None = None
        self.count, self.peak_force = 0, 0.0
        self.last: np.ndarray | None = None
        lines.append(HEADER)

    def close_gripper(self) -> None:
        """The gripper has closed at the last sample's pose: rows begin."""
        if self.last is None:
            raise WorkError("No sample of the robot yet.")
        rest = np.eye(4)
        rest[:3, 3] = self._point
        self._offset = inverted(matrices(self.last[1:7])) @ rest

    def take(self, samples: np.ndarray) -> None:
        """Write a batch of samples [n, 37]; before the gripper has closed they only pass by."""
        self.last = samples[-1]
        if self._offset is None:
            return
        if self.first is None:
            self.first = float(samples[0, 0])
        pieces = matrices(samples[:, 1:7]) @ self._offset
        wrench = samples[:, 7:13].copy()
        # The torque about the piece's middle instead of the gripper's.
        wrench[:, 3:] += np.cross(samples[:, 1:4] - pieces[:, :3, 3], wrench[:, :3])
        rows = np.column_stack([samples[:, 0] - self.first, pose_vectors(pieces), wrench])
        for row in rows:
            self._lines.append(",".join("" if np.isnan(x) else f"{x:.7g}" for x in row))
        self.count += len(rows)
        self.peak_force = max(self.peak_force,
                              float(np.nanmax(np.linalg.norm(wrench[:, :3], axis=1))))


class MarkerStream:
    """Tracked points from another program: JSON lines ``{"t_s", "points_m"}`` over TCP.

    Times are on the robot's clock, points in the branch's frame.

    Raises:
        WorkError: nothing answers.
    """

    def __init__(self, address: str, port: int, timeout: float = 3.0):
        try:
            self._socket = socket.create_connection((address, port), timeout)
        except OSError as error:
            raise WorkError(f"No markers come from {address} port {port} ({error}).",
                            "The pull would be recorded blind.",
                            "Start the tracker, or record without --markers.") from error
        self._data = b""

    def read(self, timeout: float = 0.0) -> list[tuple[float, np.ndarray]]:
        """Return the frames that have come: time [s], points [n, 3].

        Raises:
            WorkError: the tracker is gone.
        """
        while select.select([self._socket], [], [], timeout)[0]:
            chunk = self._socket.recv(65536)
            if not chunk:
                raise WorkError("The marker tracker closed its connection.")
            self._data += chunk
            timeout = 0.0
        *lines, self._data = self._data.split(b"\n")
        frames = []
        for line in lines:
            content = json.loads(line)
            frames.append((float(content["t_s"]), np.array(content["points_m"], float)))
        return frames

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()
