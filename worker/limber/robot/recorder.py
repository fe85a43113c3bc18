"""A pull during its recording: samples become lines of ``robot.csv``, and are judged."""

import json
import select
import socket
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import Option, WorkError
from limber.core.files.tables import table_line
from limber.core.numerics.rigid import inverted, matrices, pose_vectors
from limber.core.numerics.rigid_kernels import frame_of
from limber.recordings.recording import POSE_COLUMNS, WRENCH_COLUMNS, CalibrationEntry, SensorEntry
from limber.robot.driver.force_test import BLOCK_SECONDS, Block, ForceErrors, ForceTest

_FRAMES_FOR_NOISE = 15
_LEAST_NOISE_M = 1e-4  # a tracker that smooths its points hides their noise


class Lines(Protocol):
    """A destination for lines, such as a stream of the branch folder."""

    def append(self, line: str) -> None:
        """Append one line."""
        ...


class PullRecorder:
    """Writes samples as poses of the grasped piece and the wrench on it: at rest, not rotated, when
    the gripper closes, it then moves with it as one body. ``count`` are written, ``peak_force`` is
    in [N], ``last`` as in :data:`limber.robot.driver.link.COLUMNS`, shape [37]."""

    def __init__(self, lines: Lines, point: np.ndarray, compliance: float = 0.0):
        """Begin a recording of the piece at ``point`` [3], which trails by ``compliance`` [m/N]."""
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
    """Noise of the force sensor's single readings by the cell, and of a tracked point at rest [m];
    None: as is usual."""
    noise = {} if position_sigma is None else {"position_sigma_m": position_sigma}
    return SensorEntry(
        **noise,
        force_sigma_n=cell.sensor.force_sigma_n, torque_sigma_nm=cell.sensor.torque_sigma_nm,
        force_range_n=cell.sensor.force_range_n)


def known_errors(cell: Cell, seconds: float, *, tare_sigma: Sequence[float] | None = None,
                 ) -> CalibrationEntry:
    """Errors of a recording of ``seconds`` [s] that the cell leaves open; ``tare_sigma``: standard
    error of the tare before it [N, N m], shape [6], without which the zero is as uncertain as after
    a tare at some earlier time."""
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
    """Tracked points of another program: JSON lines ``{"t_s", "points_m"}`` over TCP, on the
    robot's clock, in the branch's frame or with ``"frame": "base"`` the robot's, whose pose is
    ``base`` [m, rad]. An unseen point is null; a frame of another number than the first is omitted,
    as it does not say which is which. WorkError if the stream does not answer."""

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
        """Return the frames that have arrived: time [s], points [n, 3] in the branch's frame;
        WorkError if the tracker has closed its connection."""
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
        """Return the mean resting positions so far [m], shape [n, 3], and the standard deviation of
        one coordinate of a frame [m], None for too few. WorkError if no points arrive, one is never
        seen, or their number changes."""
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


# Plausibility of a force sensor, by the first millimetres of a pull and by its end.
#
# A pull measures the stiffness of a branch. The direction of the force is known before: a force
# predicted along one direction does not appear along another, nor with the opposite sign. A sensor
# whose axes are turned about that very direction shows this force correctly; a small nudge across
# the pull is judged in the same way. If the moduli are known already, the force's magnitude is
# predicted as well. If not, its growth still is: one factor scales all of the predicted force. A
# branch that slips slowly in the gripper, or gives way, stops to follow it.

LOOKED_M = 0.01
"""Travel by which a wrong sensor has been detected."""
NUDGE_M, NUDGE_M_S, NUDGE_SECONDS = 0.004, 0.01, 1.0
"""Way, speed and rest at its end of a nudge: a branch of 80 N/m is judged by it with certainty."""

_NOISES = 6.0  # times the noise of a block; less is not significant
_FROM_M = 0.002  # of travel; before that slack and the bark dominate
_BACK_SHARE = 0.15  # fraction of the peak force that may remain when the gripper is back
_RAW, _COLUMNS = slice(7, 10), slice(13, 16)
_REST_M = 2.5e-4  # of travel, during which the branch still rests
_CERTAIN = 5.0  # standard deviations
_ANY_FACTOR, _OTHERWISE = 10.0, 0.05  # deviations: of a pull's factor, and of the rest of its force
_BASE_DEVIATIONS, _AXIS_M = 2.0, 0.002  # of a calibration; error of a scanned axis
_TURNED_RAD, _UNCERTAIN = 0.1, 0.5  # of a model; fraction of its force that it may change
_TURNED_M = 1e-3  # back from the farthest point: the outward motion is over


def off_axis(cell: Cell, gripper: np.ndarray, distance: float) -> str | None:
    """Return a warning if the gripper's middle, branch frame [m], shape [3], is farther from the
    branch's axis than is explained."""
    base = cell.base
    lever = float(np.linalg.norm(gripper - base.pose[:3]))
    explained = _BASE_DEVIATIONS * float(np.hypot(base.position_sigma_m,
                                                  base.rotation_sigma_rad * lever)) + _AXIS_M
    if distance <= explained:
        return None
    return (f"The gripper is {1000 * distance:.1f} mm off the branch's axis; the calibration "
            f"explains {1000 * explained:.1f} mm. If the branch lies in the middle of the jaws, "
            "base.pose or tool.grasp_pose is wrong, and E with it: touch a known point, or "
            "calibrate again.")


def nudge_direction(pull: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
    """Return the unit vector [3] of the softest nudge whose force is across that of a pull [3];
    ``stiffness`` of the held branch [N/m], shape [3, 3]."""
    force = stiffness @ pull
    # Rows that span what is across the pull's force.
    across = np.linalg.svd(force[None])[2][1:]
    compliance = np.linalg.inv(0.5 * (stiffness + stiffness.T))
    softest = np.linalg.eigh(across @ compliance @ across.T)[1][:, -1] @ across
    nudge = compliance @ softest
    return nudge / np.linalg.norm(nudge)


def certain_directions(stiffness: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Return the projection [3, 3] onto directions in which a pull's force can be predicted, by the
    branch's stiffness [N/m] and the way [3]: along itself it is so stiff that a model turned by a
    few degrees predicts another force."""
    force = stiffness @ way
    # The force of the model turned about each axis.
    changes = [np.cross(axis, force) - stiffness @ np.cross(axis, way) for axis in np.eye(3)]
    directions, sizes, _ = np.linalg.svd(_TURNED_RAD * np.column_stack(changes))
    certain = directions[:, sizes < _UNCERTAIN * np.linalg.norm(force)]
    return certain @ certain.T


@dataclass(frozen=True)
class PredictedPull:
    """Forces of the gripper on the branch [N], [n, 3], along its first outward travels [m],
    ascending from 0; ``factor``: by which a force may differ, if the moduli are known; ``certain``:
    as of :func:`certain_directions`, where the direction is judged."""

    travels: np.ndarray
    forces: np.ndarray
    factor: float | None
    certain: np.ndarray = field(default_factory=lambda: np.eye(3))

    def at(self, travel: float | np.ndarray) -> np.ndarray:
        """Return the force at a travel [m], shape [3]; at travels [n], shape [n, 3]."""
        return np.stack([np.interp(travel, self.travels, self.forces[:, k]) for k in range(3)],
                        axis=-1)


class PullPlausibility:
    """Checks the samples of a pull against expected forces as they arrive, by the guard's test;
    ``reason``: why the force cannot be right, once that is certain."""

    def __init__(self, cell: Cell, predicted: PredictedPull):
        self._errors = ForceErrors.of_cell(cell)
        self.predicted = predicted
        # One factor scales all of the prediction: what it is tells no hypothesis, but its value.
        self._test = ForceTest(self._errors, gain=_ANY_FACTOR, unknown=_OTHERWISE)
        self._rows: list[np.ndarray] = []
        self._rest: list[np.ndarray] = []
        self._start = self._last = np.zeros(0)
        self._peak = self._farthest = 0.0
        self.reason: str | None = None

    def take(self, samples: np.ndarray) -> str | None:
        """Judge samples [n, 19 or more], as in :data:`limber.robot.driver.link.COLUMNS`; returns
        why the force cannot be right, or None."""
        for row in samples[np.isfinite(samples[:, _RAW]).all(axis=1)]:
            if not len(self._start):
                self._start = self._last = row
            self._rows.append(row)
            self._peak = max(self._peak, float(np.linalg.norm(row[_COLUMNS])))
            if row[0] - self._last[0] >= BLOCK_SECONDS:
                self._judge(np.mean(self._rows, axis=0), row)
                self._rows, self._last = [], row
        return self.reason

    def _judge(self, mean: np.ndarray, row: np.ndarray) -> None:
        """Judge the mean of a block of samples that ends with ``row``."""
        travel = float(np.linalg.norm(mean[1:4] - self._start[1:4]))
        self._farthest = max(self._farthest, travel)
        if not self._rest or self._farthest < _REST_M:
            self._rest.append(mean[_RAW])
        # On the way back, and where the way is no longer straight, the force is another.
        if (self.reason is not None or travel < self._farthest - _TURNED_M
                or travel > self.predicted.travels[-1] + _TURNED_M):
            return
        step, certain = row[1:4] - self._last[1:4], self.predicted.certain
        predicted = certain @ self.predicted.at(travel)
        self._test.take(Block(
            certain @ (mean[_RAW] - np.mean(self._rest, axis=0)) - predicted, predicted,
            _TURNED_RAD**2 * (predicted @ predicted * np.eye(3) - np.outer(predicted, predicted)),
            frame_of(row[1:7])[:3, :3], np.zeros(3), float(np.linalg.norm(step)),
            float(row[0] - self._last[0])))
        self.reason = self._wrong_factor(travel) or self._test.alarm()

    def _wrong_factor(self, travel: float) -> str:
        factor, sigma = self._test.factor
        least, most = factor - _CERTAIN * sigma, factor + _CERTAIN * sigma
        # Slack of a millimetre counts little over three times that travel.
        known = self.predicted.factor if travel > 3 * _FROM_M else None
        text = ("points against the predicted one: the sensor's sign or pose (sensor.pose) is wrong"
                if most < 0.0 and travel > _FROM_M else
                "is larger than the known moduli allow: the sensor's unit is wrong, or something "
                "stiff is in the way" if known is not None and least > known else
                "is smaller than the known moduli allow: the sensor's unit is wrong, or the branch "
                "is not held" if known is not None and most < 1.0 / known else "")
        return text and f"the force {text} (it grows by {100 * factor:.0f} % of the prediction)"

    def left_at_end(self, samples: np.ndarray) -> str | None:
        """Return in words a force that remains in the last samples [n, 37], back at the start, and
        is not explained by noise, drift and the branch."""
        left = float(np.linalg.norm(samples[:, _COLUMNS].mean(axis=0)))
        drift = self._errors.drift * float(samples[-1, 0] - self._start[0])
        allowed = _NOISES * self._errors.noise + drift + _BACK_SHARE * self._peak
        if not left > allowed:
            return None
        return (f"A force of {left:.2g} N is left where the gripper closed on the resting branch; "
                f"{allowed:.2g} N are explained by noise, drift and the branch. The sensor "
                "drifted, or the branch slipped in the gripper")
