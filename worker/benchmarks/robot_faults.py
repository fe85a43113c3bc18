"""Faults of a robot while it moves: each must end in standstill and a report."""

import os
import signal
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from limber.core.errors import LimberError
from limber.robot.cell.cell import Cell
from limber.robot.driver.link import RobotLink
from limber.robot.known_arms import arm_named
from limber.robot.motion.expected_wrench import ExpectedWrench
from limber.robot.motion.trajectory import Trajectory, along, densely
from limber.robot.virtual.launch import VirtualRobot
from limber.robot.virtual.server import SCRIPT_PORT

STILL_M_S = 1e-4
_TARE_READINGS = 25
_AT_SPEED = 0.95  # of the trajectory's: it comes near to it slowly at the end
_START_SECONDS = 10.0


@dataclass(frozen=True)
class Outcome:
    """Result of a fault.

    Attributes:
        report: Message to the user.
        standstill_s: From the fault until the arm was at standstill, by its own state; NaN if the
            robot itself is gone.
        way_m: Distance that the tool still moved.
    """

    report: str
    standstill_s: float
    way_m: float


Fault = Callable[[VirtualRobot, RobotLink], None]


def _asked(action: str, **values: object) -> Fault:
    return lambda robot, link: robot.ask(action, **values) and None


FAULTS: dict[str, Fault] = {
    "connection cut": _asked("cut"),
    "controller killed": lambda robot, link: robot.kill(),
    "protective stop": _asked("protective_stop"),
    "emergency stop": _asked("emergency_stop"),
    "local mode": _asked("local"),
    "program stopped": _asked("stop_program"),
    "silent port": _asked("silent"),
    "frozen sensor": _asked("frozen_sensor"),
    "sensor NaN": _asked("sensor_nan"),
    "force spike": _asked("added_wrench", wrench=[0, 0, 40, 0, 0, 0]),
    "torque limit": _asked("added_wrench", wrench=[0, 0, 0, 0, 4.5, 0]),
    "clock jump": _asked("clock_jump", value=7.0),
    "worker killed": lambda robot, link: link.process.kill(),
    "add-on closed": lambda robot, link: link.abandon(),
    "200 ms cable delay": _asked("delay", value=0.2),
    "keep-alive starved": lambda robot, link: os.kill(link.process.pid, signal.SIGSTOP),
    "two clients": lambda robot, link: _another_program(robot.address),
    "drift of 4 N": _asked("added_wrench", wrench=[0, 0, 4.2, 0, 0, 0]),
}
ENDS_ROBOT = ("controller killed",)


def _another_program(address: str) -> None:
    """Send a program to the controller, as a second client does: it replaces the first."""
    with socket.create_connection((address, SCRIPT_PORT), 2.0) as other:
        other.sendall(b"def another():\n  sync()\nend\n")
        time.sleep(0.1)


def cell_for(address: str, model: str = "ur5e") -> Cell:
    """Return a cell of a virtual robot whose base is the branch's frame."""
    kind = "controller" if arm_named(model).measures_force else "ft300"
    return Cell(robot={"model": model, "address": address}, base={"pose": (0.0,) * 6},
                sensor={"kind": kind})


def straight(robot: VirtualRobot, way: tuple[float, float, float], speed: float = 0.05,
             *, expected: bool = True) -> Trajectory:
    """Return a line from where the robot is, on which no force is expected."""
    start = np.array(robot.state["pose"])
    poses = densely(np.array([start, start + np.r_[way, 0, 0, 0]]))
    return Trajectory(along(poses, speed, 0.3), poses,
                      ExpectedWrench.nothing(poses) if expected else None)


def tared(link: RobotLink) -> None:
    """Tare the sensor as soon as the robot reports its state."""
    link.wait_for_samples()
    link.tare(_TARE_READINGS / link.facts["rate_hz"])


def set_off(robot: VirtualRobot, link: RobotLink, trajectory: Trajectory) -> dict[str, Any]:
    """Tare, start a trajectory, and return the robot's state when the arm is at full speed.

    Raises:
        AssertionError: it does not reach that speed; the reason is that of the stop.
    """
    tared(link)
    link.start(trajectory)
    wanted = _AT_SPEED * trajectory.greatest_speeds[0]
    # A busy machine starts the motion later.
    given_up = time.monotonic() + _START_SECONDS
    while np.linalg.norm((state := robot.state)["tool_speed"][:3]) < wanted:
        if time.monotonic() > given_up:
            told = link.wait("stopped", seconds=1.0)["reason"]
            raise AssertionError(f"it did not move: {told}")
        time.sleep(0.01)
    return state


def provoke(name: str, robot: VirtualRobot, cell: Cell, seconds: float = 3.0) -> Outcome:
    """Move the robot, provoke a fault during the motion, and watch it from the robot's side.

    Raises:
        AssertionError: it did not come to a standstill, or nothing was reported.
    """
    with RobotLink(cell) as link:
        before = set_off(robot, link, straight(robot, (0.0, 0.2, 0.0)))
        began = time.monotonic()
        FAULTS[name](robot, link)
        standstill, way = float("nan"), float("nan")
        if name not in ENDS_ROBOT:
            while True:
                state = robot.state
                now = time.monotonic() - began
                if np.linalg.norm(state["tool_speed"][:3]) < STILL_M_S:
                    standstill = now
                    break
                assert now < seconds, f"{name}: still moving after {seconds} s"
                time.sleep(0.002)
            time.sleep(0.3)
            after = robot.state
            assert np.linalg.norm(after["tool_speed"][:3]) < STILL_M_S, f"{name}: moves again"
            way = float(np.linalg.norm(np.subtract(after["pose"][:3], before["pose"][:3])))
        if name == "keep-alive starved":
            os.kill(link.process.pid, signal.SIGCONT)
        try:
            report = link.wait("stopped", seconds=seconds)["reason"]
        except LimberError as error:
            report = str(error)
    assert report, f"{name}: nothing was reported"
    return Outcome(report, standstill, way)


def restored(robot: VirtualRobot) -> None:
    """Restore a robot after a fault, as a person at its pendant would."""
    for action, values in (("silent", False), ("delay", 0.0), ("frozen_sensor", False),
                           ("sensor_nan", False), ("clock_jump", 0.0), ("slider", 1.0),
                           ("outputs", 0)):
        robot.ask(action, value=values)
    robot.ask("added_wrench", wrench=[0.0] * 6)
    robot.ask("unlock")
    robot.ask("reset_emergency")
    robot.ask("remote")
    robot.ask("home")


def new_robot(address: str, model: str, seed: int) -> VirtualRobot:
    """Return a virtual robot; a CB3 has an FT300."""
    options = ["--seed", str(seed)] + (
        [] if arm_named(model).measures_force else ["--ft300"])
    return VirtualRobot(model, address, options)
