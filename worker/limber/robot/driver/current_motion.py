"""The motion under way and its end: the guard's decisions over two channels to stop an arm."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from limber.robot.driver.guard import Guard
from limber.robot.driver.guard_states import Decision, Verdict
from limber.robot.interface import ArmControl, Sample
from limber.robot.motion.trajectory import Trajectory

_SECOND_CHANNEL_SECONDS = 0.15
_LONG_STEP_SECONDS = 0.004


@dataclass
class Following:
    """A trajectory being followed.

    Attributes:
        trajectory: Its trajectory.
        time: Time of the target along it [s].
        rate: Rate of its time, 0 to 1.
    """

    trajectory: Trajectory
    time: float = 0.0
    rate: float = 0.0


class UnderWay:
    """The trajectory that the arm follows now, if any, and whether it was stopped.

    Args:
        control: Moves the arm.
        guard: Decides.
        tell: Reports events.

    Attributes:
        following: None if no trajectory is followed.
    """

    def __init__(self, control: ArmControl, guard: Guard, tell: Callable[..., None]):
        self._control, self._guard, self._tell = control, guard, tell
        self.following: Following | None = None
        self._stopped_at: float | None = None
        self._was_stopped_at_once = False

    def begin(self, trajectory: Trajectory) -> None:
        """Follow a trajectory from now on."""
        self._stopped_at, self._was_stopped_at_once = None, False
        self.following = Following(trajectory)

    def finish(self) -> None:
        """The end of the trajectory is reached."""
        self.following = None
        self._guard.end()
        if not self._control.end_motion():
            self._stop_at_once("the control program did not stop the motion")

    def judge(self, decision: Decision, sample: Sample | None = None, *,
              at_once: bool = False) -> None:
        """Act on a decision.

        Args:
            at_once: Stop by the second channel as well, since no step of the controller is near.
        """
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
            self._tell(event="paused", reason=str(decision))
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
                   at_s=following.time)
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
