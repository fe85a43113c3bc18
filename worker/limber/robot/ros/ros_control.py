"""A robot behind a rosbridge for the driver's loop: its samples and wrenches in, trajectories out.

The controller in ROS follows a whole trajectory itself (FollowJointTrajectory), and the loop judges
where the arm is on it; or MoveIt Servo gets a stream of joint speeds (:class:`RosServo`). Whatever
ends a motion before its end, a stop by the guard, an error or Ctrl-C, cancels the goal and
publishes the stop topic, until the controller confirms that the goal has ended.
``scripts/examples/ros2`` shows a node beside the controller that acts on that topic, and on
silence: a websocket is no safety channel.
"""

import socket
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import LimberError, SafetyStop, WorkError
from limber.geometry.rigid_kernels import frame_of, turned_wrench
from limber.robot.interface import Reading, Sample
from limber.robot.motion.trajectory import Trajectory
from limber.robot.ros import messages
from limber.robot.ros.bridge import SECONDS, Bridge, call
from limber.robot.ros.topics import WRENCH, Topics, grip_by_action, wrench_topic

BEAT_SECONDS = 0.1
_MOST_UNHEARD = 3  # beats that do not come back; the node beside the controller bears as many
_COUNTED, _KEPT = 20, 150  # samples that tell the rate, and whether the arm moves
_REST_SECONDS, _LAST_SECONDS = 0.3, 1.0
_STILL_RAD = 1e-3
_SUCCEEDED = 4  # action_msgs/msg/GoalStatus
_OFF_END_M = 0.02
_RETURN_PER_S = 5.0  # share of the way off the path that a servo makes up
_SEARCHED = 50  # rows ahead of the last place
_PAYLOAD = "ur_msgs/srv/SetPayload"


class RosSensor:
    """The cell's force sensor as its topic reports it, in its own frame; ``is_heard``: whether it
    has sent anything yet."""

    connections: tuple[socket.socket, ...] = ()

    def __init__(self, cell: Cell):
        self._frame = frame_of(np.array(cell.sensor.pose))
        self._last, self._arrived, self.is_heard = np.full(6, np.nan), -np.inf, False

    def take(self, message: dict[str, Any]) -> None:
        """Take a stamped wrench."""
        self._last, self._arrived = messages.wrench_of(message), time.monotonic()
        self.is_heard = True

    def read(self, sample: Sample) -> Reading:
        """Return the newest reading."""
        return Reading(turned_wrench(self._frame[:3, :3], self._last, self._frame[:3, 3]),
                       sample.arrived - self._arrived, self._last)

    def close(self) -> None:
        """The connection is the control's."""


class RosControl:
    """A robot and its force sensor behind the rosbridge at robot.address, as an
    :class:`limber.robot.interface.ArmControl` that follows whole trajectories. InputError as
    :func:`wrench_topic`, or for another arm's joint states; WorkError if a topic sends nothing."""

    lookahead, silence = 0.0, 0.3

    def __init__(self, cell: Cell, bridge: Bridge | None = None):
        self._cell, self._topics = cell, Topics.of_cell(cell)
        wrench = wrench_topic(cell, self._topics.wrench)
        self._bridge = bridge or Bridge(cell.robot.address)
        self._states, self.sensor = messages.JointStates(cell, self._topics.prefix), RosSensor(cell)
        self._status = {getattr(self._topics, name): name for name in messages.STATUS_KINDS
                        if cell.arm.controller == "ur"}
        self._reported: dict[str, Any] = {}
        self._recent, self._waiting = deque[Sample](maxlen=_KEPT), list[Sample]()
        self._warnings: list[str] = []
        self._goals, self._unheard, self._beat = 0, 0, -np.inf
        self._goal: str | None = None
        self._asked: dict[str, Any] | None = None
        self._cancels_until: float | None = None
        self._trajectory: Trajectory | None = None
        self._outcome: str | None = None
        self._place, self._is_echoed, self._may_stand, self._ended_at = 0, False, 0.0, -np.inf
        self._stood, self._stood_at, self._rests = (0.0, 0.0), np.zeros(0), np.zeros(0)
        self._takes = {self._topics.joint_states: self._take_joints,
                       wrench: self.sensor.take, self._topics.stop: self._take_stop}
        for topic, kind in ((self._topics.joint_states, messages.JOINT_STATE), (wrench, WRENCH),
                            (self._topics.stop, messages.STOP), (self._topics.end, messages.END), *(
                                (topic, messages.STATUS_KINDS[name])
                                for topic, name in self._status.items())):
            self._bridge.subscribe(topic, kind)
        self._bridge.advertise(self._topics.stop, messages.STOP)
        self._bridge.advertise(self._topics.end, messages.END)
        try:
            self._require_topics(wrench)
        except BaseException:
            self._bridge.close()
            raise
        last, steps = self._recent[-1], np.diff([sample.clock for sample in self._recent])
        self.rate = float(1.0 / max(np.median(steps), 1e-3))
        self.facts: dict[str, Any] = {
            "address": cell.robot.address, "model": cell.arm.name, "version": "unknown",
            "rate_hz": self.rate, "pose": last.pose.tolist(),
            "joints": last.joints.tolist(), "slider": last.slider, "wrench_topic": wrench,
            "longest_gap_s": float(steps.max()), **{
                name: value for name, value in self._reported.items() if name != "slider"}}

    def _require_topics(self, wrench: str) -> None:
        end = time.monotonic() + SECONDS
        while len(self._recent) < _COUNTED or not self.sensor.is_heard or (
                len(self._reported) < len(self._status)):
            if time.monotonic() > end:
                raise self._silent(wrench)
            self.read(BEAT_SECONDS)

    def _silent(self, wrench: str) -> WorkError:
        """The error of a topic that sent nothing of use."""
        unheard = [topic for topic, name in self._status.items() if name not in self._reported]
        arm = self._cell.arm
        if self._recent and self.sensor.is_heard and unheard:
            return WorkError(
                f"Nothing came on {', '.join(unheard)} within {SECONDS:g} s.",
                "Without it the guard does not see a protective stop, after whose release the arm "
                "would go on.",
                f"Start the arm's driver: ros2 launch ur_robot_driver ur_control.launch.py "
                f"ur_type:={arm.name} robot_ip:=ADDRESS. It starts io_and_status_controller and "
                "speed_scaling_state_broadcaster. A driver that publishes the modes only when "
                "they change is too old.")
        others = "" if self._recent or not self._states.others else (
            f" It has the joints {', '.join(self._states.others)}, not those of a {arm.name}: "
            f"{', '.join(self._states.wanted)}. Check robot.model and robot.ros.prefix.")
        silent = self._topics.joint_states if self.sensor.is_heard else wrench
        return WorkError(f"Too little came on {silent} within {SECONDS:g} s.{others}", "The guard "
                         "needs joint states and wrenches.",
                         "Check the topic's name with `ros2 topic list`, and that its node runs.")

    # Messages

    def read(self, timeout: float, beside: Sequence[socket.socket] = ()) -> list[Sample]:
        """Return the next samples, waiting at most ``timeout`` [s] for the first."""
        end = time.monotonic() + timeout
        while (message := self._bridge.receive(
                0.0 if self._waiting else max(end - time.monotonic(), 0.0))) is not None:
            self._take(message)
        self._send_due()
        samples, self._waiting = self._waiting, []
        return samples

    def skip(self) -> None:
        """Drop the samples that have arrived so far."""
        self.read(0.0)

    def _take(self, message: dict[str, Any]) -> None:
        kind, topic = message.get("op"), str(message.get("topic"))
        if kind == "publish":
            if (name := self._status.get(topic)) is not None:
                self._reported[name] = messages.status_of(name, message["msg"])
            elif (taken := self._takes.get(topic)) is not None:
                taken(message["msg"])
        elif kind == "action_result" and message.get("id") == self._goal:
            self._take_result(message)
        elif kind == "status" and message.get("level") == "error" and self._goal is not None:
            self._end(f"rosbridge reports: {message.get('msg')}. One without actions, as that "
                      "of Humble (1.3), moves no arm: update rosbridge_suite")

    def _take_joints(self, message: dict[str, Any]) -> None:
        sample = self._states.sample(message, time.monotonic(), messages.RUNNING | self._reported)
        if sample is not None:
            self._recent.append(sample)
            self._waiting.append(sample)

    def _take_stop(self, message: dict[str, Any]) -> None:
        self._unheard = 0
        if message.get("data") and self._cancels_until is None:
            self._end("a stop was published")

    def _take_result(self, message: dict[str, Any]) -> None:
        values = message.get("values")
        told = values if isinstance(values, dict) else {"error_string": values}
        is_well = message.get("result") and message.get("status", _SUCCEEDED) == _SUCCEEDED and (
            not told.get("error_code"))
        self._end("" if is_well else "the controller in ROS ended the motion "
                  f"({told.get('error_string') or 'no reason was given'})")
        self._goal, self._cancels_until = None, None

    def _end(self, outcome: str) -> None:
        if self._trajectory is not None and self._outcome is None:
            self._outcome = outcome

    # Motion

    def follow(self, trajectory: Trajectory, since: float = 0.0) -> None:
        """Follow a trajectory from its time ``since`` [s] on. SafetyStop if the arm moves."""
        last = self._recent[-1]
        # By the way, not by the speed, whose noise is no motion; our own may just have ended.
        rest = max(last.clock - _REST_SECONDS, self._ended_at)
        if not max((np.abs(each.joints - last.joints).max() for each in self._recent
                   if each.clock >= rest), default=0.0) <= _STILL_RAD:
            raise SafetyStop("The arm moves already.", "Something else drives it.",
                             "Stop it, and begin again.")
        self._goals += 1
        self._trajectory, self._outcome, self._is_echoed = trajectory, None, False
        self._place = int(np.searchsorted(trajectory.times, since))
        self._rests = _rests(trajectory)
        self._stood, self._stood_at = (0.0, last.clock), last.joints
        self._unheard, self._beat, self._cancels_until = 0, -np.inf, None
        self._asked = messages.goal_of(trajectory, self._states.ordered, since, last.joints)

    def progress(self, sample: Sample) -> tuple[float, str | None]:
        """Return the time along the trajectory where the arm is nearest to it [s], and how it
        ended: "" at its end, else why; None while it is followed."""
        trajectory = self._trajectory
        assert trajectory is not None and trajectory.joints is not None
        ahead = trajectory.joints[self._place:self._place + _SEARCHED]
        self._place += int(np.abs(ahead - sample.joints).max(axis=1).argmin())
        first = max(self._place - 1, 0)
        way, times = trajectory.joints[first:first + 3], trajectory.times[first:first + 3]
        steps, off = np.diff(way, axis=0), sample.joints - way[:-1]
        parts = np.clip((off * steps).sum(axis=1) / np.maximum((steps**2).sum(axis=1), 1e-18), 0, 1)
        row = int(np.abs(off - parts[:, None] * steps).max(axis=1).argmin())
        if self._outcome == "":
            # All that is left, as a way back ends where it began.
            left = trajectory.poses[self._place:, :3] - sample.pose[:3]
            if not (off := float(np.linalg.norm(left, axis=1).max())) <= _OFF_END_M:
                self._outcome = ("the controller in ROS calls its goal reached, but the arm is "
                                 f"{1000 * off:.0f} mm away from what is left of its way")
        elif self._outcome is None:
            self._outcome = self._fault(sample)
        return float(times[row] + parts[row] * (times[row + 1] - times[row])), self._outcome

    def _fault(self, sample: Sample) -> str | None:
        """A standstill under a goal for longer than its path rests there, in the controller's time,
        which its speed scales; or a bridge that passes nothing on."""
        stood, before = self._stood
        if self._asked is not None or np.abs(sample.joints - self._stood_at).max() > _STILL_RAD:
            self._stood, self._stood_at = (0.0, sample.clock), sample.joints
            self._may_stand = SECONDS + float(self._rests[self._place])
        else:
            stood += (sample.clock - before) * min(sample.slider, 1.0)
            self._stood = stood, sample.clock
            if stood > self._may_stand:
                return f"the arm has stood still for {stood:.1f} s under its goal"
        if self._is_echoed and self._unheard > _MOST_UNHEARD:
            return ("rosbridge passes on nothing while the goal runs, so no stop either: start it "
                    "with send_action_goals_in_new_thread:=true")
        return None

    def _send_due(self) -> None:
        """Send what is due: a sign of life while a goal runs, the goal once that came back, and a
        cancel again: rosbridge drops that of a goal not accepted yet."""
        now = time.monotonic()
        if self._asked is not None and (
                self._unheard > _MOST_UNHEARD or (self._beat > -np.inf and self._unheard == 0)):
            self._send_goal()
        if (self._asked, self._goal) == (None, None) or now - self._beat <= BEAT_SECONDS:
            return
        self._beat = now
        if self._cancels_until is None:
            self._unheard += 1
            self._say(False)
        else:
            self._cancel()
            if now > self._cancels_until:
                self._warnings.append("the controller in ROS did not confirm within "
                                      f"{SECONDS:g} s that its goal is cancelled: check the robot")
                self._goal = None

    def _send_goal(self) -> None:
        self._is_echoed = self._unheard == 0
        if not self._is_echoed:
            self._warnings.append(f"what Limber publishes on {self._topics.stop} does not come "
                                  "back from rosbridge: a stop may not be passed on")
        self._goal, asked, self._asked = f"limber-{self._goals}", self._asked, None
        self._stood = 0.0, self._recent[-1].clock
        self._bridge.send(op="send_action_goal", id=self._goal, action=self._topics.trajectory,
                          action_type=messages.FOLLOW, feedback=False, args=asked)

    def _say(self, stop: bool) -> None:
        self._bridge.send(op="publish", topic=self._topics.stop, msg={"data": stop})

    def _cancel(self) -> None:
        self._say(True)
        if self._goal is not None:
            self._bridge.send(op="cancel_action_goal", id=self._goal,
                              action=self._topics.trajectory)

    def end_motion(self) -> bool:
        """Cancel the goal, if it has not ended well, and go on with that while samples are read."""
        if self._trajectory is None:
            return True
        is_over = self._outcome == ""
        self._trajectory = self._asked = None
        if is_over:
            # The node beside the controller expects no more beats.
            self._bridge.send(op="publish", topic=self._topics.end, msg={})
            self._ended_at = self._recent[-1].clock
        else:
            self._cancels_until, self._beat = time.monotonic() + SECONDS, time.monotonic()
            self._cancel()
        return True

    def stop_at_once(self) -> None:
        """Publish a stop, for the node beside the controller too."""
        self._cancel()

    def keep_alive(self) -> bool:
        """Signs of life are sent while samples are read."""
        return True

    # The rest of a control

    def connect(self) -> None:
        """Set the payload where the arm's driver can; what it was is not reported, so it stays."""
        tool = self._cell.tool
        if self._cell.arm.controller == "ur" and self._cell.sensor.kind == "controller":
            call(self._bridge, self._topics.set_payload, _PAYLOAD, self._take, {
                "mass": tool.mass_kg or 0.0, "center_of_gravity": dict(zip(
                    "xyz", tool.centre_of_mass_m, strict=True))})
            self._warnings.append(f"the payload in the controller is {tool.mass_kg or 0:g} kg now")

    def watch(self) -> None:
        """The node beside the controller acts on silence by itself."""

    def program_runs(self) -> bool:
        """Whether the controller accepts goals, as far as it reports that."""
        return self._recent[-1].program_runs

    def start_program(self) -> bool:
        """Limber starts no program in ROS."""
        return False

    def servo(self, pose: np.ndarray) -> bool:
        """Whole trajectories are sent: see :meth:`follow`."""
        return False

    servo_joints = servo

    def grip(self, close: bool) -> None:
        """Close or open the gripper by its action; what it answers is not waited for."""
        grip_by_action(self._cell, self._bridge, close)

    def put_back(self) -> str | None:
        """Await the end of a cancelled goal, and return in words what was noticed."""
        end = time.monotonic() + _LAST_SECONDS
        while self._cancels_until is not None and self._goal is not None and (
                time.monotonic() < end):
            # A message that broke the motion off may come again; the cancel goes on.
            with suppress(LimberError):
                self.read(BEAT_SECONDS)
        return "; ".join(dict.fromkeys(self._warnings)) or None

    def close(self) -> None:
        """Close the connection."""
        self._bridge.close()


class RosServo(RosControl):
    """The same robot by a stream to MoveIt Servo, which halts the arm a tenth of a second after its
    last message: of joint speeds (JointJog), or of the flange's twist (TwistStamped). Servo applies
    a twist at its group's tip link, a UR arm's tool0, and turns it from the axes of its frame: so
    not the grasp's own speed is sent, but that of the flange that carries it."""

    silence, by_joints = 0.1, True
    # No whole trajectories: it is no TrajectoryControl.
    follow = progress = None  # type: ignore[assignment]

    def __init__(self, cell: Cell, bridge: Bridge | None = None):
        self._sent: tuple[np.ndarray, float] | None = None
        super().__init__(cell, bridge)
        topics = self._topics
        self._stream, kind, self._frame = (topics.jog, messages.JOG, "") if (
            topics.output == "servo") else (topics.twist, messages.TWIST, topics.twist_frame)
        self._bridge.advertise(self._stream, kind)

    def servo_joints(self, joints: np.ndarray) -> bool:
        """Send the speeds that bring the joints to their next angles [rad], shape [n], and back
        onto the way."""
        last = self._recent[-1]
        before, since = self._sent or (last.joints, last.clock)
        self._jog((joints - before) / max(last.clock - since, 1.0 / self.rate)
                  + _RETURN_PER_S * (joints - last.joints))
        self._sent = joints, last.clock
        return True

    def _jog(self, speeds: np.ndarray) -> None:
        seconds, nanoseconds = divmod(round(1e9 * self._recent[-1].clock), 10**9)
        if self._frame:
            twist = self._cell.arm.jacobian(self._recent[-1].joints) @ speeds
            linear, angular = (dict(zip("xyz", part, strict=True))
                               for part in twist.reshape(2, 3).tolist())
            message: dict[str, Any] = {"twist": {"linear": linear, "angular": angular}}
        else:
            message = {"joint_names": self._states.ordered, "displacements": [], "duration": 0.0,
                       "velocities": np.round(speeds, 6).tolist()}
        self._bridge.send(op="publish", topic=self._stream, msg=message | {"header": {
            "stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": self._frame}})

    def _send_due(self) -> None:
        """Beat while the stream goes on, for the node beside the controller."""
        if self._sent is not None and time.monotonic() - self._beat > BEAT_SECONDS:
            self._beat = time.monotonic()
            self._say(False)

    def _take_stop(self, message: dict[str, Any]) -> None:
        if message.get("data") and self._sent is not None:
            raise SafetyStop("A stop was published.", f"It came on {self._topics.stop}.", "")

    def end_motion(self) -> bool:
        """Stop the joints."""
        self._sent = None
        self._jog(np.zeros(len(self._states.ordered)))
        self._bridge.send(op="publish", topic=self._topics.end, msg={})
        return True


def _rests(trajectory: Trajectory) -> np.ndarray:
    """How long a trajectory stays near each of its rows, or the rows beside it [s], shape [n]."""
    assert trajectory.joints is not None
    ways = np.r_[0.0, np.abs(np.diff(trajectory.joints, axis=0)).max(axis=1).cumsum()]
    ends = np.searchsorted(ways, ways + _STILL_RAD, side="right")
    rests = trajectory.times[np.minimum(ends, len(ways) - 1)] - trajectory.times
    return np.maximum(rests, np.maximum(np.r_[rests[0], rests[:-1]], np.r_[rests[1:], 0.0]))
