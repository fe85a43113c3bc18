"""A robot in ROS and its driver in this process, in the server's time."""

import contextlib
import json
import runpy
from collections import deque
from pathlib import Path
from unittest.mock import patch

import numpy as np

from benchmarks import robot_rosbridge
from benchmarks.robot_rosbridge import STEP, RosBridge
from benchmarks.robot_stepped import SteppedRobot
from limber.cell.cell_file import Cell
from limber.core.numerics.rigid import inverted, matrices, pose_vectors
from limber.robot.motion.joint_path import joint_path
from limber.robot.motion.trajectory import ExpectedWrench, Trajectory, along, densely
from limber.robot.ros import ros_control
from limber.robot.ros.bridge import Bridge
from limber.robot.ros.topics import Topics

_NODE = Path(__file__).parents[2] / "scripts/examples/ros2/limber_stop/limber_stop/watch.py"
ROS_CELL = Cell(robot={"model": "ur5e", "address": "ws://stepped"}, base={"pose": (0,) * 6},
                tool={"grasp_pose": (0, 0, 0.15, 0, 0, 0), "mass_kg": 0.0})
HOME, TOOL = np.array(ROS_CELL.arm.home), matrices(np.array(ROS_CELL.tool.grasp_pose))


def line(way: float, speed: float = 0.05) -> Trajectory:
    """A line from home by ``way`` [m], with its joints; no force is expected on it."""
    start = pose_vectors(ROS_CELL.arm.forward(HOME) @ TOOL)
    poses = densely(np.array([start, start + [0, way, 0, 0, 0, 0]]))
    joints = joint_path(ROS_CELL.arm, matrices(poses) @ inverted(TOOL), start=HOME).joints
    return Trajectory(along(poses, speed, 0.5), poses, ExpectedWrench.nothing(poses), joints)


def to_and_fro(out: Trajectory, rest: float, cycles: int = 1) -> Trajectory:
    """A trajectory and its return, after a ``rest`` [s] each, as often."""
    legs = [out, out.backwards()] * cycles
    poses = np.concatenate([each.poses for each in legs])
    times = [number * (out.duration + rest) + each.times for number, each in enumerate(legs)]
    return Trajectory(np.concatenate(times), poses, ExpectedWrench.nothing(poses),
                      np.concatenate([each.joints for each in legs]))


class ServoBridge(RosBridge):
    """MoveIt Servo's end: it moves the joints by the last speeds that came, or by the twist of the
    flange in the axes of a frame, for ``holds`` [s], and not at all once it ``is_paused``."""

    until, holds, is_paused = 0.0, 0.1, False
    axes = np.eye(3)  # of the frame "base" against the controller's

    def _hear(self, socket, order):
        super()._hear(socket, order)
        if order["op"] == "publish" and order["topic"] == Topics().jog:
            speeds = dict(zip(order["msg"]["joint_names"], order["msg"]["velocities"], strict=True))
            self.drift = np.array([speeds[f"{name}_joint"] for name in ROS_CELL.arm.ros_joints])
            self.until = self.holds / STEP
        elif order["op"] == "publish" and order["topic"] == Topics().twist:
            assert order["msg"]["header"]["frame_id"] == "base"
            parts = (order["msg"]["twist"][kind] for kind in ("linear", "angular"))
            self.drift = np.linalg.solve(ROS_CELL.arm.jacobian(self.joints), np.concatenate(
                [self.axes @ [part[axis] for axis in "xyz"] for part in parts]))
            self.until = self.holds / STEP

    def _step(self, socket):
        self.until -= 1
        self.drift = self.drift * (self.until > 0 and not (self.sticks or self.is_paused))
        super()._step(socket)


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
        if any(stops) or self._watch.is_silent(self.now):
            self.server.is_paused = True
            if self.server.is_busy:
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
