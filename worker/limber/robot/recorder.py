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
from limber.recordings.recording import POSE_COLUMNS, WRENCH_COLUMNS, CalibrationEntry, SensorEntry

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
"""Way, speed and rest at its end of a nudge: a branch of 50 N/m is judged by it with certainty."""

_NOISES = 4.0  # times the noise of a smoothed force; less is not significant
_MOSTLY = 0.5  # cosine of the angle to the predicted force
_FROM_M = 0.002  # of travel; before that slack and the bark dominate
_BACK_SHARE = 0.15  # fraction of the peak force that may remain when the gripper is back
_SMOOTHED = 3  # fewest readings in a smoothed force
_RAW, _COLUMNS = slice(7, 10), slice(13, 16)
_BIN_M, _MOVED_M = 2.5e-4, 1e-6
_RECENT_M = (0.002, 0.003, 0.004, 0.006, 0.008, 0.012, 0.02)  # over which the force's growth is
_RECENT_SHARE = 0.2  # measured, and of the whole travel at least: a stop relaxes the wood
_SLIPS = 0.5  # of the growth before: less is a slip
_CERTAIN = 5.0  # standard deviations
_LARGER = ("the force is larger than the known moduli allow: the sensor's unit is wrong, or "
           "something stiff is in the way")
_SMALLER = ("the force is smaller than the known moduli allow: the sensor's unit is wrong, or the "
            "branch is not held")
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


class _Growth:
    """The growth of a force along the predicted one, now and before, over bins of travel up to
    ``end`` [m], so that a long pull takes no longer to judge; ``noise`` of a single reading [N]."""

    def __init__(self, noise: float, end: float):
        self._noise = noise
        # Of each bin: count, and sums of the predicted force, the measured one, and their products.
        self._sums = np.zeros((int(end / _BIN_M) + 1, 5))
        self._farthest = 0.0
        self._is_over = False

    def take(self, travels: np.ndarray, predicted: np.ndarray, measured: np.ndarray) -> None:
        """Take ``predicted`` forces [N] at travels [m], and those measured along them, shape [n]
        each."""
        farthest = np.maximum.accumulate(np.r_[self._farthest, travels])[1:]
        back = np.flatnonzero(travels < farthest - _TURNED_M)
        out = len(travels) if not len(back) else int(back[0])
        if self._is_over or not len(travels):
            return
        self._is_over = out < len(travels)
        self._farthest = float(farthest[-1])
        bins = (travels[:out] / _BIN_M).astype(int)
        rows = np.column_stack([np.ones(len(travels)), predicted, measured,
                                predicted * predicted, predicted * measured])
        known = bins < len(self._sums)
        np.add.at(self._sums, bins[known], rows[:out][known])

    def slip(self) -> tuple[float, float] | None:
        """Return how much of the predicted growth the force has now over that before, and the
        travel [m] over which; None if it grows on, or noise explains it."""
        end = min(int(self._farthest / _BIN_M), len(self._sums))
        if self._is_over or not self._sums[0, 0]:
            return None
        for recent in _RECENT_M:
            first = end - int(recent / _BIN_M)
            if first * _BIN_M < _FROM_M:
                return None
            if recent < _RECENT_SHARE * self._farthest:
                continue
            before, sigma = self._whole(self._sums[1:first].sum(axis=0))
            now, sigma_now = self._slope(self._sums[first:end].sum(axis=0))
            missing = _SLIPS * before - now
            if missing > _CERTAIN * float(np.hypot(_SLIPS * sigma, sigma_now)):
                return now / before, recent
        return None

    def whole(self) -> tuple[float, float] | None:
        """Return the growth per predicted newton since the start, and its deviation; None over too
        short a travel."""
        # Slack of a millimetre is then less than a factor two.
        if self._farthest < 1.5 * _FROM_M or not self._sums[0, 0]:
            return None
        return self._whole(self._sums[1:].sum(axis=0))

    def _slope(self, sums: np.ndarray) -> tuple[float, float]:
        """Growth of the force per predicted newton, and its standard deviation."""
        count, predicted, measured, square, product = sums
        spread = square - predicted * predicted / max(count, 1.0)
        if not spread > 0.0:
            return 0.0, np.inf
        slope = (product - predicted * measured / count) / spread
        return slope, self._noise / float(np.sqrt(spread))

    def _whole(self, sums: np.ndarray) -> tuple[float, float]:
        """The same since the start, where the first bin's force is that of the resting branch."""
        _, predicted, _, square, product = sums
        first, rest = self._sums[0, 0], self._sums[0, 2] / self._sums[0, 0]
        if not square > 0.0:
            return 0.0, np.inf
        sigma = self._noise * float(np.sqrt(1.0 / square + (predicted / square) ** 2 / first))
        return (product - rest * predicted) / square, sigma


class _Direction:
    """The direction in which a force grows, against the predicted one; ``noise`` of a reading
    [N]."""

    def __init__(self, noise: float):
        self._noise = noise
        self._rest_count, self._rest = 0, np.zeros(3)
        # Sums: predicted magnitudes, their squares, and products of the measured force with the
        # magnitudes and with the predicted forces.
        self._size = self._square = self._along = 0.0
        self._predicted, self._measured = np.zeros(3), np.zeros(3)

    def take(self, travels: np.ndarray, predicted: np.ndarray, measured: np.ndarray) -> None:
        """Take readings and predictions [N], shape [n, 3] each, at travels [m], shape [n]."""
        rests = travels < _BIN_M
        self._rest_count += int(rests.sum())
        self._rest += measured[rests].sum(axis=0)
        used = (travels >= _FROM_M) & (travels <= LOOKED_M)
        predicted, measured = predicted[used], measured[used]
        sizes = np.linalg.norm(predicted, axis=1)
        self._size += float(sizes.sum())
        self._square += float((sizes**2).sum())
        self._along += float((measured * predicted).sum())
        self._predicted += predicted.sum(axis=0)
        self._measured += sizes @ measured

    def suspicion(self) -> str | None:
        """Return why the direction cannot be right; None if noise explains it."""
        if not self._rest_count or not self._square > 0.0:
            return None
        rest = self._rest / self._rest_count
        along = (self._along - rest @ self._predicted) / self._square
        size = float(np.linalg.norm(self._measured - rest * self._size)) / self._square
        sigma = self._noise * float(np.sqrt(
            1.0 / self._square + (self._size / self._square) ** 2 / self._rest_count))
        if along + _CERTAIN * sigma >= _MOSTLY * size:
            return None
        angle = np.degrees(np.arccos(np.clip(along / size, -1.0, 1.0)))
        angle_text = f"it grows at {angle:.0f} degrees to it"
        if along < -_MOSTLY * size:
            return ("the force points against the predicted one: the sensor's sign or pose "
                    f"(sensor.pose) is wrong ({angle_text})")
        return ("the force lies across the predicted one: the sensor's axes or pose (sensor.pose) "
                f"are wrong, or another part is pulled ({angle_text})")


class PullPlausibility:
    """Checks the samples of a pull against expected forces as they arrive, by the cell's noise and
    drift; ``reason``: why the sensor cannot be right, once that is certain."""

    def __init__(self, cell: Cell, predicted: PredictedPull):
        self._noise = _NOISES * cell.sensor.force_sigma_n / np.sqrt(_SMOOTHED)
        self._drift = cell.sensor.drift_n_per_minute / 60.0
        self.predicted = predicted
        self._direction = _Direction(cell.sensor.force_sigma_n)
        self._growth = _Growth(cell.sensor.force_sigma_n, float(predicted.travels[-1]))
        self._start: np.ndarray | None = None
        self._began = self._peak = 0.0
        self.reason: str | None = None

    def take(self, samples: np.ndarray) -> str | None:
        """Judge samples [n, 19 or more], as in :data:`limber.robot.driver.link.COLUMNS`; returns
        why the sensor cannot be right, or None."""
        if self._start is None:
            self._start, self._began = samples[0, 1:4].copy(), float(samples[0, 0])
        travels = np.linalg.norm(samples[:, 1:4] - self._start, axis=1)
        sizes = np.linalg.norm(samples[:, _COLUMNS], axis=1)
        self._peak = max(self._peak, float(sizes.max(initial=0.0, where=np.isfinite(sizes))))
        self._grow(samples, travels)
        if self.reason is None:
            self.reason = self._direction.suspicion() or self._slip() or self._scale()
        return self.reason

    def left_at_end(self, samples: np.ndarray) -> str | None:
        """Return in words a force that remains in the last samples [n, 37], back at the start, and
        is not explained by noise, drift and the branch."""
        left = float(np.linalg.norm(samples[:, _COLUMNS].mean(axis=0)))
        drift = self._drift * (float(samples[-1, 0]) - self._began)
        allowed = self._noise + drift + _BACK_SHARE * self._peak
        if not left > allowed:
            return None
        return (f"A force of {left:.2g} N is left where the gripper closed on the resting branch; "
                f"{allowed:.2g} N are explained by noise, drift and the branch. The sensor "
                "drifted, or the branch slipped in the gripper")

    def _grow(self, samples: np.ndarray, travels: np.ndarray) -> None:
        # Before it moves nothing is predicted, but the direction is known.
        predicted = self.predicted.at(np.maximum(travels, _MOVED_M)) @ self.predicted.certain
        sizes = np.linalg.norm(predicted, axis=1)
        good = np.isfinite(samples[:, _RAW]).all(axis=1) & (sizes > 0.0)
        self._direction.take(travels[good], predicted[good],
                             samples[good, _RAW] @ self.predicted.certain)
        along = (samples[good, _RAW] * predicted[good]).sum(axis=1) / sizes[good]
        self._growth.take(travels[good], sizes[good], along)

    def _scale(self) -> str | None:
        """Why the force cannot be that of the known moduli."""
        factor, whole = self.predicted.factor, self._growth.whole()
        if factor is None or whole is None:
            return None
        share, margin = whole[0], _CERTAIN * whole[1]
        detail = f"it grows by {100 * share:.0f} % of the predicted force"
        if share > factor + margin:
            return f"{_LARGER} ({detail})"
        return f"{_SMALLER} ({detail})" if share < 1.0 / factor - margin else None

    def _slip(self) -> str | None:
        slip = self._growth.slip()
        if slip is None:
            return None
        share, travel = slip
        return ("the force no longer grows as it did before: the branch slips slowly in the "
                f"gripper, or gives way (over the last {1000 * travel:.0f} mm it grew by "
                f"{100 * max(share, 0.0):.0f} % of what came before)")
