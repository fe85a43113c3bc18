"""A robot in ROS and its driver in the test's process, in the server's time; and a replay."""

import contextlib
import json
from collections import deque
from unittest.mock import patch

import numpy as np

from benchmarks import robot_rosbridge
from benchmarks.robot_rosbridge import STEP, RosBridge
from benchmarks.robot_stepped import SteppedRobot
from limber.robot.ros import ros_control
from limber.robot.ros.bridge import Bridge


class SteppedRos(SteppedRobot):
    """A robot in ROS and its driver in this process, in the server's time.

    Args:
        server: A :class:`RosBridge`, not entered.
        plan: Called in each step with its number since the last goal came.
    """

    def __init__(self, server, plan=None):
        self.server, self.plan, self.now = server, plan, 0.0
        self.address, self.each_step = "ws://stepped", lambda: None
        self.drivers, self.is_driven, self._seen_before = [], False, ()
        self.bridge, self._count, self.since, self._told = None, 0, None, {}
        server.transports = set()

    def step(self):
        """Let the server take a step, and send what it publishes."""
        self._count += 1
        self.now += STEP
        if self.since is not None:
            self.since += 1
            if self.plan is not None:
                self.plan(self.since)
        if self.bridge is not None:
            self.server.turn(self.bridge, self._count, self._told)
            self.bridge.send_held()

    @contextlib.contextmanager
    def here(self):
        """Let drivers and whoever reads the robot connect to this one, and in its time."""
        def connected(_url):
            self._told = {}
            self.bridge = SteppedBridge(self)
            return self.bridge
        with super().here(), patch.object(ros_control, "Bridge", connected), patch.object(
                robot_rosbridge, "time", ros_control.time):
            yield self

    def end_goal(self, status, **values):
        """Let the controller end the goal."""
        self.server.end_goal(self.bridge, status, **values)


class SteppedBridge(Bridge):
    """A connection to a :class:`SteppedRos`, which takes a step whenever its client waits; it
    stands for :class:`limber.robot.ros.bridge.Bridge`."""

    def __init__(self, robot):
        self._robot, self.texts, self._held = robot, deque(), []

    def send(self, order=None, **content):
        """Carry out an operation; of the server: take what it sends."""
        if isinstance(order, str):
            self.texts.append(order)
            return
        if self._robot.server.blocks and self._robot.server.is_busy:
            self._held.append(content)
            return
        self._robot.server.obey(self, content)
        if content["op"] == "send_action_goal":
            self._robot.since = 0

    def send_held(self):
        """Carry out what waited for the end of a goal."""
        while self._held and not self._robot.server.is_busy:
            self._robot.server.obey(self, self._held.pop(0))

    def receive(self, seconds):
        """Return the next message, if any; before, where none waits, time passes."""
        if not self.texts and seconds > 0.0:
            self._robot.step()
        return json.loads(self.texts.popleft()) if self.texts else None

    def close(self):
        """Nothing is open."""


class ReplayedBridge(RosBridge):
    """Sends recorded messages at their times; its arm moves as it was recorded.

    Args:
        messages: Times [s], topics and contents, by time.
    """

    def __init__(self, messages):
        super().__init__(np.zeros(6))
        self._messages = deque(messages)

    def turn(self, socket, count, told):
        self._send_status(socket, told)
        while self._messages and self._messages[0][0] < (count + 0.5) * STEP:
            _, topic, message = self._messages.popleft()
            socket.send(json.dumps({"op": "publish", "topic": topic, "msg": message}))
