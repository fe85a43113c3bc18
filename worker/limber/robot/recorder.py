"""A pull during its recording: samples of the robot become lines of a growing ``robot.csv``."""

import json
import select
import socket
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import Option, WorkError
from limber.core.files.tables import table_line
from limber.core.numerics.rigid import inverted, matrices, pose_vectors
from limber.recordings.recording import POSE_COLUMNS, WRENCH_COLUMNS, CalibrationEntry, SensorEntry

_FRAMES_FOR_NOISE = 15
_LEAST_NOISE_M = 1e-4  # a tracker that smooths its points hides their noise


class Lines(Protocol):
    """A destination for lines, such as a stream of the branch folder."""

    def append(self, line: str) -> None:
        """Append one line."""
        ...


class PullRecorder:
    """Writes samples as poses of the grasped piece of branch, and the wrench on it.

    The piece is at its rest pose, not rotated, when the gripper closes; from then on it moves with
    the gripper as one body.

    Attributes:
        count: Samples written.
        peak_force: [N].
        last: The last sample taken, shape [37] as in :data:`limber.robot.driver.link.COLUMNS`.
    """

    def __init__(self, lines: Lines, point: np.ndarray, compliance: float = 0.0):
        """Begin a recording of the piece at ``point`` [3], which trails by ``compliance`` [m/N].
        """
        self._lines, self._point = lines, np.asarray(point, float)
        self._compliance = compliance
        self._offset: np.ndarray | None = None
        self.first: float | None = None
        self.count, self.peak_force = 0, 0.0
        self.last: np.ndarray | None = None
        lines.append(table_line(("t_s", *POSE_COLUMNS, *WRENCH_COLUMNS)))

    def close_gripper(self) -> None:
        """The gripper has closed at the last sample's pose: rows begin."""
        if self.last is None:
            raise WorkError("No sample from the robot yet.")
        rest = np.eye(4)
        rest[:3, 3] = self._point
        self._offset = inverted(matrices(self.last[1:7])) @ rest

    def take(self, samples: np.ndarray) -> None:
        """Write a batch of samples [n, 37]; before the gripper has closed they are not written."""
        self.last = samples[-1]
        if self._offset is None:
            return
        if self.first is None:
            self.first = float(samples[0, 0])
        pieces = matrices(samples[:, 1:7]) @ self._offset
        pieces[:, :3, 3] -= self._compliance * np.nan_to_num(samples[:, 13:16])
        wrench = samples[:, 7:13].copy()
        # The torque about the piece's middle instead of the gripper's.
        wrench[:, 3:] += np.cross(samples[:, 1:4] - pieces[:, :3, 3], wrench[:, :3])
        rows = np.column_stack([samples[:, 0] - self.first, pose_vectors(pieces), wrench])
        for row in rows:
            self._lines.append(table_line(row, digits=7))
        self.count += len(rows)
        self.peak_force = max(self.peak_force,
                              float(np.nanmax(np.linalg.norm(wrench[:, :3], axis=1))))


def known_noise(cell: Cell, position_sigma: float | None = None) -> SensorEntry:
    """Noise of the force sensor's single readings from the cell, and noise from the points at rest.

    Args:
        position_sigma: Noise of a tracked point [m]; None: as is usual.
    """
    noise = {} if position_sigma is None else {"position_sigma_m": position_sigma}
    return SensorEntry(
        **noise,
        force_sigma_n=cell.sensor.force_sigma_n, torque_sigma_nm=cell.sensor.torque_sigma_nm,
        force_range_n=cell.sensor.force_range_n)


def known_errors(cell: Cell, seconds: float, *, tare_sigma: Sequence[float] | None = None,
                 ) -> CalibrationEntry:
    """Errors of a recording of ``seconds`` [s] that the cell leaves open.

    Args:
        tare_sigma: Standard error of the tare before it [N, N m], shape [6]; without one the zero
            is as uncertain as after a tare at some earlier time.
    """
    usual = CalibrationEntry()
    minutes = seconds / 60.0
    drift = cell.sensor.drift_n_per_minute
    known = {"force_drift_sigma_n": drift * minutes}
    if tare_sigma is not None:
        # It continues to drift while the gripper closes.
        since = drift * (cell.tool.grip_seconds + 1.0) / 60.0
        known |= {"force_bias_sigma_n": float(np.hypot(max(tare_sigma[:3]), since)),
                  "torque_bias_sigma_nm": float(max(tare_sigma[3:]))}
    return usual.model_copy(update={
        "pose_sigma_m": cell.base.position_sigma_m, "pose_sigma_rad": cell.base.rotation_sigma_rad,
        "pose_noise_m": max(cell.robot.pose_sigma_m, 1e-6),
        # A tracker on the robot's base has the base's errors.
        "camera_sigma_m": max(cell.base.position_sigma_m, usual.camera_sigma_m),
        "camera_sigma_rad": max(cell.base.rotation_sigma_rad, usual.camera_sigma_rad), **known})


class MarkerStream:
    """Tracked points from another program: JSON lines ``{"t_s", "points_m"}`` over TCP.

    Times are on the robot's clock. With ``"frame": "base"`` the points are in the robot's base
    frame, else in the branch's. A point that is not seen is null. A frame with another number of
    points than the first is omitted, since it does not state which is which.

    Args:
        base: The robot's base in the branch's frame [m, rad], shape [6].

    Raises:
        WorkError: the stream does not answer.
    """

    def __init__(self, address: str, port: int, base: np.ndarray, timeout: float = 3.0):
        self._base = matrices(np.asarray(base, float))
        try:
            self._socket = socket.create_connection((address, port), timeout)
        except OSError as error:
            raise WorkError(f"No markers arrive from {address} port {port} ({error}).", "The pull "
                            "would be recorded without observations.", "Start the tracker, or "
                            "record without ", Option("markers"), ".") from error
        self._data = b""
        self._count: int | None = None
        self.rejected_count = 0

    def read(self, timeout: float = 0.0) -> list[tuple[float, np.ndarray]]:
        """Return the frames that have arrived: time [s], points [n, 3] in the branch's frame.

        Raises:
            WorkError: the tracker has closed its connection.
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
            points = np.array([[np.nan] * 3 if point is None else point
                               for point in content["points_m"]], float).reshape(-1, 3)
            self._count = len(points) if self._count is None else self._count
            if len(points) != self._count:
                self.rejected_count += 1
                continue
            if content.get("frame") == "base":
                points = points @ self._base[:3, :3].T + self._base[:3, 3]
            frames.append((float(content["t_s"]), points))
        return frames

    def at_rest(self) -> tuple[np.ndarray, float | None]:
        """Return the resting positions of the points so far, and the noise of one of them.

        Returns:
            Mean positions [m], shape [n, 3], and the standard deviation of a coordinate of one
            frame [m], or None if too few frames arrived.

        Raises:
            WorkError: no points arrive, one of them is never seen, or their number changes.
        """
        frames = self.read(1.0)
        if not frames:
            raise WorkError("The tracker sends no points.", "", "Check that it sees the branch.")
        if self.rejected_count:
            raise WorkError(f"The tracker sends {self._count} points, but a different number in "
                            f"{self.rejected_count} of {len(frames) + self.rejected_count} frames.",
                            "So the points cannot be distinguished.",
                            "Make it send null for a point that it does not see.")
        seen = np.array([points for _, points in frames])
        unseen = np.flatnonzero(np.isnan(seen).any(axis=2).all(axis=0))
        if len(unseen):
            raise WorkError(f"The tracker does not see point {', '.join(map(str, unseen))} (from "
                            "0) while the branch rests.", "Its rest position would be unknown.",
                            "Turn the tracker or the branch, or remove the point.")
        means = np.nanmean(seen, axis=0)
        if np.isfinite(seen).all(axis=2).sum(axis=0).min() < _FRAMES_FOR_NOISE:
            return means, None
        return means, max(float(np.sqrt(np.nanvar(seen, axis=0, ddof=1).mean())), _LEAST_NOISE_M)

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()
