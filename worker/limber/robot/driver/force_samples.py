"""Forces in the driver's loop: sensors, samples judged by the guard, the motion that these end."""

import socket
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import SafetyStop, WorkError
from limber.geometry.rigid_kernels import (
    frame_of,
    inverse_of,
    pose_of,
    turn_between,
    turned_wrench,
    weight_wrench,
)
from limber.robot.driver.guard import Decision, Guard, GuardSettings, State, Verdict
from limber.robot.interface import (
    ArmControl,
    Reading,
    Sample,
    TrajectoryControl,
    require_sensor,
)
from limber.robot.motion.retreat import FollowedPathFile, RetreatPath, read_followed_path
from limber.robot.motion.trajectory import Trajectory
from limber.robot.ur.ft300 import Ft300Line, Ft300Stream

_HELD_UP_SECONDS = 0.02
_GRACE_SECONDS = 0.015


class HoldUps:
    """Detects a delay of the loop and gives it time to read the messages from then: their absence
    proves no silence yet. It listens once more, for ``quiet`` [s] at once, and not again without a
    sample."""

    def __init__(self, quiet: float, tell: Callable[..., None]):
        self._quiet, self._tell = quiet, tell
        self._woke, self._listened = -float("inf"), time.monotonic()

    def set_off(self) -> None:
        """Starting a program took this time; it is no delay."""
        self._listened = time.monotonic()

    def note(self, last_arrived: float | None, *, moving: bool) -> None:
        """The loop has listened once more; ``last_arrived``: when the last sample came [s,
        monotonic], ``moving``: whether a trajectory is followed."""
        before, self._listened = self._listened, time.monotonic()
        overslept = self._listened - before - self._quiet
        if overslept < _HELD_UP_SECONDS:
            return
        if last_arrived is None or last_arrived > self._woke:
            self._woke = self._listened
        if moving:
            self._tell(event="warning", text="the computer delayed the robot's program by "
                       f"{1000 * overslept:.0f} ms, and nothing was monitored during that time")

    @property
    def has_just_woken(self) -> bool:
        """Whether a delay has just ended."""
        return time.monotonic() - self._woke < _GRACE_SECONDS


_SECOND_CHANNEL_SECONDS = 0.15
_LONG_STEP_SECONDS = 0.004


@dataclass
class Following:
    """A trajectory being followed: the time of the target along it [s], and the rate of that time,
    0 to 1."""

    trajectory: Trajectory
    time: float = 0.0
    rate: float = 0.0


class UnderWay:
    """The trajectory that the arm follows now, if any, and whether it was stopped; ``control``
    moves the arm, ``guard`` decides, ``tell`` reports."""

    def __init__(self, control: ArmControl, guard: Guard, tell: Callable[..., None]):
        self._control, self._guard, self._tell = control, guard, tell
        self.following: Following | None = None
        self._stopped_at: float | None = None
        self._was_stopped_at_once = False

    def begin(self, trajectory: Trajectory) -> None:
        """Follow a trajectory from now on."""
        self._stopped_at, self._was_stopped_at_once = None, False
        self.following = Following(trajectory)

    def place(self, sample: Sample) -> str | None:
        """Note where the arm is on a trajectory that its controller follows by itself; return how
        that ended, as :meth:`.TrajectoryControl.progress`."""
        if not isinstance(self._control, TrajectoryControl) or self.following is None or (
                self._guard.state != State.MOVING):
            return None
        self.following.time, ended = self._control.progress(sample)
        return ended

    def finish(self) -> None:
        """The end of the trajectory is reached."""
        self.following = None
        self._guard.end()
        if not self._control.end_motion():
            self._stop_at_once("the control program did not stop the motion")

    def judge(self, decision: Decision, sample: Sample | None = None, *,
              at_once: bool = False) -> None:
        """Act on a decision; ``at_once``: stop by the second channel too, since no step of the
        controller is near."""
        if decision.verdict == Verdict.STOP and self._stopped_at is None:
            if self.following is not None:
                # The control program takes a command with the controller's next step, 8 ms of a
                # CB3's.
                is_slow = sample is not None and 1.0 / self._control.rate > _LONG_STEP_SECONDS
                if at_once or is_slow:
                    self._stop_at_once("the stop does not wait for the next control step: "
                                       f"{decision.reason}")
                self._stop(self.following, decision, sample)
            else:
                self._stopped_at = time.monotonic()
                self._tell(event="stopped", reason=str(decision), moving=False)
        elif decision.verdict == Verdict.PAUSE and self.following is not None and decision.limit:
            # Before the brake, as with a stop. A held target is ahead of the arm by the look-ahead:
            # at 50 mm/s the arm would continue into a wall for 3 mm.
            self._tell(event="paused", reason=str(decision), force_factor=self._guard.force_factor)
            following = self.following
            following.time = max(following.time - self._control.lookahead * following.rate, 0.0)
            following.rate = 0.0
            self._stop_arm()

    def _stop(self, following: Following, decision: Decision, sample: Sample | None) -> None:
        self.following = None
        self._stopped_at = time.monotonic()
        came = sample.arrived if sample is not None else self._stopped_at
        latency = self._stopped_at - came
        # Before the arm's stop: without an answer this process does not return from it.
        self._tell(event="stopped", reason=str(decision), moving=True, value=decision.value,
                   limit=decision.limit, command_after_s=latency,
                   clock=sample.clock if sample is not None else None,
                   at_s=following.time, force_factor=self._guard.force_factor)
        self._stop_arm()

    def _stop_arm(self) -> None:
        """First channel: the control program; second, if it fails: :meth:`_stop_at_once`."""
        stopped = False
        try:
            stopped = self._control.end_motion()
        except RuntimeError as error:
            self._tell(event="warning", text=f"stop of the control program: {error}")
        if not stopped and not self._was_stopped_at_once:
            self._stop_at_once("the control program did not confirm the stop")

    def _stop_at_once(self, why: str) -> None:
        try:
            self._control.stop_at_once()
            self._was_stopped_at_once = True
            self._tell(event="second_channel", reason=why)
        except OSError as error:
            self._tell(event="warning", text=f"stop without the control program: {error}; the "
                       f"controller's watchdog ends its program in {self._control.silence:.2f} s")

    def lose(self, reason: str) -> None:
        """The data connection was lost: the state is unknown, so every means to stop is used."""
        moving = self.following is not None
        decision = self._guard.event(reason)
        self._stop_at_once("the data connection was lost")
        self._tell(event="stopped", reason=str(decision), moving=moving)

    def stand(self, last: Sample | None) -> None:
        """No trajectory is followed: keep the program alive; check that a stopped arm is at rest.
        """
        if not self._control.keep_alive() and self._stopped_at is None:
            self.judge(self._guard.event("the control program is not running"))
        if self._stopped_at is not None and last is not None:
            late = time.monotonic() - self._stopped_at > _SECOND_CHANNEL_SECONDS
            moving = float(np.abs(last.joint_speeds).max()) > 1e-2
            if late and moving:
                self._stop_at_once("the robot still moves after the stop")
                self._stopped_at = time.monotonic()

    def give_up(self) -> None:
        """Stop the motion: the driver ends."""
        if self.following is not None:
            self.following = None
            self._stop_arm()


# Force-torque sensors: from a reading to the wrench of the gripper on the branch.
#
# The frames: the controller reports the wrench of the surroundings on the tool, in the base's axes,
# about the tool's centre. An FT300 reports the same in its own frame.
# The guard and recordings need the opposite: the wrench of the gripper on the branch, about the
# grasp's centre, in the branch's frame. A tare removes bias and weight at its orientation. The
# change of the gripper's weight with rotation is removed by computation.

INDEPENDENT_READINGS = 2
"""Least readings in a smoothed wrench: an FT300 sends fewer than a controller requests."""



class ForceTorqueSensor(Protocol):
    """A source of readings; over its own ``connections`` they arrive between the robot's
    samples."""

    connections: tuple[socket.socket, ...]

    def read(self, sample: Sample) -> Reading:
        """Return the newest reading at the time of a sample of the robot; ConnectionError if the
        connection was lost."""
        ...

    def close(self) -> None:
        """Release the sensor."""
        ...


class ControllerSensor:
    """The controller's own wrench at the tool's centre (in CB3 an estimate from currents)."""

    connections: tuple[socket.socket, ...] = ()

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
    """A Robotiq FT300, by its URCap's stream or by USB. LimberError as :class:`.Ft300Stream`,
    :class:`.Ft300Line`."""

    def __init__(self, cell: Cell):
        self._frame = frame_of(np.array(cell.sensor.pose))
        self.connections: tuple[socket.socket, ...] = ()
        self._source: Ft300Stream | Ft300Line
        if cell.sensor.kind == "ft300_usb":
            assert cell.sensor.device is not None
            self._source = Ft300Line(cell.sensor.device)
        else:
            self._source = Ft300Stream(cell.robot.address)
            self.connections = (self._source.connection,)
        self._last = np.full(6, np.nan)
        self._arrived = time.monotonic()

    def read(self, sample: Sample) -> Reading:
        found = self._source.poll()
        if found is not None:
            self._last, self._arrived = found, time.monotonic()
        frame = self._frame
        return Reading(turned_wrench(frame[:3, :3], self._last, frame[:3, 3]),
                       time.monotonic() - self._arrived, self._last)

    def close(self) -> None:
        self._source.close()


def open_sensor(cell: Cell, control: ArmControl | None = None) -> ForceTorqueSensor:
    """Return the cell's sensor, which a ``control`` may bring itself. InputError as
    :func:`require_sensor`; WorkError if it does not answer."""
    require_sensor(cell)
    if (own := getattr(control, "sensor", None)) is not None:
        return own
    return ControllerSensor(cell) if cell.sensor.kind == "controller" else Ft300Sensor(cell)


@dataclass
class WrenchChain:
    """Tare, weight, range and filter, from readings to the wrench of the gripper on the branch.
    ``bias`` and its standard error are of the tare, flange frame, shape [6]; ``at_rest`` are forces
    during it [N], shape [n, 3]; the slower output averages ``count`` readings, and lags half of
    them."""

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

    def level(self, sample: Sample, reading: Reading) -> np.ndarray:
        """Return what only load and zero of the controller's own sensor change of a reading, shape
        [6]: without the payload that it computes away."""
        rotation = (frame_of(sample.pose) @ self._from_tool)[:3, :3]
        centre = np.zeros(3) if sample.payload_centre is None else sample.payload_centre
        return reading.wrench + weight_wrench(sample.payload or 0.0, centre, rotation)

    def zeroed(self, change: np.ndarray) -> None:
        """The sensor's zero has changed every reading by ``change`` [6]."""
        self.bias = self.bias + change
        self._recent.clear()

    def start_tare(self) -> None:
        """Collect readings of the empty, resting gripper."""
        self._taring = []

    def end_tare(self, least: int = 20) -> np.ndarray:
        """Take the mean of the collected readings as bias; return its standard error [6]. WorkError
        if too few, or the gripper was touched: their spread exceeds the noise."""
        readings, self._taring = np.array(self._taring or []), None
        if len(readings) < least:
            raise WorkError(f"Only {len(readings)} readings arrived for the tare.", f"{least} are "
                            "needed.", "Check the sensor's connection.")
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
        """Return the wrench of the gripper on the branch, at once and smoothed, shape [6] each,
        branch frame, about the grasp's centre; readings at the end of the range are infinite, as
        the true ones are larger."""
        flange = frame_of(sample.pose) @ self._from_tool
        raw = reading.wrench - self._weight(flange)
        if self._taring is not None:
            self._taring.append(raw)
        now = self._on_branch(raw, reading, flange)
        self._recent.append(now)
        if len(self._recent) > self.count:
            self._recent.popleft()
        return now, np.asarray(sum(self._recent) / len(self._recent))

    def between(self, sample: Sample, reading: Reading) -> np.ndarray:
        """Return the wrench of a reading that arrived after ``sample``, shape [6], not averaged."""
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


def guard_of(cell: Cell, rate: float) -> Guard:
    """Return the guard of a cell whose controller sends ``rate`` samples a second."""
    return Guard(cell.arm, GuardSettings.of_cell(cell), rate)


def rehearse(cell: Cell, sample: Sample, reading: Reading) -> None:
    """Judge a sample once: loading must not delay a motion."""
    guard = guard_of(cell, cell.arm.rate)
    guard.tared(np.zeros((3, 3)))
    guard.hold(np.zeros(3))
    guard.begin()
    now, _ = WrenchChain(cell).wrench(sample, reading)
    guard.look(sample, wrench=now, raw=np.stack([reading.raw, reading.wrench]), expected=now,
               uncertainty=np.eye(6), grasp=sample.pose[:3], sent=sample.pose[:3])
    turn_between(sample.pose, sample.pose)
    guard.state = State.MOVING
    guard.permit(sample.pose, sample.pose + 1e-3, 0.002)
    pose_of(frame_of(np.array(cell.base.pose)) @ frame_of(sample.pose))


_BATCH_SECONDS = 0.02
_OLDEST_READING_SECONDS = 0.05
_STANDING_SECONDS = 0.1  # over which the force of a resting branch is averaged
LEVEL_READINGS = 25
"""Readings before and after a program's start that tell how the sensor's zero has changed."""
_SETTLING = 75  # readings in between, which may not know of it yet
_NOTHING = np.full(6, np.nan)
_UPPER = np.triu_indices(3)


class Senses:
    """The force sensor, its tare, and the branch's expected wrench; ``smooth``: latest smoothed
    wrench, branch frame [N, N m], shape [6]; ``retreat_path``: the arm's path so far."""

    def __init__(self, cell: Cell, control: ArmControl, sensor: ForceTorqueSensor, guard: Guard,
                 under_way: UnderWay, hold_ups: HoldUps, tell: Callable[..., None],
                 level: np.ndarray | None):
        """``level`` [6] of readings before the program's start, as :meth:`WrenchChain.level`, if it
        zeroes the sensor."""
        self._base = frame_of(np.array(cell.base.pose))
        self._rate, self._lookahead = control.rate, control.lookahead
        self._sensor, self._guard = sensor, guard
        self._chain = WrenchChain(cell, count=5 if control.rate > 200 else 3)
        self._under_way, self._hold_ups, self._tell = under_way, hold_ups, tell
        self.followed_file, followed = FollowedPathFile(cell), read_followed_path(cell)
        self.retreat_path = RetreatPath(cell.arm.joint_names, followed, self.followed_file)
        self._is_tared = False
        self._recalls_tare = followed is not None and followed.bias is not None
        if followed is not None and followed.bias is not None:
            # The tare of an earlier program: a retreat is judged by it.
            self._chain.bias = followed.bias
        self._levels = deque[np.ndarray](maxlen=_SETTLING + LEVEL_READINGS)
        self._level = level if self._recalls_tare else None
        self._is_zeroed = level is not None
        self.smooth = _NOTHING
        self._held_for: np.ndarray | None = None
        self._held_at = np.zeros(6)
        self._standing = np.zeros(3)
        self._stood = float(np.exp(-1.0 / (_STANDING_SECONDS * control.rate)))
        self._tare_until: float | None = None
        self._batch: list[np.ndarray] = []
        self._batch_since = time.monotonic()

    @property
    def connections(self) -> tuple:
        """Connections of the sensor's readings, if they are separate from the samples."""
        return self._sensor.connections

    def begin(self, sample: Sample, trajectory: Trajectory) -> None:
        """A trajectory is followed from ``sample`` on."""
        self.retreat_path.begin(sample, trajectory)
        rest = None if trajectory.expected is None else trajectory.expected.rest_pose
        if rest is None or self._held_for is None or np.abs(rest - self._held_for).max() > 0:
            # Here the gripper closed on the resting branch: displacements are measured from here.
            self._held_for, self._held_at = rest, sample.pose.copy()
            expected = trajectory.expected
            self._guard.hold(None if expected is None or not expected.wrenches.any() else
                             self._standing - expected.wrenches[0, :3])

    def look(self, sample: Sample) -> None:
        """Judge a sample and keep it for the next batch."""
        try:
            reading = self._sensor.read(sample)
        except ConnectionError as error:
            self._under_way.judge(self._guard.event(str(error)))
            return
        if self._is_zeroed:
            self._find_zero(sample, reading)
        now, self.smooth = self._chain.wrench(sample, reading)
        # First the part that must not wait for the rest.
        self._under_way.judge(self._guard.feel(now), sample)
        following = self._under_way.following
        expected = uncertainty = places = sent = None
        if following is None and np.isfinite(now).all():
            self._standing = self._stood * self._standing + (1.0 - self._stood) * now[:3]
        if following is not None:
            self.retreat_path.note(sample)
            # The arm is at the target of one look-ahead ago.
            behind = max(following.time - self._lookahead * following.rate, 0.0)
            planned = following.trajectory.pose(behind)
            sent = planned[:3]
            expected, uncertainty, places = self._expected(following.trajectory, behind, planned,
                                                           sample.pose)
        grasp = self._base @ frame_of(sample.pose)
        decision = self._guard.look(
            sample, wrench=now, raw=np.stack([reading.raw, reading.wrench]), expected=expected,
            uncertainty=uncertainty, places=places, grasp=grasp[:3, 3], sent=sent)
        if (reading.age > _OLDEST_READING_SECONDS and decision.verdict != Verdict.STOP
                and not self._hold_ups.has_just_woken):
            decision = self._guard.event(f"the force sensor has been silent for {reading.age:.3f} "
                                         "s")
        self._under_way.judge(decision, sample)
        self._batch.append(np.concatenate((
            (sample.clock,), pose_of(grasp), now, self.smooth, sample.joints,
            _NOTHING if expected is None else expected,
            _NOTHING if uncertainty is None else uncertainty[:3, :3][_UPPER])))
        if self._tare_until is not None and sample.clock >= self._tare_until:
            self._end_tare()

    def feel(self, sample: Sample) -> None:
        """A force that arrived between two samples need not wait for the next: hard limits stop."""
        if not self._sensor.connections:
            return
        try:
            reading = self._sensor.read(sample)
        except ConnectionError as error:
            # A closed connection is always readable: select would never wait again.
            self._sensor.connections = ()
            self._under_way.judge(self._guard.event(str(error)))
            return
        self._under_way.judge(self._guard.feel(self._chain.between(sample, reading)), at_once=True)

    def _expected(self, trajectory: Trajectory, time: float, planned: np.ndarray,
                  pose: np.ndarray) -> tuple[np.ndarray | None, ...]:
        """The expected wrench at the gripper's actual position, a little off the target, its
        covariance and places."""
        felt = trajectory.felt(time)
        if felt is None or trajectory.expected is None:
            return None, None, None
        wrench, slopes, *errors = felt
        rest = trajectory.expected.rest_pose
        off = np.concatenate((pose[:3] - planned[:3] - self._held_at[:3] + rest[:3],
                              turn_between(planned, pose) - turn_between(rest, self._held_at)))
        turn = self._base[:3, :3]
        return wrench + slopes @ np.concatenate((turn @ off[:3], turn @ off[3:])), *errors

    @property
    def level(self) -> np.ndarray | None:
        """Level of the last readings, to be taken before a program starts; None if that changes
        none."""
        return np.mean([*self._levels][-LEVEL_READINGS:], axis=0) if self._levels else None

    def program_started(self, level: np.ndarray | None) -> None:
        """A program was started under load, where readings had this :attr:`level`."""
        self._level = level
        self._levels.clear()

    @property
    def knows_zero(self) -> bool:
        """Whether the tare is right for the readings of this program."""
        return self._level is None

    def _find_zero(self, sample: Sample, reading: Reading) -> None:
        """An e-Series zeroes its sensor at each program's start, under load as well: what was
        nothing at the tare is another reading from now on."""
        self._levels.append(self._chain.level(sample, reading))
        if self._level is not None and len(self._levels) == self._levels.maxlen:
            self._chain.zeroed(self.level - self._level)
            self._level = None
            self._standing = self._chain.wrench(sample, reading)[0][:3]
            self.followed_file.tared(self._chain.bias)

    def begin_tare(self, sample: Sample, seconds: float) -> None:
        """Tare the force over the next ``seconds`` [s]; SafetyStop if the robot moves."""
        if self._under_way.following is not None:
            raise SafetyStop("The sensor cannot be tared while the robot moves.", "", "Wait until "
                             "the robot is at rest.")
        self._chain.start_tare()
        self._tare_until = sample.clock + seconds

    def recall_tare(self) -> None:
        """Judge forces by the tare of the program that followed the path, if none was done since.
        """
        if self._recalls_tare and not self._is_tared:
            self._guard.tared()

    def _end_tare(self) -> None:
        self._tare_until = None
        try:
            sigma = self._chain.end_tare()
        except WorkError as error:
            self._tell(event="refused", order="tare", reason=str(error))
            return
        self._guard.tared(self._chain.at_rest)
        self._is_tared, self._standing, self._level = True, np.zeros(3), None
        self.followed_file.tared(self._chain.bias)
        self._tell(event="tared", bias=self._chain.bias.tolist(), sigma=sigma.tolist(),
                   delay_s=self._chain.delay(self._rate), noise_n=self._guard.errors.noise)

    def send_batch(self) -> None:
        """Send the samples of the last hundredths of a second."""
        now = time.monotonic()
        if self._batch and now - self._batch_since >= _BATCH_SECONDS:
            rows = np.round(np.array(self._batch), 7).astype(object)
            rows[~np.isfinite(np.array(self._batch))] = None
            self._tell(samples=rows.tolist())
            self._batch, self._batch_since = [], now

    def close(self) -> None:
        """Release the sensor, and make sure that the path is on disk."""
        self.followed_file.close()
        self._sensor.close()
