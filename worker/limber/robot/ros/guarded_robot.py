"""A robot behind a rosbridge, moved by trajectories under the guard.

The controller in ROS follows the whole trajectory itself (FollowJointTrajectory). The guard reads
joint states, wrenches and the controller's modes as they arrive. Whatever ends the motion before
its end, a stop by the guard, an error or Ctrl-C, cancels the goal and publishes the stop topic.
``scripts/examples/ros2`` shows a node beside the controller that acts on that topic, and on
silence: a websocket is no safety channel.
"""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import SafetyStop, WorkError
from limber.core.numerics.rigid import pose_vectors
from limber.core.numerics.rigid_kernels import frame_of, turn_between, turned_wrench
from limber.robot.driver.force_samples import (
    HoldUps,
    Reading,
    WrenchChain,
    guard_of,
    rehearse,
)
from limber.robot.driver.guard import GO, SAFETY_MODES, Decision, Verdict
from limber.robot.driver.real_time import spare_what_is_loaded
from limber.robot.interface import Sample
from limber.robot.motion.retreat import (
    FollowedPathFile,
    RetreatPath,
    read_followed_path,
    require_start,
)
from limber.robot.motion.trajectory import Trajectory
from limber.robot.recorder import PullPlausibility
from limber.robot.ros.bridge import SECONDS, Bridge
from limber.robot.ros.messages import (
    END,
    FOLLOW,
    JOINT_STATE,
    RUNNING,
    STATUS_KINDS,
    STOP,
    WRENCH,
    JointStates,
    Topics,
    goal_of,
    status_of,
    wrench_of,
    wrench_topic,
)

_LISTEN_SECONDS = 0.01
_BEAT_SECONDS = 0.1
_MOST_UNHEARD = 3  # beats that do not come back; the node beside the controller bears as many
_OLDEST_READING_SECONDS = 0.05
_STANDS_RAD_S = 1e-3
_SETTLE_SECONDS = 0.3
_STILL_RAD = 1e-3
_SUCCEEDED = 4  # action_msgs/msg/GoalStatus
_OFF_PATH_M = 0.02  # a ROS controller lags its trajectory by an unknown time


class RosRobot:
    """A cell's robot and force sensor as ROS reports them. ``on_sample`` is called with time [s],
    pose [6] and smoothed wrench [6], branch frame; ``warnings`` are delays of the loop and how a
    motion was broken off, ``reported`` what the controller says of itself, by the names of
    :class:`.Sample`. InputError as :func:`wrench_topic`, or for another arm's joint states;
    WorkError if a topic sends nothing."""

    def __init__(self, cell: Cell, bridge: Bridge, topics: Topics,
                 on_sample: Callable[[float, np.ndarray, np.ndarray], None] | None = None):
        self._cell, self._bridge, self._topics = cell, bridge, topics
        self._on_sample = on_sample
        self.guard = guard_of(cell, off_path=_OFF_PATH_M)
        self._chain = WrenchChain(cell)
        self._sensor = frame_of(np.array(cell.sensor.pose))
        self._base = frame_of(np.array(cell.base.pose))
        self._wrench_topic = wrench_topic(cell, topics.wrench)
        self._states = JointStates(cell)
        self._status = {getattr(topics, name): name for name in STATUS_KINDS
                        if cell.arm.controller == "ur"}
        self.reported: dict[str, Any] = {}
        self._unheard = 0
        self._stood, self._may_stand, self._stood_at, self._clock = 0.0, 0.0, np.zeros(0), 0.0
        self._rests = np.zeros(0)
        self._is_sent = False
        self._reading: Reading | None = None
        self._reading_at = 0.0
        self.last: Sample | None = None
        self.smooth = np.full(6, np.nan)
        self._goals = 0
        self.warnings: list[str] = []
        self._kept = FollowedPathFile(cell)
        self._way = RetreatPath(cell.arm.joint_names, read_followed_path(cell), self._kept)
        self._hold_ups = HoldUps(_LISTEN_SECONDS,
                                 lambda **event: self.warnings.append(event["text"]))
        for topic, kind in ((topics.joint_states, JOINT_STATE), (self._wrench_topic, WRENCH),
                            (topics.stop, STOP), (topics.end, END),
                            *((topic, STATUS_KINDS[name]) for topic, name in
                              self._status.items())):
            bridge.subscribe(topic, kind)
        bridge.advertise(topics.stop, STOP)
        bridge.advertise(topics.end, END)
        self._require_topics()

    def _require_topics(self) -> None:
        end = time.monotonic() + SECONDS
        while self.last is None or self._reading is None or (
                len(self.reported) < len(self._status)):
            if time.monotonic() > end:
                raise self._silent()
            self._take(self._bridge.receive(_LISTEN_SECONDS))

    def _silent(self) -> WorkError:
        """The error of a topic that sent nothing of use."""
        unheard = [topic for topic, name in self._status.items() if name not in self.reported]
        if self.last is not None and self._reading is not None:
            return WorkError(
                f"Nothing came on {', '.join(unheard)} within {SECONDS:g} s.",
                "Without it the guard does not see a protective stop, after whose release the arm "
                "would go on.",
                f"Start the arm's driver: ros2 launch ur_robot_driver ur_control.launch.py "
                f"ur_type:={self._cell.arm.name} robot_ip:=ADDRESS. It starts "
                "io_and_status_controller and speed_scaling_state_broadcaster. A driver that "
                "publishes the modes only when they change is too old.")
        if self.last is None and self._states.others:
            return WorkError(
                f"{self._topics.joint_states} does not have the joints of a "
                f"{self._cell.arm.name}: {', '.join(self._states.others)}.",
                f"Names with {', '.join(self._cell.arm.ros_joints)} are needed.",
                "Check robot.model in the cell file, and that the arm's driver runs.")
        silent = self._topics.joint_states if self.last is None else self._wrench_topic
        return WorkError(f"Nothing came on {silent} within {SECONDS:g} s.",
                         "The guard needs joint states and wrenches.",
                         "Check the topic's name with `ros2 topic list`, and that its node runs.")

    def _take(self, message: dict[str, Any] | None) -> Sample | None:
        """Process a message; returns its sample, if it is one."""
        if message is None or message.get("op") != "publish":
            return None
        topic, content, arrived = message.get("topic"), message["msg"], time.monotonic()
        if topic == self._wrench_topic:
            raw = wrench_of(content)
            self._reading_at = arrived
            self._reading = Reading(turned_wrench(self._sensor[:3, :3], raw, self._sensor[:3, 3]),
                                    0.0, raw)
            return None
        if topic == self._topics.stop:
            self._unheard = 0
        elif (name := self._status.get(topic)) is not None:
            self.reported[name] = status_of(name, content)
        elif topic == self._topics.joint_states and (sample := self._states.sample(
                content, arrived, RUNNING | self.reported)) is not None:
            self.last = sample
            return sample
        return None

    def watched(self, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Only read for ``seconds``: samples' arrival times [s], shape [n]; raw forces, [n, 3]."""
        times, forces = [], []
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if (sample := self._take(self._bridge.receive(_LISTEN_SECONDS))) is not None:
                assert self._reading is not None
                times.append(sample.arrived)
                forces.append(self._reading.wrench[:3])
        return np.array(times), np.array(forces).reshape(-1, 3)

    def recall_tare(self) -> None:
        """Judge forces by the tare of the leg before, as the gripper holds the branch now;
        SafetyStop if none is known."""
        followed = read_followed_path(self._cell)
        if followed is None or followed.bias is None:
            raise SafetyStop("No tare is known from the approach.",
                             "With the branch in the gripper the sensor cannot be tared.",
                             "Follow the approach first, then close the gripper.")
        self._chain.bias = followed.bias
        self._kept.tared(followed.bias)
        assert self.last is not None and self._reading is not None
        rehearse(self._cell, self.last, self._reading)
        self.guard.tared()

    def tare(self, seconds: float = 0.5) -> np.ndarray:
        """Tare the present force; return the standard error [6]. WorkError for too few readings, or
        if the gripper is touched."""
        self._chain.start_tare()
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if (sample := self._take(self._bridge.receive(_LISTEN_SECONDS))) is not None:
                assert self._reading is not None
                self._chain.wrench(sample, self._reading)
        sigma = self._chain.end_tare()
        assert self.last is not None and self._reading is not None
        rehearse(self._cell, self.last, self._reading)
        self.guard.tared(self._chain.at_rest)
        self._kept.begin()
        self._kept.tared(self._chain.bias)
        return sigma

    def follow(self, trajectory: Trajectory, *, goes_on: bool = False,
               check: PullPlausibility | None = None) -> dict[str, Any]:
        """Follow a trajectory to its end; return the event that ended it, as
        :meth:`.RobotLink.follow`. ``goes_on``: the branch is held as in the leg before, whose path
        belongs to this one; ``check`` stops it where its force cannot be right. SafetyStop if the
        arm is not at its start, or the guard refuses."""
        assert trajectory.joints is not None
        # It takes a while for a long path; what arrives meanwhile is read before it is sent.
        goal = goal_of(trajectory, self._states.ordered)
        # Or a garbage collection during the motion holds up the guard for a tenth of a second.
        spare_what_is_loaded()
        sample = self._newest()
        require_start(sample.pose, sample.joints, trajectory.poses[0], trajectory.joints[0],
                      self._cell.arm.joint_names)
        if np.abs(sample.joint_speeds).max() > _STANDS_RAD_S:
            raise _moves_already()
        expected = trajectory.expected
        if expected is not None and expected.wrenches.any() and not goes_on:
            clock = self._settled().clock
            self.guard.hold(self.smooth[:3] - expected.wrenches[0, :3], clock)
        self.guard.begin()
        self._way.begin(sample, trajectory, goes_on=goes_on)
        return self._watched_goal(trajectory, goal, check)

    def retreat(self) -> dict[str, Any]:
        """Go back along the followed path while the force falls, as a person has chosen; return
        ``reached``, or ``stopped`` with its reason, and the force left [N]. SafetyStop if the arm
        moves, left the path, or none is known, or the guard refuses."""
        assert self.last is not None
        before = self.last.joints
        spare_what_is_loaded()
        sample = self._settled()
        # By the way, not by the speed: its noise must not refuse a retreat that is needed.
        if not np.abs(sample.joints - before).max() <= _STILL_RAD:
            raise _moves_already()
        back = self._way.from_here(sample, self._cell.limits.acceleration_m_s2)
        goal = goal_of(back, self._states.ordered)
        self.guard.begin_retreat(self.smooth)
        event = self._watched_goal(back, goal)
        self._settled()
        return event | {"force_n": float(np.linalg.norm(self.smooth[:3]))}

    def _settled(self) -> Sample:
        """Read until the smoothed force is that of the arm at rest; returns the last sample."""
        end = time.monotonic() + _SETTLE_SECONDS
        while time.monotonic() < end:
            if (sample := self._take(self._bridge.receive(_LISTEN_SECONDS))) is not None:
                assert self._reading is not None
                _, self.smooth = self._chain.wrench(sample, self._reading)
        assert self.last is not None
        return self.last

    def close(self) -> None:
        """Make sure that the path is on disk, and close the connection."""
        self._kept.close()
        self._bridge.close()

    def _newest(self) -> Sample:
        """Read what has arrived; returns the last sample."""
        while (message := self._bridge.receive(0.0)) is not None:
            self._take(message)
        assert self.last is not None
        return self.last

    def _watched_goal(self, trajectory: Trajectory, content: dict[str, Any],
                      check: PullPlausibility | None = None) -> dict[str, Any]:
        """Send a trajectory as the goal ``content`` and watch it to its end; whatever ends this, an
        error or Ctrl-C too, cancels the goal and publishes a stop."""
        if (decision := self._modes()).verdict != Verdict.GO:
            raise SafetyStop(f"The arm cannot be moved: {decision}.", "Limber neither releases "
                             "stops nor starts the program on the controller.",
                             "Check the robot, and put it right at the pendant.")
        self._goals += 1
        self._is_sent, self._rests = False, _rests(trajectory)
        goal = f"limber-{self._goals}"
        try:
            return self._watch(trajectory, content, goal, check)
        except BaseException as error:
            self._break_off(goal, error)
            raise

    def _watch(self, trajectory: Trajectory, content: dict[str, Any], goal: str,
               check: PullPlausibility | None) -> dict[str, Any]:
        place, beat, is_echoed = 0, -np.inf, False
        self._unheard = 0
        self._hold_ups.set_off()
        while True:
            if time.monotonic() - beat > _BEAT_SECONDS:
                # Sign of life; the node beside the controller stops the arm when it ends.
                beat = time.monotonic()
                self._unheard += 1
                self._bridge.send(op="publish", topic=self._topics.stop, msg={"data": False})
            if not self._is_sent and (self._unheard == 0 or self._unheard > _MOST_UNHEARD):
                is_echoed = self._unheard == 0
                self._set_off(goal, content, is_echoed)
            message = self._bridge.receive(_LISTEN_SECONDS)
            if message is not None:
                self._hold_ups.note(None if self.last is None else self.last.arrived, moving=True)
            if (ended := self._ended(message, goal, trajectory)) is not None:
                return ended
            if (sample := self._take(message)) is not None:
                self._way.note(sample)
                place = self._nearest(trajectory, sample.joints, place)
                decision = self._judge(trajectory, sample, place, check)
                if decision.verdict == Verdict.GO:
                    decision = self._standstill(sample, place)
            elif (decision := self._modes()).verdict == Verdict.GO:
                decision = self._silence()
            if is_echoed and self._unheard > _MOST_UNHEARD:
                decision = self.guard.event(
                    "rosbridge passes on nothing while the goal runs, so no stop either: start it "
                    "with send_action_goals_in_new_thread:=true")
            if decision.verdict != Verdict.GO:
                return self._stop(goal, decision)

    def _set_off(self, goal: str, content: dict[str, Any], is_echoed: bool) -> None:
        """Send the goal. The beat came back before: a stop will be passed on too."""
        assert self.last is not None
        if not is_echoed:
            self.warnings.append(f"what Limber publishes on {self._topics.stop} does not come "
                                 "back from rosbridge: a stop may not be passed on")
        self._stood, self._stood_at, self._clock = 0.0, self.last.joints, self.last.clock
        self._may_stand = SECONDS + float(self._rests[0])
        self._is_sent = True
        self._bridge.send(op="send_action_goal", id=goal, action=self._topics.trajectory,
                          action_type=FOLLOW, feedback=False, args=content)
        self._hold_ups.set_off()

    def _modes(self) -> Decision:
        """Judge what the controller reports of itself now."""
        assert self.last is not None
        return self.guard.modes(replace(self.last, **self.reported))

    def _standstill(self, sample: Sample, place: int) -> Decision:
        """Judge that the arm stands under its goal for longer than its path rests there, in the
        controller's time, which its speed scales."""
        passed, self._clock = sample.clock - self._clock, sample.clock
        if not self._is_sent or np.abs(sample.joints - self._stood_at).max() > _STILL_RAD:
            self._stood, self._stood_at = 0.0, sample.joints
            self._may_stand = SECONDS + float(self._rests[place])
            return GO
        self._stood += passed * min(sample.slider, 1.0)
        if self._stood <= self._may_stand:
            return GO
        return self.guard.event(f"the arm has stood still for {self._stood:.1f} s under its goal")

    def _silence(self) -> Decision:
        """Judge that nothing arrived; a loop that was itself delayed listens once more."""
        assert self.last is not None
        self._hold_ups.note(self.last.arrived, moving=True)
        held_up = self._hold_ups.has_just_woken
        return self.guard.silence(0.0 if held_up else time.monotonic() - self.last.arrived)

    def _ended(self, message: dict[str, Any] | None, goal: str, trajectory: Trajectory,
               ) -> dict[str, Any] | None:
        """The external end of a goal: its result, or a stop by another party."""
        if message is None:
            return None
        if _is_result(message, goal):
            values = message.get("values")
            told = values if isinstance(values, dict) else {"error_string": values}
            if message.get("result") and message.get("status", _SUCCEEDED) == _SUCCEEDED and (
                    not told.get("error_code")):
                return self._arrived(goal, trajectory)
            why = told.get("error_string") or "no reason was given"
            return self._stop(goal, self.guard.event(
                f"the controller in ROS ended the motion ({why})"), is_over=True)
        if message.get("op") == "publish" and message.get("topic") == self._topics.stop and (
                message["msg"].get("data")):
            return self._stop(goal, self.guard.event("a stop was published"))
        return None

    def _arrived(self, goal: str, trajectory: Trajectory) -> dict[str, Any]:
        """The event of a goal that the controller calls reached."""
        assert self.last is not None
        off = float(np.linalg.norm(self.last.pose[:3] - trajectory.poses[-1, :3]))
        if not off <= _OFF_PATH_M:
            return self._stop(goal, self.guard.event(
                f"the controller in ROS calls its goal reached, but the arm is {1000 * off:.0f} mm "
                "away from its end"), is_over=True)
        self.guard.end()
        # The node beside the controller expects no more beats. Once this came back, rosbridge has
        # passed it on, and the connection may be closed.
        self._bridge.send(op="publish", topic=self._topics.end, msg={})
        end = time.monotonic() + _MOST_UNHEARD * _BEAT_SECONDS
        while time.monotonic() < end:
            message = self._bridge.receive(_LISTEN_SECONDS)
            self._take(message)
            if message is not None and message.get("topic") == self._topics.end:
                break
        return {"event": "reached"}

    def _judge(self, trajectory: Trajectory, sample: Sample, index: int,
               check: PullPlausibility | None) -> Decision:
        assert self._reading is not None
        reading = Reading(self._reading.wrench, sample.arrived - self._reading_at,
                          self._reading.raw)
        now, self.smooth = self._chain.wrench(sample, reading)
        grasp = self._base @ frame_of(sample.pose)
        if self._on_sample is not None:
            self._on_sample(sample.clock, sample.pose, self.smooth)
        if reading.age > _OLDEST_READING_SECONDS:
            return self.guard.event(f"the wrench has been silent for {reading.age:.3f} s")
        if check is not None and (reason := check.take(np.concatenate((
                [sample.clock], pose_vectors(grasp), now, self.smooth))[None])):
            return self.guard.event(f"implausible: {reason}")
        expected, uncertainty = self._expected(trajectory, sample, index)
        return self.guard.look(
            sample, wrench=now, raw=np.stack([reading.raw, reading.wrench]), expected=expected,
            uncertainty=uncertainty, grasp=grasp[:3, 3], sent=trajectory.poses[index, :3])

    def _expected(self, trajectory: Trajectory, sample: Sample, index: int,
                  ) -> tuple[np.ndarray | None, np.ndarray | None]:
        if trajectory.expected is None:
            return None, None
        wrench, slopes, covariance = trajectory.expected.at(min(index, len(trajectory.times) - 2),
                                                            0.0)
        planned = trajectory.poses[min(index, len(trajectory.times) - 2)]
        off = np.concatenate((sample.pose[:3] - planned[:3], turn_between(planned, sample.pose)))
        turn = self._base[:3, :3]
        return wrench + slopes @ np.concatenate((turn @ off[:3], turn @ off[3:])), covariance

    @staticmethod
    def _nearest(trajectory: Trajectory, joints: np.ndarray, index: int) -> int:
        """The position on the path nearest to ``joints``, searched from the last one on."""
        assert trajectory.joints is not None
        ahead = trajectory.joints[index:index + 50]
        return index + int(np.abs(ahead - joints).max(axis=1).argmin())

    def _stop(self, goal: str, decision: Decision, *, is_over: bool = False) -> dict[str, Any]:
        """Stop on both channels, and check that the arm is at rest."""
        self.guard.event(str(decision))
        stands, reason = self._cancelled(goal, is_over=is_over), str(decision)
        # Of a protective stop the ended program may be heard first.
        mode = SAFETY_MODES.get(int(self.reported.get("safety_mode", RUNNING["safety_mode"])))
        if mode is not None and mode not in reason:
            reason += f" ({mode})"
        return {"event": "stopped", "reason": reason, "stands": stands}

    def _cancelled(self, goal: str, *, is_over: bool = False) -> bool:
        """Cancel a goal and publish a stop until it has ended; return whether the arm stands.
        Rosbridge drops the cancel of a goal not accepted yet, and what it has not processed when
        the connection closes."""
        end, said, stands = time.monotonic() + SECONDS, -np.inf, False
        is_over = is_over or not self._is_sent
        while True:
            if time.monotonic() - said > _BEAT_SECONDS:
                said = time.monotonic()
                self._bridge.send(op="publish", topic=self._topics.stop, msg={"data": True})
                self._bridge.send(op="cancel_action_goal", id=goal, action=self._topics.trajectory)
            message = self._bridge.receive(_LISTEN_SECONDS)
            is_over = is_over or _is_result(message, goal)
            # A message that broke the motion off may come again; here it only does not show where
            # the arm is.
            with suppress(Exception):
                if (sample := self._take(message)) is not None:
                    stands = bool(np.abs(sample.joint_speeds).max() < _STANDS_RAD_S)
            if is_over and stands:
                return True
            if time.monotonic() > end:
                break
        if not is_over:
            self.warnings.append("the controller in ROS did not confirm within "
                                 f"{SECONDS:g} s that its goal is cancelled: check the robot")
        return stands

    def _break_off(self, goal: str, error: BaseException) -> None:
        """Cancel a goal because of an error, which is still to be raised."""
        self.guard.event("the motion was broken off")
        try:
            stands = self._cancelled(goal)
        except ConnectionError as lost:
            if error is not lost and not isinstance(error, ConnectionError):
                self.warnings.append(f"the motion was broken off, but {lost}: whether the arm "
                                     "stands is not known. Check the robot; its stop node acts on "
                                     "silence")
            return
        self.warnings.append("the motion was broken off: its goal was cancelled and a stop was "
                             "published. The arm " + (
                                 "stands" if stands else f"did not stand within {SECONDS:g} s"))


def _rests(trajectory: Trajectory) -> np.ndarray:
    """How long a trajectory stays near each of its rows, or the rows beside it [s], shape [n]."""
    assert trajectory.joints is not None
    ways = np.r_[0.0, np.abs(np.diff(trajectory.joints, axis=0)).max(axis=1).cumsum()]
    ends = np.searchsorted(ways, ways + _STILL_RAD, side="right")
    rests = trajectory.times[np.minimum(ends, len(ways) - 1)] - trajectory.times
    return np.maximum(rests, np.maximum(np.r_[rests[0], rests[:-1]], np.r_[rests[1:], 0.0]))


def _is_result(message: dict[str, Any] | None, goal: str) -> bool:
    return message is not None and message.get("op") == "action_result" and (
        message.get("id") == goal)


def _moves_already() -> SafetyStop:
    return SafetyStop("The arm moves already.", "Something else drives it.",
                      "Stop it, and begin again.")
