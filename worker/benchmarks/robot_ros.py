"""The door to ROS 2 against a rosbridge server: samples lost at 125 Hz, and the stop's time."""

import os
import tempfile
import threading
import time
from collections import deque
from functools import partial
from unittest.mock import patch

import numpy as np

from benchmarks.machine_stalls import Voided
from benchmarks.robot_rosbridge import STEP, RosBridge
from benchmarks.table import Asked, Row, Setting
from limber.cell.cell_file import Cell
from limber.core.numerics.rigid import inverted, matrices, pose_vectors
from limber.robot.driver.real_time import claim_real_time, keep_awake
from limber.robot.motion.joint_path import joint_path
from limber.robot.motion.trajectory import ExpectedWrench, Trajectory, along, densely
from limber.robot.ros.bridge import Bridge
from limber.robot.ros.guarded_robot import RosRobot, Topics

LEAST_ROS_S = 30.0
_ASKED_S, _STOP_S, _STOPS = 600.0, 0.1, 5
_AROUND_S = 25.0
ROS_ROWS = (Asked("a path through rosbridge at 125 Hz for 600 s, wrench in: samples lost", "0"),
            Asked("stop published in ROS until the arm stands, worst", "100 ms"))
_CELL = Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6},
             tool={"grasp_pose": (0, 0, 0.15, 0, 0, 0), "mass_kg": 0.0})
_HOME = np.array(_CELL.arm.home)


def ros_door(setting: Setting, voided: Voided) -> list[Row]:
    """Follow a path for as long as there is time, at most the 600 s that are asked; then stop it.

    A run in which the machine stood still for longer than the guard allows is done again.
    """
    seconds = 10.0 if setting.quick else min(_ASKED_S, setting.budget.remaining - _AROUND_S)
    claim_real_time()
    keep_awake()
    with tempfile.TemporaryDirectory() as state, patch.dict(os.environ, LIMBER_STATE=state):
        try:
            lost, count = voided.again(partial(_lost, seconds), "path through rosbridge")
            told = f"{lost} of {count} in {seconds:.0f} s{voided}"
        except AssertionError as error:
            lost, told = 1, f"stopped: {error}{voided}"
        stops = [voided.again(_stopped, "stop in ROS") for _ in range(_STOPS)]
    is_met = False if lost else True if seconds >= _ASKED_S else None
    return [Row(*ROS_ROWS[0], told, is_met),
            Row(*ROS_ROWS[1], f"{1000 * max(stops):.0f} ms", max(stops) < _STOP_S, len(stops))]


def _lost(seconds: float) -> tuple[int, int]:
    """Samples between the first and the last of a path that the guard did not see; and all."""
    times: list[float] = []
    with RosBridge(_HOME) as server:
        # The server is another program in reality: a million objects that it keeps here would be
        # searched by the guard's garbage collector.
        server.sent = deque(maxlen=0)
        robot = RosRobot(_CELL, Bridge(server.url), Topics(),
                         lambda clock, pose, wrench: times.append(clock))
        robot.tare(0.25)
        event = robot.follow(_path(seconds))
        robot.close()
    assert event["event"] == "reached", event["reason"]
    steps = np.round(np.diff(times) / STEP).astype(int)
    return int((steps - 1).sum()), int(steps.sum()) + 1


def _stopped() -> float:
    """Time from a stop on the topic until the arm stands [s]."""
    with RosBridge(_HOME) as server:
        robot = RosRobot(_CELL, Bridge(server.url), Topics())
        robot.tare(0.25)
        published: list[float] = []

        def publish() -> None:
            published.append(time.monotonic())
            server.publish("/limber/stop", {"data": True})
        threading.Timer(0.5, publish).start()
        event = robot.follow(_path(5.0))
        robot.close()
        assert event["event"] == "stopped" and event["stands"], event
        return float(server.stood_at) - published[0]


def _path(seconds: float) -> Trajectory:
    """A line to and fro at 30 mm/s, for about ``seconds`` [s]."""
    tool = matrices(np.array(_CELL.tool.grasp_pose))
    start = pose_vectors(_CELL.arm.forward(_HOME) @ tool)
    out = densely(np.array([start, start + [0, 0.1, 0, 0, 0, 0]]))
    joints = joint_path(_CELL.arm, matrices(out) @ inverted(tool), start=_HOME).joints
    leg = along(out, 0.03, 0.3)
    count = max(2, round(seconds / leg[-1]))
    times = np.concatenate([number * (leg[-1] + 0.02) + (
        leg if number % 2 == 0 else leg[-1] - leg[::-1]) for number in range(count)])
    order = np.arange(len(out))
    rows = np.concatenate([order if number % 2 == 0 else order[::-1] for number in range(count)])
    poses = out[rows]
    return Trajectory(times, poses, ExpectedWrench.nothing(poses), joints[rows])
