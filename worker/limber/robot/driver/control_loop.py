"""The loop that moves a robot, paced by the controller's own samples.

Each sample is read, judged by the guard, and answered by the next target within the same step.
Nothing here waits for a motion.
"""

import queue
import select
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import InputError, LimberError, SafetyStop, WorkError
from limber.robot.controller_settings import require_tool
from limber.robot.driver.controls import control_of
from limber.robot.driver.force_samples import (
    LEVEL_READINGS,
    Following,
    ForceTorqueSensor,
    HoldUps,
    Senses,
    UnderWay,
    WrenchChain,
    guard_of,
    open_sensor,
    rehearse,
)
from limber.robot.driver.guard import State, Verdict
from limber.robot.driver.real_time import (
    CONNECT_SECONDS,
    RenewedDeadline,
    Words,
    claim_real_time,
    keep_awake,
    set_deadline,
    spare_what_is_loaded,
)
from limber.robot.interface import ArmControl, Sample, TrajectoryControl
from limber.robot.motion.retreat import RetreatPath, require_start
from limber.robot.motion.trajectory import ExpectedWrench, Trajectory

PARENT_SECONDS = 1.0
"""Longest time between messages of the parent before the robot stops."""

_PROGRAM_SECONDS = 1.5
_GONE_SECONDS = 1.0  # of silence; at its start the arm is already being stopped
_LOOP_PRIORITY = 22

Orders = queue.SimpleQueue[dict[str, Any] | None]
"""Orders of the parent; None: the parent has ended."""


class Driver:
    """One robot of a cell, its sensor and its guard; ``words`` is the channel for its messages.
    LimberError if the robot does not answer, or is not in a state to be moved."""

    def __init__(self, cell: Cell, words: Words):
        self.cell, self.tell = cell, words.tell
        self._control = control_of(cell)
        sensor = open_sensor(cell, self._control)
        level = _warm_up(cell, self._control, sensor, self.tell)
        self.guard = guard_of(cell, self._control.rate)
        # Now: if it has just loaded much, this takes longer than the watchdog would wait.
        self.facts = self._control.facts | {
            "real_time": claim_real_time(), "kept_in_memory": spare_what_is_loaded(),
            "kept_awake": keep_awake(), "rate_hz": self._control.rate}
        set_deadline(CONNECT_SECONDS)
        self._control.connect()
        self._deadline = RenewedDeadline()
        self._deadline.renew()
        # Before the control starts its own threads: they inherit the priority set before.
        claim_real_time(_LOOP_PRIORITY)
        self._quiet = 2.0 / self._control.rate + 0.005
        self._hold_ups = HoldUps(self._quiet, self.tell)
        self._under_way = UnderWay(self._control, self.guard, self.tell)
        self._senses = Senses(cell, self._control, sensor, self.guard, self._under_way,
                              self._hold_ups, self.tell, level)
        self._command = np.zeros(6)
        self._last: Sample | None = None
        self._ended: str | None = None
        self._heard = time.monotonic()
        self.ended = False

    def run(self, orders: Orders) -> None:
        """Serve orders until they end."""
        self._control.skip()
        while not self.ended:
            self.turn(orders)

    def turn(self, orders: Orders) -> None:
        """Take the samples that come next, and the orders; move on by that."""
        self._deadline.renew()
        try:
            samples = self._control.read(self._quiet, self._senses.connections)
        except ConnectionError as error:
            self._lose(str(error))
            return
        self._hold_ups.note(None if self._last is None else self._last.arrived,
                            moving=self._under_way.following is not None)
        before = self._last
        if samples:
            self._look(samples)
        elif self._last is not None and not self._bears_silence(self._last):
            return
        self._take(orders)
        if samples and not self.ended:
            # By its clock: a controller may send fewer samples than its rate.
            self._move(samples[-1].clock - (before or samples[0]).clock)
        self._senses.send_batch()

    def _look(self, samples: list[Sample]) -> None:
        for sample in samples:
            self._ended = self._under_way.place(sample)
            self._senses.look(sample)
        self._last = samples[-1]
        # Readings that arrived during the judgement need not wait for the next target either.
        beside = self._senses.connections
        if beside and select.select(beside, [], [], 0.0)[0]:
            self._senses.feel(self._last)

    def _bears_silence(self, last: Sample) -> bool:
        """Judge the silence since ``last``; returns whether the robot may still be connected."""
        age = time.monotonic() - last.arrived
        if not self._hold_ups.has_just_woken:
            self._under_way.judge(self.guard.silence(age), at_once=True)
            if age > _GONE_SECONDS:
                self._lose(f"no data arrived from the robot for {age:.1f} s")
                return False
        self._senses.feel(last)
        return True

    def _lose(self, reason: str) -> None:
        self._under_way.lose(reason)
        self.ended = True

    # Orders

    def _take(self, orders: Orders) -> None:
        while True:
            try:
                order = orders.get_nowait()
            except queue.Empty:
                break
            if order is None:
                self._under_way.judge(
                    self.guard.event("the program that drives the robot has ended"))
                self._put_back()
                self._senses.followed_file.close()
                self.ended = True
                return
            self._heard = time.monotonic()
            try:
                self._obey(order)
            except LimberError as error:
                self.tell(event="refused", order=order.get("order"), reason=str(error))
        is_silent = time.monotonic() - self._heard > PARENT_SECONDS
        if is_silent and self._under_way.following is not None:
            self._under_way.judge(
                self.guard.event("the program that drives the robot does not answer"))

    def _obey(self, order: dict[str, Any]) -> None:
        name = order.get("order")
        if name == "alive":
            return
        if name == "tare":
            self._senses.begin_tare(self._require_sample(), float(order.get("seconds", 0.5)))
        elif name == "follow":
            self._begin(_ordered(order))
        elif name == "stop":
            self._under_way.judge(self.guard.event("a stop was requested"))
        elif name == "resume":
            self.guard.resume()
            following = self._under_way.following
            if isinstance(self._control, TrajectoryControl) and following is not None:
                self._control.follow(following.trajectory, following.time)
            self.tell(event="resumed")
        elif name == "acknowledge":
            self.guard.acknowledge()
            self.tell(event="acknowledged")
        elif name == "retreat":
            self._retreat()
        elif name == "gripper":
            close = bool(order["close"])
            self._control.grip(close)
            self._senses.followed_file.gripped(close)
            self.tell(event="gripper", closed=close)
        else:
            raise InputError(f"Order {name!r} is unknown.")

    # Motion

    def _begin(self, trajectory: Trajectory) -> None:
        sample = self._require_sample()
        require_tool(self.cell, sample)
        if sample.slider < 1.0 and not isinstance(self._control, TrajectoryControl):
            raise SafetyStop(f"The speed slider is at {100 * sample.slider:.0f} %.", "The arm "
                             "would fall behind the targets that it is sent, and leave its path.",
                             "Raise it to 100 % on the pendant; a motion is slowed by its speed.")
        # Poses computed from joint angles have the arm's nominal dimensions, not its own.
        start = sample.pose if trajectory.by_joints else trajectory.poses[0]
        require_start(sample.pose, sample.joints, start, None if trajectory.joints is None
                      else trajectory.joints[0], self.cell.arm.joint_names)
        self._require_program(sample)
        self.guard.begin(by_joints=trajectory.by_joints)
        self._senses.begin(sample, trajectory)
        self._set_off(trajectory)

    def _retreat(self) -> None:
        sample = self._require_sample()
        trajectory = self._senses.retreat_path.from_here(sample, self.cell.limits.acceleration_m_s2)
        self._require_program(sample)
        self._senses.recall_tare()
        self.guard.begin_retreat(self._senses.smooth)
        self._set_off(trajectory)

    def _set_off(self, trajectory: Trajectory) -> None:
        if isinstance(self._control, TrajectoryControl):
            try:
                self._control.follow(trajectory)
            except LimberError:
                self.guard.end()
                raise
        if getattr(self._control, "by_joints", False):
            trajectory = replace(trajectory, by_joints=True)
        self._under_way.begin(trajectory)
        self._command = self._require_sample().pose.copy()
        self._hold_ups.set_off()
        self.tell(event="started", seconds=trajectory.duration)

    def _require_program(self, sample: Sample) -> None:
        if (decision := self.guard.modes(sample)).verdict == Verdict.STOP:
            raise SafetyStop(f"The arm cannot be moved: {decision}.", "Limber releases no stop.",
                             "Check the robot, and put it right at the pendant.")
        if sample.slider <= 0.0:
            raise SafetyStop("The speed slider is at 0.", "The robot would not move.",
                             "Raise it on the pendant.")
        deadline = time.monotonic() + _PROGRAM_SECONDS
        if not self._control.program_runs():
            self._start_program(deadline)
        while not self._senses.knows_zero:
            self._control.keep_alive()
            self._look_on(deadline)

    def _start_program(self, deadline: float) -> None:
        """Start the control program once more, and check that it runs."""
        level = self._senses.level
        started = self._control.start_program()
        while not (self._control.program_runs() and self._require_sample().program_runs):
            self._look_on(deadline if started else -np.inf)
        self._senses.program_started(level)
        # Each program begins without a watchdog.
        self._control.watch()

    def _look_on(self, deadline: float) -> None:
        if time.monotonic() > deadline:
            raise WorkError("The control program is not running.", "", "See the pendant.")
        self._deadline.renew()
        for sample in self._control.read(1.0 / self._control.rate):
            self._senses.look(sample)
            self._last = sample

    def _move(self, step: float) -> None:
        """Send the next target, ``step`` [s] of the controller's time after the last one."""
        following = self._under_way.following
        if following is None or self._last is None:
            self._under_way.stand(self._last)
            return
        if isinstance(self._control, TrajectoryControl):
            if self._ended:
                self._under_way.judge(self.guard.event(self._ended))
            elif self._ended is not None:
                self._finish(following)
            return
        end = following.trajectory.duration
        if self.guard.state == State.MOVING:
            # Time along the path starts softly, also after a pause.
            following.rate = min(following.rate + step / 0.2, 1.0)
            following.time = min(following.time + following.rate * step,
                                 end + self._control.lookahead)
            target = following.trajectory.pose(following.time)
            self._command = self.guard.permit(self._command, target, 1.2 * step)
            if following.trajectory.by_joints and self._command is not target:
                # Joint angles cannot be slowed down like a pose.
                self._under_way.judge(self.guard.event(
                    "the joints' motion is faster than the cell's limits"))
                return
        else:
            # It was braked here and continues from here.
            self._command = following.trajectory.pose(following.time)
        moves = self.guard.state == State.MOVING
        if not (self._sent(following) if moves else self._control.keep_alive()):
            self._under_way.judge(self.guard.event(
                "the control program accepted no target: it ends when it receives nothing for "
                f"{self._control.silence:.2g} s, for example because this computer is too busy"))
            return
        over = moves and following.time >= end + 0.5 * self._control.lookahead
        still = float(np.abs(self._last.joint_speeds).max()) < 1e-3
        if over and still:
            self._finish(following)

    def _sent(self, following: Following) -> bool:
        if following.trajectory.by_joints:
            return self._control.servo_joints(following.trajectory.angles(following.time))
        return self._control.servo(self._command)

    def _finish(self, following: Following) -> None:
        self._under_way.finish()
        error = float(np.linalg.norm(
            self._require_sample().pose[:3] - following.trajectory.poses[-1, :3]))
        self.tell(event="reached", error_m=error)

    def _require_sample(self) -> Sample:
        if self._last is None:
            raise WorkError("No data from the robot yet.")
        return self._last

    def close(self) -> None:
        """Stop the motion and release the robot."""
        set_deadline()
        self._under_way.give_up()
        self._senses.close()
        self._put_back()
        self._control.close()

    def _put_back(self) -> None:
        if left := self._control.put_back():
            self.tell(event="warning", text=left)


def _ordered(order: dict[str, Any]) -> Trajectory:
    """The trajectory of an order to follow one."""
    expected, joints = order.get("expected"), order.get("joints")
    return Trajectory(
        np.array(order["times"], float), np.array(order["poses"], float),
        None if expected is None else ExpectedWrench(**{
            part: np.array(value, float) for part, value in expected.items()}),
        None if joints is None else np.array(joints, float), by_joints=bool(order["by_joints"]))


def _warm_up(cell: Cell, control: ArmControl, sensor: ForceTorqueSensor,
             tell: Callable[..., None]) -> np.ndarray | None:
    """Run the loop's functions once: loading during a motion would starve the watchdog. Return
    the level of the controller's own sensor, as :meth:`.WrenchChain.level`; ``tell`` if fewer
    samples come than were asked for, and reckon with so many."""
    samples: list[Sample] = []
    while len(samples) < LEVEL_READINGS:
        samples += control.read(1.0)
    step = float(np.median(np.diff([sample.clock for sample in samples])))
    if step > 1.5 / control.rate:
        tell(event="warning", text=f"the controller sends {1.0 / step:.0f} samples a second, not "
             f"{control.rate:.0f}: a force is seen {1e3 * (step - 1 / control.rate):.0f} ms later")
        control.rate = 1.0 / step
    readings = [sensor.read(sample) for sample in samples]
    for sample, reading in zip(samples, readings, strict=True):
        rehearse(cell, sample, reading)
    _walk_back(samples[0], RetreatPath(cell.arm.joint_names))
    if cell.sensor.kind != "controller" or isinstance(control, TrajectoryControl):
        return None
    return np.mean(list(map(WrenchChain(cell).level, samples, readings)), axis=0)


def _walk_back(sample: Sample, retreat: RetreatPath) -> None:
    """Simulate a millimetre and the return, so that everything needed for it is loaded."""
    shifted = replace(sample, pose=sample.pose + np.r_[0.002, np.zeros(5)])
    retreat.begin(sample, Trajectory(np.array([0.0, 1.0]), np.array([sample.pose, shifted.pose])))
    retreat.note(shifted)
    retreat.from_here(shifted, 0.1)
