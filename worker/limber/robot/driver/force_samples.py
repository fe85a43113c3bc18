"""The driver's force samples: each wrench, judged by the guard and sent to the parent."""

import time
from collections.abc import Callable

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import SafetyStop, WorkError
from limber.core.numerics.rigid_kernels import frame_of, pose_of, turn_between
from limber.robot.driver.current_motion import UnderWay
from limber.robot.driver.delays import HoldUps
from limber.robot.driver.force_sensors import ForceTorqueSensor, WrenchChain
from limber.robot.driver.guard import Guard
from limber.robot.driver.guard_states import Verdict
from limber.robot.interface import ArmControl, Sample
from limber.robot.motion.followed_path import FollowedPathFile, read_followed_path
from limber.robot.motion.retreat import RetreatPath
from limber.robot.motion.trajectory import Trajectory

_BATCH_SECONDS = 0.02
_OLDEST_READING_SECONDS = 0.05
_STANDING_SECONDS = 0.1  # over which the force of a resting branch is averaged
_NOTHING = np.full(6, np.nan)
_UPPER = np.triu_indices(3)


class Senses:
    """The force sensor, its tare, and the expected wrench of the branch.

    Attributes:
        smooth: Latest smoothed wrench, branch frame [N, N m], shape [6].
        retreat_path: The arm's path so far.
    """

    def __init__(self, cell: Cell, control: ArmControl, sensor: ForceTorqueSensor, guard: Guard,
                 under_way: UnderWay, hold_ups: HoldUps, tell: Callable[..., None]):
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
            self._hold(sample, trajectory)

    def _hold(self, sample: Sample, trajectory: Trajectory) -> None:
        expected = trajectory.expected
        if expected is None or not expected.wrenches.any():
            self._guard.hold(None)
            return
        self._guard.hold(self._standing - expected.wrenches[0, :3], sample.clock)

    def look(self, sample: Sample) -> None:
        """Judge a sample and keep it for the next batch."""
        try:
            reading = self._sensor.read(sample)
        except ConnectionError as error:
            self._under_way.judge(self._guard.event(str(error)))
            return
        now, self.smooth = self._chain.wrench(sample, reading)
        # First the part that must not wait for the rest.
        self._under_way.judge(self._guard.feel(now), sample)
        following = self._under_way.following
        expected = uncertainty = sent = None
        if following is None and np.isfinite(now).all():
            self._standing = self._stood * self._standing + (1.0 - self._stood) * now[:3]
        if following is not None:
            self.retreat_path.note(sample)
            # The arm is at the target of one look-ahead ago.
            behind = max(following.time - self._lookahead * following.rate, 0.0)
            planned = following.trajectory.pose(behind)
            sent = planned[:3]
            expected, uncertainty = self._expected(
                following.trajectory, behind, planned, sample.pose
            )
        grasp = self._base @ frame_of(sample.pose)
        decision = self._guard.look(
            sample, wrench=now, raw=np.stack([reading.raw, reading.wrench]), expected=expected,
            uncertainty=uncertainty, grasp=grasp[:3, 3], sent=sent)
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
        self._under_way.judge(self._guard.feel(self._chain.between(sample, reading)),
                              at_once=True)

    def _expected(self, trajectory: Trajectory, time: float, planned: np.ndarray,
                  pose: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
        """The expected wrench at the gripper's actual position, a little off the target."""
        felt = trajectory.felt(time)
        if felt is None or trajectory.expected is None:
            return None, None
        wrench, slopes, covariance = felt
        rest = trajectory.expected.rest_pose
        off = np.concatenate((pose[:3] - planned[:3] - self._held_at[:3] + rest[:3],
                              turn_between(planned, pose) - turn_between(rest, self._held_at)))
        turn = self._base[:3, :3]
        return wrench + slopes @ np.concatenate((turn @ off[:3], turn @ off[3:])), covariance

    def begin_tare(self, sample: Sample, seconds: float) -> None:
        """Tare the force over the next ``seconds`` [s].

        Raises:
            SafetyStop: the robot moves.
        """
        if self._under_way.following is not None:
            raise SafetyStop("The sensor cannot be tared while the robot "
                             "moves.", "", "Wait until the robot is at "
                                                                  "rest.")
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
        self._is_tared, self._standing = True, np.zeros(3)
        self.followed_file.tared(self._chain.bias)
        self._tell(event="tared", bias=self._chain.bias.tolist(), sigma=sigma.tolist(),
                   delay_s=self._chain.delay(self._rate), noise_n=self._guard.noise)

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
