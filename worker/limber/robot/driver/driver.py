"""The process that moves the robot: ``python -m limber.robot.driver.driver``.

ur-rtde has wheels for Python 3.11 and 3.12 only, holds the interpreter while it connects and ends
the whole process when a connection breaks in a bad moment. So it lives here, alone. Orders come as
JSON lines on standard input, samples and events go out as JSON lines; when the input ends, as when
the parent is killed, the robot is stopped and the process ends.

The loop is paced by the controller's own samples: each is read, judged by the guard, and answered
by the next target within the same step. Nothing here waits for a motion.
"""

import json
import os
import queue
import select
import signal
import sys
import threading
import time
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np

from limber.core.errors import InputError, LimberError, SafetyStop, WorkError
from limber.core.numerics.rigid_kernels import frame_of, pose_of, turn_between
from limber.robot.cell.cell import Cell
from limber.robot.driver.connection import WATCHDOG_HZ, checked, connect, require
from limber.robot.driver.deadline import (
    CONNECT_SECONDS,
    RenewedDeadline,
    clear_deadline,
    set_deadline,
)
from limber.robot.driver.force_sensors import ForceTorqueSensor, WrenchChain, open_sensor
from limber.robot.driver.guard import PLAYING, Decision, Guard, GuardSettings, State, Verdict
from limber.robot.driver.messages import Words
from limber.robot.driver.real_time import claim_real_time, keep_awake, spare_what_is_loaded
from limber.robot.motion.expected_wrench import ExpectedWrench
from limber.robot.motion.retreat import WayBack
from limber.robot.motion.start_check import require_start
from limber.robot.motion.trajectory import Trajectory
from limber.robot.ur.samples import Dashboard, Sample, SampleStream

PARENT_SECONDS = 1.0
"""The parent says something at least this often, or the robot stops."""

_LOOKAHEAD, _GAIN = 0.06, 900.0
_STOP_DECELERATION = 8.0  # rad/s^2 of the joints
_PROGRAM_SECONDS = 1.5
_GONE_SECONDS = 1.0  # of silence; from the first of them on the arm is being stopped
_BATCH_SECONDS = 0.02
_SECOND_CHANNEL_SECONDS = 0.15
_LONG_STEP_SECONDS = 0.004
_LAST_SECONDS = 10.0  # from when nobody gives orders any more; a stop takes one at most
_LOOP_PRIORITY = 22
_HELD_UP_SECONDS = 0.02
_GRACE_SECONDS = 0.015
_NOTHING = np.full(6, np.nan)
_UPPER = np.triu_indices(3)


@dataclass
class Following:
    """A motion under way.

    Attributes:
        trajectory: Where to.
        time: How far along it the target is [s].
        rate: How fast its time runs, 0 to 1.
    """

    trajectory: Trajectory
    time: float = 0.0
    rate: float = 0.0


class Driver:
    """One robot, its sensor and its guard.

    Args:
        cell: Robot, tool, sensor and limits.
        words: What it says goes through them.

    Raises:
        LimberError: the robot does not answer, or is not in a state to be moved.
    """

    def __init__(self, cell: Cell, words: Words):
        self.cell, self.tell = cell, words.tell
        self._base = frame_of(np.array(cell.base.pose))
        address = cell.robot.address
        self._stream = SampleStream(address)
        self._dashboard = Dashboard(address)
        self.facts = checked(cell, self._stream, self._dashboard)
        self._sensor: ForceTorqueSensor = open_sensor(cell)
        self._chain = WrenchChain(cell, count=5 if self._stream.rate > 200 else 3)
        self.guard = self._new_guard()
        self._warm_up()
        # Now: where it has just compiled this takes longer than the watchdog would wait.
        self.facts |= {"kept_in_memory": spare_what_is_loaded(), "kept_awake": keep_awake()}
        set_deadline(CONNECT_SECONDS)
        self._control, self._io = connect(cell, self._stream.rate)
        self._deadline = RenewedDeadline()
        self._deadline.renew()
        # Before ur-rtde's own threads, which have what was claimed before they began.
        claim_real_time(_LOOP_PRIORITY)
        self._following: Following | None = None
        self._way_back = WayBack()
        self._stopped_at: float | None = None
        self._dashboard_was_used = False
        self._command: np.ndarray | None = None
        self._held_for: np.ndarray | None = None
        self._held_at = np.zeros(6)
        self._tare_until: float | None = None
        self._smooth = _NOTHING
        self._batch: list[np.ndarray] = []
        self._batch_since = time.monotonic()
        self._last: Sample | None = None
        self._woke, self._listened = -np.inf, time.monotonic()
        self._heard = time.monotonic()
        self.ended = False

    # Connecting

    def _new_guard(self) -> Guard:
        cell = self.cell
        return Guard(cell.arm, GuardSettings(cell.limits, cell.joint_limits, cell.workspace),
                     self._stream.rate)

    def _warm_up(self) -> None:
        """Go through what the loop does once: compiling on the way would starve the watchdog."""
        samples: list[Sample] = []
        while len(samples) < 3:
            samples += self._stream.read(1.0)
        guard, chain = self._new_guard(), WrenchChain(self.cell)
        guard.tared()
        guard.begin()
        for sample in samples:
            reading = self._sensor.read(sample)
            now, _ = chain.wrench(sample, reading)
            guard.look(sample, wrench=now, raw=np.stack([reading.raw, reading.wrench]),
                       expected=now, doubt=np.eye(6), grasp=sample.pose[:3])
            turn_between(sample.pose, sample.pose)
            guard.state = State.MOVING
            guard.permit(sample.pose, sample.pose + 1e-3, 0.002)
            pose_of(self._base @ frame_of(sample.pose))
        _walked_back(samples[0])
        # Loaded now, to be kept in memory with the rest.
        import_module("rtde_control")

    # The loop

    def run(self, orders: "queue.SimpleQueue[dict[str, Any] | None]") -> None:
        """Serve orders until they end."""
        quiet = 2.0 / self._stream.rate + 0.005
        self._stream.skip()
        while not self.ended:
            self._deadline.renew()
            try:
                samples = self._stream.read(quiet, self._sensor.connections)
            except ConnectionError as error:
                self._lost(str(error))
                return
            self._note_hold_up(quiet)
            for sample in samples:
                self._look(sample)
            if samples:
                self._last = samples[-1]
                # What came while they were judged need not wait for the next target as well.
                beside = self._sensor.connections
                if beside and select.select(beside, [], [], 0.0)[0]:
                    self._feel(self._last)
            elif self._last is not None:
                age = time.monotonic() - self._last.arrived
                if not self._has_just_woken:
                    self._judge(self.guard.silence(age), at_once=True)
                    if age > _GONE_SECONDS:
                        self._lost(f"no data arrived from the robot for {age:.1f} s")
                        return
                self._feel(self._last)
            self._take(orders)
            if samples and not self.ended:
                self._move(len(samples) / self._stream.rate)
            self._send_batch()

    def _note_hold_up(self, quiet: float) -> None:
        """See that the computer held this loop up; it listens for ``quiet`` [s] at a time.

        What came meanwhile waits in the connections, and is read and judged. That nothing came
        tells of no silence yet: it is listened for once more, and no second time without a sample.
        """
        before, self._listened = self._listened, time.monotonic()
        overslept = self._listened - before - quiet
        if overslept < _HELD_UP_SECONDS:
            return
        if self._last is None or self._last.arrived > self._woke:
            self._woke = self._listened
        if self._following is not None:
            self.tell(event="warning", text="the computer delayed the robot's program by "
                      f"{1000 * overslept:.0f} ms, and nothing was monitored in that time")

    @property
    def _has_just_woken(self) -> bool:
        return time.monotonic() - self._woke < _GRACE_SECONDS

    def _take(self, orders: "queue.SimpleQueue[dict[str, Any] | None]") -> None:
        while True:
            try:
                order = orders.get_nowait()
            except queue.Empty:
                break
            if order is None:
                self._judge(self.guard.event("the program that drives the robot has ended"))
                self.ended = True
                return
            self._heard = time.monotonic()
            try:
                self._obey(order)
            except LimberError as error:
                self.tell(event="refused", order=order.get("order"), reason=str(error))
        if time.monotonic() - self._heard > PARENT_SECONDS and self._following is not None:
            self._judge(self.guard.event("the program that drives the robot does not answer"))

    def _obey(self, order: dict[str, Any]) -> None:
        name = order.get("order")
        if name == "alive":
            return
        if name == "tare":
            self._begin_tare(float(order.get("seconds", 0.5)))
        elif name == "follow":
            self._begin(Trajectory(
                np.array(order["times"], float), np.array(order["poses"], float),
                None if order.get("expected") is None else ExpectedWrench(**{
                    part: np.array(value, float) for part, value in order["expected"].items()})),
                None if order.get("start_joints") is None
                else np.array(order["start_joints"], float))
        elif name == "stop":
            self._judge(self.guard.event("asked to stop"))
        elif name == "resume":
            self.guard.resume()
            self.tell(event="resumed")
        elif name == "acknowledge":
            self.guard.acknowledge()
            self.tell(event="acknowledged")
        elif name == "retreat":
            self._retreat()
        elif name == "gripper":
            self._grip(bool(order["close"]))
        else:
            raise InputError(f"Order {name!r} is unknown.")

    # Samples

    def _look(self, sample: Sample) -> None:
        try:
            reading = self._sensor.read(sample)
        except ConnectionError as error:
            self._judge(self.guard.event(str(error)))
            return
        now, smooth = self._chain.wrench(sample, reading)
        self._smooth = smooth
        # First what must not wait for the rest.
        self._judge(self.guard.feel(now), sample)
        following = self._following
        expected = doubt = sent = None
        if following is not None:
            self._way_back.note(sample)
            # The arm is where its target was a look-ahead ago.
            behind = max(following.time - _LOOKAHEAD * following.rate, 0.0)
            planned = following.trajectory.pose(behind)
            sent = planned[:3]
            expected, doubt = self._expected(following.trajectory, behind, planned, sample.pose)
        grasp = self._base @ frame_of(sample.pose)
        decision = self.guard.look(
            sample, wrench=now, raw=np.stack([reading.raw, reading.wrench]), expected=expected,
            doubt=doubt, grasp=grasp[:3, 3], sent=sent)
        if reading.age > 0.05 and decision.verdict != Verdict.STOP and not self._has_just_woken:
            decision = self.guard.event(f"the force sensor is silent for {reading.age:.3f} s")
        self._judge(decision, sample)
        pose = pose_of(grasp)
        self._batch.append(np.concatenate((
            (sample.clock,), pose, now, smooth, sample.joints,
            _NOTHING if expected is None else expected,
            _NOTHING if doubt is None else doubt[:3, :3][_UPPER])))
        if self._tare_until is not None and sample.clock >= self._tare_until:
            self._end_tare()

    def _feel(self, sample: Sample) -> None:
        """A force that came between two samples need not wait for the next: hard limits stop."""
        if not self._sensor.connections:
            return
        try:
            reading = self._sensor.read(sample)
        except ConnectionError as error:
            # A closed connection always has something to read: it would never let us wait again.
            self._sensor.connections = ()
            self._judge(self.guard.event(str(error)))
            return
        self._judge(self.guard.feel(self._chain.between(sample, reading)), at_once=True)

    def _expected(self, trajectory: Trajectory, time: float, planned: np.ndarray,
                  pose: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
        """What the branch is felt as where the gripper is, which is not quite where it was sent."""
        felt = trajectory.felt(time)
        if felt is None or trajectory.expected is None:
            return None, None
        wrench, slopes, covariance = felt
        rest = trajectory.expected.rest_pose
        off = np.concatenate((pose[:3] - planned[:3] - self._held_at[:3] + rest[:3],
                              turn_between(planned, pose) - turn_between(rest, self._held_at)))
        turn = self._base[:3, :3]
        return wrench + slopes @ np.concatenate((turn @ off[:3], turn @ off[3:])), covariance

    def _judge(self, decision: Decision, sample: Sample | None = None, *,
               at_once: bool = False) -> None:
        """Act on a decision.

        Args:
            at_once: Stop by the dashboard as well: no step of the controller is near.
        """
        if decision.verdict == Verdict.STOP and self._stopped_at is None:
            if self._following is not None:
                # ur-rtde hands a command over with the controller's next step, 8 ms of a CB3's.
                is_slow = sample is not None and 1.0 / self._stream.rate > _LONG_STEP_SECONDS
                if at_once or is_slow:
                    self._stop_by_dashboard("it does not wait for the next step: "
                                            f"{decision.reason}")
                self._stop(decision, sample)
            else:
                self._stopped_at = time.monotonic()
                self.tell(event="stopped", reason=str(decision), moving=False)
        elif decision.verdict == Verdict.PAUSE and self._following is not None \
                and self._following.rate > 0 and decision.limit:
            self.tell(event="paused", reason=str(decision))

    def _stop(self, decision: Decision, sample: Sample | None) -> None:
        following = self._following
        assert following is not None
        self._following = None
        self._stopped_at = time.monotonic()
        came = sample.arrived if sample is not None else self._stopped_at
        latency = self._stopped_at - came
        # Before the arm's stop, from which this process does not come back where no answer comes.
        self.tell(event="stopped", reason=str(decision), moving=True, value=decision.value,
                  limit=decision.limit, command_after_s=latency,
                  clock=sample.clock if sample is not None else None,
                  at_s=following.time)
        self._stop_arm()

    def _stop_arm(self) -> None:
        """First channel: the control program; second, where it fails: the dashboard."""
        stopped = False
        try:
            stopped = bool(self._control.servoStop(_STOP_DECELERATION))
        except RuntimeError as error:
            self.tell(event="warning", text=f"servoStop: {error}")
        if not stopped and not self._dashboard_was_used:
            self._stop_by_dashboard("the control program did not confirm the stop")

    def _stop_by_dashboard(self, why: str) -> None:
        try:
            self._dashboard.stop()
            self._dashboard_was_used = True
            self.tell(event="second_channel", reason=why)
        except OSError as error:
            self.tell(event="warning", text=f"dashboard stop: {error}; the controller's watchdog "
                      f"ends its program in {1 / WATCHDOG_HZ:.2f} s")

    def _lost(self, reason: str) -> None:
        """The data connection is gone: nothing is known, so everything that stops is used."""
        moving = self._following is not None
        decision = self.guard.event(reason)
        self._stop_by_dashboard("the data connection was lost")
        self.tell(event="stopped", reason=str(decision), moving=moving)
        self.ended = True

    # Motion

    def _begin(self, trajectory: Trajectory, start_joints: np.ndarray | None) -> None:
        sample = self._require_sample()
        require_start(sample.pose, sample.joints, trajectory.poses[0], start_joints)
        self._require_program(sample)
        self.guard.begin()
        self._way_back.begin(sample, trajectory)
        rest = None if trajectory.expected is None else trajectory.expected.rest_pose
        if rest is None or self._held_for is None or np.abs(rest - self._held_for).max() > 0:
            # Here the gripper closed on the resting branch: ways are measured from here.
            self._held_for, self._held_at = rest, sample.pose.copy()
        self._set_off(trajectory)

    def _retreat(self) -> None:
        sample = self._require_sample()
        way = self._way_back.from_here(sample, self.cell.limits.acceleration_m_s2)
        self._require_program(sample)
        self.guard.begin_retreat(self._smooth)
        self._set_off(way)

    def _set_off(self, trajectory: Trajectory) -> None:
        self._stopped_at, self._dashboard_was_used = None, False
        self._following = Following(trajectory)
        self._command = self._require_sample().pose.copy()
        # Starting a program takes its time, and is no hold-up.
        self._listened = time.monotonic()
        self.tell(event="started", seconds=trajectory.duration)

    def _require_program(self, sample: Sample) -> None:
        if sample.slider <= 0.0:
            raise SafetyStop("The speed slider is at 0.", "The robot would not move.",
                             "Raise it on the pendant.")
        if not self._control.isProgramRunning():
            self._start_program()

    def _start_program(self) -> None:
        """Upload the control program once more, and see that it runs: ur-rtde does not wait."""
        started = self._control.reuploadScript()
        self._deadline.renew()
        given_up = time.monotonic() + _PROGRAM_SECONDS
        while not (self._control.isProgramRunning()
                   and self._require_sample().runtime_state == PLAYING):
            if not started or time.monotonic() > given_up:
                raise WorkError("The control program does not run.", "", "See the pendant.")
            self._deadline.renew()
            for sample in self._stream.read(1.0 / self._stream.rate):
                self._look(sample)
                self._last = sample
        # Each program begins without one.
        require(self._control.setWatchdog(WATCHDOG_HZ), "start its watchdog")

    def _move(self, step: float) -> None:
        """Send the next target, ``step`` [s] of the controller's time after the last one."""
        following = self._following
        if following is None or self._last is None:
            self._keep_alive()
            return
        assert self._command is not None
        if self.guard.state == State.MOVING:
            # Time along the path starts softly, also after a pause.
            following.rate = min(following.rate + step / 0.2, 1.0)
            following.time = min(following.time + following.rate * step,
                                 following.trajectory.duration + _LOOKAHEAD)
            target = following.trajectory.pose(following.time)
            self._command = self.guard.permit(self._command, target, 1.2 * step)
        else:
            following.rate = 0.0
        done = self._control.servoL(list(self._command), 0.1, 0.1, 1.0 / self._stream.rate,
                                    _LOOKAHEAD, _GAIN)
        if not done:
            self._judge(self.guard.event(
                "the control program accepted no target: it ends if it receives nothing for "
                f"{1 / WATCHDOG_HZ:.2g} s, for example because this computer is too busy"))
            return
        over = following.time >= following.trajectory.duration + 0.5 * _LOOKAHEAD
        still = float(np.abs(self._last.joint_speeds).max()) < 1e-3
        if over and still:
            self._finish(following)

    def _finish(self, following: Following) -> None:
        self._following = None
        self.guard.end()
        if not self._control.servoStop(_STOP_DECELERATION):
            self._stop_by_dashboard("the control program did not stop the motion")
        error = float(np.linalg.norm(
            self._require_sample().pose[:3] - following.trajectory.poses[-1, :3]))
        self.tell(event="reached", error_m=error)

    def _keep_alive(self) -> None:
        if not self._control.kickWatchdog() and self._stopped_at is None:
            self._judge(self.guard.event("the control program does not run"))
        if self._stopped_at is not None and self._last is not None:
            late = time.monotonic() - self._stopped_at > _SECOND_CHANNEL_SECONDS
            moving = float(np.abs(self._last.joint_speeds).max()) > 1e-2
            if late and moving:
                self._stop_by_dashboard("the robot still moves after its stop")
                self._stopped_at = time.monotonic()

    def _grip(self, close: bool) -> None:
        if self._io is None:
            raise InputError("Limber does not drive the cell's gripper.",
                             f"tool.gripper is {self.cell.tool.gripper}.",
                             "Close and open it by hand.")
        require(self._io.setStandardDigitalOut(self.cell.tool.close_output, close),
                      "drive its gripper")
        self.tell(event="gripper", closed=close)

    # Tare

    def _begin_tare(self, seconds: float) -> None:
        sample = self._require_sample()
        if self._following is not None:
            raise SafetyStop("The sensor cannot be tared while the robot "
                             "moves.", "", "Wait until the robot is at "
                                                                  "rest.")
        self._chain.start_tare()
        self._tare_until = sample.clock + seconds

    def _end_tare(self) -> None:
        self._tare_until = None
        try:
            sigma = self._chain.end_tare()
        except WorkError as error:
            self.tell(event="refused", order="tare", reason=str(error))
            return
        self.guard.tared()
        self.tell(event="tared", bias=self._chain.bias.tolist(), sigma=sigma.tolist(),
                  delay_s=self._chain.delay(self._stream.rate))

    # Words

    def _send_batch(self) -> None:
        now = time.monotonic()
        if self._batch and now - self._batch_since >= _BATCH_SECONDS:
            rows = np.round(np.array(self._batch), 7)
            self.tell(samples=np.where(np.isfinite(rows), rows, None).tolist())
            self._batch, self._batch_since = [], now

    def _require_sample(self) -> Sample:
        if self._last is None:
            raise WorkError("No data of the robot yet.")
        return self._last

    def close(self) -> None:
        """Stop what moves and let go of the robot."""
        set_deadline()
        if self._following is not None:
            self._following = None
            self._stop_arm()
        self._sensor.close()
        if self._io is not None:
            self._io.disconnect()
        self._control.disconnect()
        self._stream.close()
        self._dashboard.close()


def _walked_back(sample: Sample) -> Trajectory:
    """Go a millimetre and the way back in thought, so that all that it takes is loaded."""
    way = WayBack()
    there = replace(sample, pose=sample.pose + np.r_[0.002, np.zeros(5)])
    way.begin(sample, Trajectory(np.array([0.0, 1.0]), np.array([sample.pose, there.pose])))
    way.note(there)
    return way.from_here(there, 0.1)


def _read_orders(orders: "queue.SimpleQueue[dict[str, Any] | None]") -> None:
    for line in sys.stdin:
        try:
            orders.put(json.loads(line))
        except json.JSONDecodeError:
            orders.put({"order": line.strip()[:40]})
    orders.put(None)
    # ur-rtde may wait for ever for a robot that went away as well: nobody is left who could end
    # this process, and it has priority over all others.
    time.sleep(_LAST_SECONDS)
    os._exit(3)


def main() -> int:
    """Read the cell from the first line of standard input, then serve; returns an exit code."""
    # ur-rtde prints on standard output; what is ours goes through a copy of it.
    words = Words(os.fdopen(os.dup(1), "w", encoding="utf-8"))
    os.dup2(2, 1)
    driver: Driver | None = None
    try:
        driver = Driver(Cell.model_validate_json(sys.stdin.readline()), words)
        driver.tell(event="connected", **driver.facts)
        orders: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        threading.Thread(target=_read_orders, args=(orders,), daemon=True).start()
        # Where a whole group of processes is asked to end, the arm is stopped in order, not by its
        # watchdog; this one then ends with whoever gives it orders.
        signal.signal(signal.SIGTERM, lambda *_: orders.put({"order": "stop"}))
        driver.run(orders)
    except (LimberError, RuntimeError, ConnectionError, ImportError) as error:
        words.tell(event="failed", reason=str(error), code=getattr(error, "exit_code", 3))
        return 3
    finally:
        if driver is not None and not driver.ended:
            driver.close()
        # From here on nothing waits for the robot: the last words may take their time.
        clear_deadline()
        words.close()
    # What ur-rtde's threads still wait for is not waited for.
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
