"""Retreats from random stops, without a wall clock.

The driver's loop runs on the virtual controller that it steps itself, so a machine under load
changes nothing. The branch is a linear spring, stiff along its axis.
"""

from typing import Any

import numpy as np

from benchmarks.robot_stepped import Spring, SteppedRobot, Wall
from benchmarks.table import Asked, Row, Setting
from benchmarks.trials import column, sound
from limber.cell.cell_file import Cell
from limber.core.errors import LimberError, SafetyStop, WorkError
from limber.robot.driver.link import RobotLink
from limber.robot.motion.trajectory import Trajectory, along, densely, speed_within
from limber.robot.virtual.controller import Controller

RETREAT_ROW = Asked("retreats from random stops on branch and wall: force under 1 N at the end, or "
                    "why not", "50 of 50")
_COUNT, _LEFT_N = 50, 1.0
TOOL = np.array([0.0, 0.0, 0.15])
_WAY_M = 0.03
_SECONDS = 100.0  # of the robot's time
_TARE_S, _AFTER_S = 0.1, 0.3
_OVER = "the program that drives the robot has ended"  # the bench's own end of a run
_CELL = Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6},
             tool={"grasp_pose": (*TOOL, 0, 0, 0), "mass_kg": 0.0})


def retreats(setting: Setting) -> list[Row]:
    """Stop at random, retreat, and read the force that is left."""
    trials = setting.trials("retreats", setting.seeds(_COUNT, 4), _retreated, "robot",
                            catch=LimberError)
    left = column(sound(trials), "left_n")
    told = sum(bool(each["why"]) for each in sound(trials)) + len(trials) - len(left)
    free = sum(each["left_n"] < _LEFT_N and not each["why"] for each in sound(trials))
    good, count = free + told, len(trials)
    # A stop that was not made is not known to be left.
    is_met = False if good < count else True if count >= _COUNT else None
    return [Row(*RETREAT_ROW, f"{free} of {count} under 1 N, {told} said why not; largest force "
                f"before {max((each['peak_n'] for each in sound(trials)), default=0):.1f} N",
                is_met, count)]


def _retreated(seed: int) -> dict[str, Any]:
    event, load = _retreat(np.random.default_rng(seed))
    why = "" if event["event"] == "reached" else event["reason"]
    if _OVER in why:
        # Nobody waits so long for an arm that holds on to a branch.
        return {"left_n": np.inf, "peak_n": load.peak, "why": ""}
    print(f"seed {seed}: {type(load).__name__}, peak {load.peak:.1f} N, left {load.now:.2f} N "
          f"{why}", flush=True)
    return {"left_n": load.now, "peak_n": load.peak, "why": why}


def _retreat(rng: np.random.Generator) -> tuple[dict[str, Any], Wall | Spring]:
    """Move against a wall or with a branch until something stops it; then retreat."""
    controller = Controller("ur5e", seed=int(rng.integers(1 << 30)))
    controller.set_tool(np.r_[TOOL, 0, 0, 0])
    start = controller.pose.copy()
    way = direction(rng)
    stiffness = float(np.exp(rng.uniform(np.log(3e3), np.log(1e5))))
    cell = Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6},
                tool={"grasp_pose": (*TOOL, 0, 0, 0), "mass_kg": 0.0},
                limits={"contact_n_per_m": stiffness})
    controller.load = load = (
        Wall(TOOL, -way, start[:3] + rng.uniform(0.005, 0.025) * way, stiffness)
        if rng.random() < 0.5 else branch_spring(rng, start[:3], way))
    poses = densely(np.array([start, start + np.r_[_WAY_M * way, 0, 0, 0]]))
    speed = speed_within(cell, float(rng.uniform(0.01, 0.05)))
    path = Trajectory(along(poses, speed, 0.3), poses)
    # A person stops it anywhere; half of the walls do it themselves, and a soft branch may not.
    stop_at = rng.uniform(0.2, 0.95 * path.duration)
    if isinstance(load, Wall) and rng.random() < 0.5:
        stop_at = np.inf
    robot = SteppedRobot(controller)
    with robot.here(), RobotLink(cell) as link:
        link.wait_for_samples()
        link.tare(_TARE_S)
        link.start(path)
        event = _ended(link, float(stop_at))
        if event["event"] != "reached":
            try:
                event = link.retreat(_SECONDS)
            except SafetyStop as error:
                event = {"event": "refused", "reason": str(error)}
            except WorkError:
                event = {"event": "stopped", "reason": _OVER}
        robot.rest(_AFTER_S)
    return event, load


def _ended(link: RobotLink, stop_at: float) -> dict[str, Any]:
    """How a motion ended, which is stopped then [s]."""
    ends = ("reached", "stopped", "paused")
    try:
        return link.wait(*ends, seconds=min(stop_at, _SECONDS))
    except WorkError:
        link.stop()
        return link.wait(*ends, seconds=1.0)


def branch_spring(rng: np.random.Generator, rest: np.ndarray, way: np.ndarray) -> Spring:
    """A spring of 50 to 500 N/m across its axis, a hundred times that along it."""
    axis = np.cross(way, direction(rng))
    axis /= np.linalg.norm(axis)
    across = float(np.exp(rng.uniform(np.log(50.0), np.log(500.0))))
    return Spring(TOOL, rest, across * (np.eye(3) + 99.0 * np.outer(axis, axis)))


def direction(rng: np.random.Generator) -> np.ndarray:
    """A random direction, shape [3]."""
    way = rng.standard_normal(3)
    return way / np.linalg.norm(way)
