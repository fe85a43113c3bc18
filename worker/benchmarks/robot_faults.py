"""Faults of a robot while it moves: each must end in standstill, and a report that names it."""

import os
import re
import signal
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.half_open import Cable, Direction
from limber.cell.cell_file import Cell
from limber.cell.known_arms import arm_named
from limber.core.errors import LimberError
from limber.robot.driver.link import RobotLink
from limber.robot.motion.trajectory import ExpectedWrench, Trajectory, along, densely
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
        is_named: Whether it says what the fault is.
        standstill_s: From the fault until the arm was at standstill, by its own state; NaN if the
            robot itself is gone.
        way_m: Distance that the tool still moved.
    """

    report: str
    is_named: bool
    standstill_s: float
    way_m: float


Fault = Callable[[VirtualRobot, RobotLink], None]


def _asked(action: str, **values: object) -> Fault:
    return lambda robot, link: robot.ask(action, **values) and None


def _slow_push(robot: VirtualRobot, link: RobotLink) -> None:
    """A force that grows by 5 N a second, as of something that is pushed along."""
    for force in np.arange(0.0, 8.0, 0.1):
        robot.ask("added_wrench", wrench=[0, 0, float(force), 0, 0, 0])
        time.sleep(0.02)


def _button_and_back(robot: VirtualRobot, link: RobotLink) -> None:
    """An emergency stop that is reset before anybody can have looked."""
    robot.ask("emergency_stop")
    robot.ask("reset_emergency")


EVERY: dict[str, tuple[str, Fault]] = {
    "connection cut": ("lost|closed|no data", _asked("cut")),
    "controller killed": ("lost|closed|no data", lambda robot, link: robot.kill()),
    "protective stop": ("protective stop", _asked("protective_stop")),
    "emergency stop": ("emergency stop", _asked("emergency_stop")),
    "local mode": ("program", _asked("local")),
    "program stopped": ("program", _asked("stop_program")),
    "silent port": ("no data", _asked("silent")),
    "frozen sensor": ("frozen", _asked("frozen_sensor")),
    "sensor NaN": ("no number", _asked("sensor_nan")),
    "force spike": ("force", _asked("added_wrench", wrench=[0, 0, 40, 0, 0, 0])),
    "torque limit": ("torque", _asked("added_wrench", wrench=[0, 0, 0, 0, 4.5, 0])),
    "clock jump": ("clock jumped", _asked("clock_jump", value=7.0)),
    "worker killed": ("driver has ended", lambda robot, link: link.process.kill()),
    "add-on closed": ("program that drives the robot|driver", lambda robot, link: link.abandon()),
    "200 ms cable delay": ("no data", _asked("delay", value=0.2)),
    "keep-alive starved": (
        "no data|program", lambda robot, link: os.kill(link.process.pid, signal.SIGSTOP)),
    "two clients": ("program", lambda robot, link: _another_program(robot.address)),
    "drift of 4 N": ("force", _asked("added_wrench", wrench=[0, 0, 4.2, 0, 0, 0])),
    "slider at 0": ("scales the speed to 0", _asked("slider", value=0.0)),
    "slider at a fifth": ("speed slider", _asked("slider", value=0.2)),
    "paused on the pendant": ("program", _asked("pause")),
    "safeguard stop": ("safeguard stop", _asked("safeguard_stop")),
    "reduced mode": ("reduced mode", _asked("reduced")),
    "arm switched off": ("not running|program", _asked("power_off")),
    "emergency stop, reset at once": ("emergency stop|program", _button_and_back),
    "tool moved by 5 mm": (
        "tool centre point .* 5.0 mm", _asked("tool", offset=[0.005, 0, 0, 0, 0, 0])),
    "tool turned by 3 degrees": (
        "tool centre point .* 3.0 degrees", _asked("tool", offset=[0, 0, 0, 0, 0.052, 0])),
    "payload changed by 0.3 kg": ("payload", _asked("payload", value=0.3)),
    "sensor at its range": (
        "end of its range", _asked("added_wrench", wrench=[150, 0, 0, 0, 0, 0])),
    "slow push": ("force", _slow_push),
    "joints are no numbers": ("no number", _asked("joints_nan")),
    "clock stands": ("clock", _asked("clock_stands")),
    "clock runs backwards": ("clock", _asked("clock_jump", value=-1.0)),
    "cable carries nothing to the robot": ("program|answer", lambda robot, link: None),
    "cable carries nothing from the robot": ("no data|answer", lambda robot, link: None),
    "FT300 silent": ("silent", _asked("ft300_fault", value="silent")),
    "FT300 sends nonsense": ("silent", _asked("ft300_fault", value="nonsense")),
    "FT300 cut off": ("FT300 closed", _asked("ft300_fault", value="cut")),
    "FT300 force spike": ("force", _asked("added_wrench", wrench=[0, 0, 40, 0, 0, 0])),
    "FT300 frozen": ("frozen", _asked("frozen_sensor")),
}
"""Each with what the report must contain, as a regular expression."""
ENDS_ROBOT = ("controller killed",)
_DIRECTIONS: dict[str, Direction] = {
    "cable carries nothing to the robot": "to the robot",
    "cable carries nothing from the robot": "from the robot"}
def model_for(name: str) -> str:
    """Return the arm on which a fault is provoked."""
    return "ur5" if name.startswith("FT300") else "ur5e"


def _another_program(address: str) -> None:
    """Send a program to the controller, as a second client does: it replaces the first."""
    with socket.create_connection((address, SCRIPT_PORT), 2.0) as other:
        other.sendall(b"def another():\n  sync()\nend\n")
        time.sleep(0.1)


def cell_for(address: str, model: str = "ur5e") -> Cell:
    """Return a cell of a virtual robot in free air, whose base is the branch's frame."""
    kind = "controller" if arm_named(model).measures_force else "ft300"
    return Cell(robot={"model": model, "address": address}, base={"pose": (0.0,) * 6},
                sensor={"kind": kind}, limits={"contact_n_per_m": 1000.0})


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
    direction = _DIRECTIONS.get(name)
    if direction is None:
        _, fault = EVERY[name]
        return _provoked(name, robot, cell, lambda link: fault(robot, link), seconds)
    number = int(cell.robot.address.rsplit(".", 1)[-1])
    address = f"127.0.0.{number + 60}"
    with Cable(address, cell.robot.address) as cable:
        beyond = cell.model_copy(update={"robot": cell.robot.model_copy(update={
            "address": address})})
        return _provoked(name, robot, beyond, lambda link: cable.cut(direction), seconds)


def _provoked(name: str, robot: VirtualRobot, cell: Cell, fault: Callable[[RobotLink], None],
              seconds: float) -> Outcome:
    with RobotLink(cell) as link:
        before = set_off(robot, link, straight(robot, (0.0, 0.2, 0.0)))
        began = time.monotonic()
        fault(link)
        standstill, way = float("nan"), float("nan")
        if name not in ENDS_ROBOT:
            standstill, way = _stood(name, robot, before, began, seconds)
        if name == "keep-alive starved":
            os.kill(link.process.pid, signal.SIGCONT)
        try:
            report = link.wait("stopped", seconds=seconds)["reason"]
        except LimberError as error:
            report = str(error)
    assert report, f"{name}: nothing was reported"
    return Outcome(report, re.search(EVERY[name][0], report) is not None, standstill, way)


def _stood(name: str, robot: VirtualRobot, before: dict[str, Any], began: float, seconds: float,
           ) -> tuple[float, float]:
    """Wait until the arm stands, and look again; returns when [s], and its way since [m]."""
    while True:
        state = robot.state
        standstill = time.monotonic() - began
        if np.linalg.norm(state["tool_speed"][:3]) < STILL_M_S:
            break
        assert standstill < seconds, f"{name}: still moving after {seconds} s"
        time.sleep(0.002)
    time.sleep(0.3)
    after = robot.state
    assert np.linalg.norm(after["tool_speed"][:3]) < STILL_M_S, f"{name}: moves again"
    flanges = arm_named(robot.model).forward(np.array([before["joints"], after["joints"]]))
    return standstill, float(np.linalg.norm(flanges[1, :3, 3] - flanges[0, :3, 3]))


def restored(robot: VirtualRobot) -> None:
    """Restore a robot after a fault, as a person at its pendant would."""
    for action, values in (("silent", False), ("delay", 0.0), ("frozen_sensor", False),
                           ("sensor_nan", False), ("clock_jump", 0.0), ("slider", 1.0),
                           ("outputs", 0), ("joints_nan", False), ("clock_stands", False),
                           ("ft300_fault", ""), ("payload", 0.0)):
        robot.ask(action, value=values)
    robot.ask("added_wrench", wrench=[0.0] * 6)
    robot.ask("unlock")
    robot.ask("reset_emergency")
    robot.ask("remote")
    robot.ask("home")


def new_robot(address: str, model: str, seed: int) -> VirtualRobot:
    """Return a virtual robot; a CB3 has an FT300."""
    return VirtualRobot(model, address, seed=seed, ft300=not arm_named(model).measures_force)
