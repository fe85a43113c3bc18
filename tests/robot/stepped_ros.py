"""A robot in ROS and its driver in this process, in the server's time."""

import contextlib
import json
import runpy
from collections import deque
from pathlib import Path
from unittest.mock import patch

from benchmarks import robot_rosbridge
from benchmarks.robot_rosbridge import STEP
from benchmarks.robot_stepped import SteppedRobot
from limber.robot.ros import ros_control
from limber.robot.ros.bridge import Bridge

_NODE = Path(__file__).parents[2] / "scripts/examples/ros2/limber_stop/limber_stop/watch.py"


class SteppedRos(SteppedRobot):
    """A robot in ROS and its driver in this process, in the server's time.

    Args:
        server: A :class:`RosBridge`, not entered.
        plan: Called in each step with its number since the last goal came.
        has_node: Whether the example's node runs beside the controller.
    """

    def __init__(self, server, plan=None, *, has_node=False):
        self.server, self.plan, self.now = server, plan, 0.0
        self.address, self.each_step = "ws://stepped", lambda: None
        self.drivers, self.is_driven, self._seen_before = [], False, ()
        self.bridge, self._count, self.since, self._told = None, 0, None, {}
        self._watch = runpy.run_path(str(_NODE))["Watch"]() if has_node else None
        self._heard = 0
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
        if self._watch is not None:
            self._look_after_it()

    def _look_after_it(self):
        """What the node beside the controller does."""
        heard, self._heard = self.server.heard[self._heard:], len(self.server.heard)
        words = [order for _, order in heard if order["op"] == "publish"]
        stops = [self._watch.heard(order["msg"]["data"], self.now)
                 for order in words if order["topic"].endswith("/stop")]
        if any(order["topic"].endswith("/end") for order in words):
            self._watch.ended()
        if (any(stops) or self._watch.is_silent(self.now)) and self.server.is_busy:
            self.end_goal(5)

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
        self._robot, self.texts, self.is_lost = robot, deque(), False

    def send(self, order=None, **content):
        """Carry out an operation; of the server: take what it sends."""
        if isinstance(order, str):
            self.texts.append(order)
            return
        self._require_connection()
        self._robot.server.obey(self, content)
        if content["op"] == "send_action_goal":
            self._robot.since = 0

    def receive(self, seconds):
        """Return the next message, if any; before, where none waits, time passes."""
        self._require_connection()
        if not self.texts and seconds > 0.0:
            self._robot.step()
        return json.loads(self.texts.popleft()) if self.texts else None

    def _require_connection(self):
        if self.is_lost:
            raise ConnectionError("the connection to rosbridge was lost")

    def close(self):
        """Nothing is open."""
