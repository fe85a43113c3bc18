"""The door to ROS 2 against a rosbridge server: samples lost at 125 Hz, and the stop's time."""

import os
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from unittest.mock import patch

import numpy as np

from benchmarks.machine_stalls import Voided
from benchmarks.robot_ros_stepped import HOME, ROS_CELL, line, to_and_fro
from benchmarks.robot_rosbridge import STEP, RosBridge
from benchmarks.table import Asked, Row, Setting
from limber.robot.driver.link import RobotLink
from limber.robot.driver.real_time import claim_real_time, keep_awake
from limber.robot.motion.trajectory import Trajectory

LEAST_ROS_S = 30.0
_ASKED_S, _STOP_S, _STOPS, _AROUND_S = 600.0, 0.1, 5, 25.0
ROS_ROWS = (Asked("a path through rosbridge at 125 Hz for 600 s, wrench in: samples lost", "0"),
            Asked("stop published in ROS until the arm stands, worst", "100 ms"))


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
    rows: list[np.ndarray] = []
    with RosBridge(HOME) as server:
        server.sent = deque(maxlen=0)
        with linked(server, rows.append) as link:
            event = link.follow(_path(seconds))
    assert event["event"] == "reached", event["reason"]
    steps = np.round(np.diff(np.concatenate(rows)[:, 0]) / STEP).astype(int)
    return int((steps - 1).sum()), int(steps.sum()) + 1


def _stopped() -> float:
    """Time from a stop on the topic until the arm stands [s]."""
    with RosBridge(HOME) as server, linked(server) as link:
        published: list[float] = []

        def publish() -> None:
            published.append(time.monotonic())
            server.publish("/limber/stop", {"data": True})
        threading.Timer(0.5, publish).start()
        event = link.follow(_path(5.0))
        assert event["event"] == "stopped", event
        time.sleep(_STOP_S)
        return float(server.stood_at) - published[0]


@contextmanager
def linked(server: RosBridge, taken: Callable[[np.ndarray], None] | None = None,
            ) -> Iterator[RobotLink]:
    """A tared link to the server's robot."""
    cell = ROS_CELL.model_copy(update={"robot": ROS_CELL.robot.model_copy(
        update={"address": server.url})})
    with RobotLink(cell, taken) as link:
        link.wait_for_samples()
        link.tare(0.25)
        yield link


def _path(seconds: float) -> Trajectory:
    """A line to and fro at 30 mm/s, for about ``seconds`` [s]."""
    leg = line(0.1, 0.03)
    return to_and_fro(leg, 0.02, max(1, round(0.5 * seconds / leg.duration)))
