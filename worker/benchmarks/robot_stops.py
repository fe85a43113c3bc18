"""Retreats from random stops, and a cell or sensor that is wrong, without a wall clock.

The driver's loop runs on the virtual controller that it steps itself, so a machine under load
changes nothing. The branch is a linear spring, stiff along its axis; its nudge and its pull are
judged as `limber record` judges them, with moduli known to a factor of two.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.robot_stepped import Spring, SteppedRobot, Wall
from benchmarks.table import Asked, Row, Setting
from benchmarks.trials import column, sound
from limber.cell.cell_file import Cell
from limber.core.errors import LimberError, SafetyStop, WorkError
from limber.geometry.rigid_kernels import crossed
from limber.robot.driver.link import RobotLink
from limber.robot.motion.trajectory import Trajectory, along, densely, speed_within
from limber.robot.recorder import (
    NUDGE_M,
    NUDGE_M_S,
    NUDGE_SECONDS,
    PredictedPull,
    PullPlausibility,
    certain_directions,
    nudge_direction,
)
from limber.robot.virtual.controller import Controller
from limber.robot.virtual.payload import Load

RETREAT_ROW = Asked("retreats from random stops on branch and wall: force under 1 N at the end, or "
                    "why not", "50 of 50")
_COUNT, _LEFT_N = 50, 1.0
TOOL = np.array([0.0, 0.0, 0.15])
_WAY_M = 0.03
_SECONDS = 100.0  # of the robot's time
_TARE_S, _AFTER_S = 0.1, 0.3
_OVER = "the program that drives the robot has ended"  # the bench's own end of a run
_FARTHEST_M, _WRONG_WAY_M, _AT_M = 0.01, 0.02, 0.004
_SEEDS, _FACTOR = 10, 2.0
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


class _Misread(Load):
    """A load whose force the sensor misreads by a matrix [3, 3]."""

    def __init__(self, load: Load, matrix: np.ndarray):
        self._load, self._matrix = load, matrix

    def wrench(self, flange: np.ndarray, seconds: float) -> np.ndarray:
        force = self._matrix @ self._load.wrench(flange, seconds)[:3]
        return np.concatenate((force, crossed(TOOL, force)))


@dataclass(frozen=True)
class _Wrong:
    """What is wrong: of the order, of the sensor, or of the controller after 4 mm."""

    order: Callable[[dict[str, Any], np.ndarray], dict[str, Any]] | None = None
    sensor: np.ndarray | None = None
    later: Callable[[Controller], None] | None = None


def _other_joints(*off: float) -> Callable[[dict[str, Any], np.ndarray], dict[str, Any]]:
    return lambda order, joints: order | {"start_joints": (joints + np.array(off)).tolist()}


def _shifted(order: dict[str, Any], _joints: np.ndarray) -> dict[str, Any]:
    return order | {"poses": order["poses"] + np.r_[0.0, 0.01, np.zeros(4)]}


_CASES = {
    "configuration": _Wrong(order=_other_joints(0, 1.5, -3.0, 1.5, 0, 0)),
    "wrist by 46 degrees": _Wrong(order=_other_joints(0, 0, 0, 0, 0, 0.8)),
    "base by 1 cm": _Wrong(order=_shifted),
    "tool by 5 mm": _Wrong(later=lambda c: c.set_tool(c.tool_offset + np.r_[0.005, np.zeros(5)])),
    "payload by 0.3 kg": _Wrong(later=lambda c: setattr(c, "payload", 0.3)),
    "sensor in other units": _Wrong(sensor=0.1 * np.eye(3)),
    "sensor's sign": _Wrong(sensor=-np.eye(3)),
    "sensor's axes": _Wrong(sensor=np.eye(3)[[1, 2, 0]]),
}
STATES_ROW = Asked(f"wrong {', '.join(_CASES)}: refused, or stopped within 10 mm", "100 %")


def wrong_states(setting: Setting) -> list[Row]:
    """Try each, from random directions, and one pull in which nothing is wrong."""
    good = count = 0
    for seed in setting.seeds(_SEEDS, 2):
        if setting.budget.remaining < 0:
            break
        assert _way_of(_Wrong(), seed) is None, f"seed {seed}: stopped where nothing is wrong"
        for name, wrong in _CASES.items():
            way = _way_of(wrong, seed)
            count += 1
            good += way is not None and way <= _FARTHEST_M
            if way is None or way > _FARTHEST_M:
                print(f"{name}, seed {seed}: {way}", flush=True)
    return [Row(*STATES_ROW, f"{good} of {count}", good == count if count else None, count)]


def _way_of(wrong: _Wrong, seed: int) -> float | None:
    """Way [m] after which a wrong state was noticed, 0 if it was refused; None if it was not."""
    rng = np.random.default_rng(seed)
    controller = Controller("ur5e", seed=seed)
    controller.set_tool(np.r_[TOOL, 0, 0, 0])
    start, flange, way = controller.pose.copy(), controller.flange[:3, 3].copy(), direction(rng)
    spring = branch_spring(rng, start[:3], way)
    told = np.eye(3) if wrong.sensor is None else wrong.sensor
    controller.load = _Misread(spring, told)
    side = nudge_direction(way, spring.stiffness)
    line = densely(np.array([start, start + np.r_[NUDGE_M * side, 0, 0, 0]]))
    out = along(line, NUDGE_M_S, 0.3)
    nudge = {"times": np.r_[out, 2 * out[-1] + NUDGE_SECONDS - out[::-1]],
             "poses": np.concatenate([line, line[::-1]])}
    noticed = _moved(wrong, controller, nudge, NUDGE_M * side, spring.stiffness)
    if noticed is not None:
        return noticed
    poses = densely(np.array([start, start + np.r_[_WRONG_WAY_M * way, 0, 0, 0]]))
    return _moved(wrong, controller, {"times": along(poses, 0.02, 0.3), "poses": poses},
                  _WRONG_WAY_M * way, spring.stiffness, _later(wrong, controller, flange))


def _moved(wrong: _Wrong, controller: Controller, motion: dict[str, Any], way: np.ndarray,
           stiffness: np.ndarray, later: Callable[[], None] = lambda: None) -> float | None:
    """Way [m] after which a wrong state was noticed in a motion along ``way`` [3] [m]."""
    start, flange = controller.pose[:3].copy(), controller.flange[:3, 3].copy()
    order = {"start_joints": controller.joints.tolist()} | motion
    if wrong.order is not None:
        order = wrong.order(order, controller.joints)
    path = Trajectory(order["times"], order["poses"], None, np.tile(
        order["start_joints"], (len(order["times"]), 1)))
    robot, batches = SteppedRobot(controller), list[np.ndarray]()
    robot.each_step = later
    with robot.here(), RobotLink(_CELL, batches.append) as link:
        link.wait_for_samples()
        link.tare(_TARE_S)
        try:
            event = link.follow(path)
        except SafetyStop:
            return 0.0
        robot.rest(_AFTER_S)
    if event["event"] == "stopped":
        return float(np.linalg.norm(controller.flange[:3, 3] - flange))
    rows = np.concatenate(batches)
    return _doubted(rows, np.linalg.norm(rows[:, 1:4] - start, axis=1), way, stiffness)


def _later(wrong: _Wrong, controller: Controller, flange: np.ndarray) -> Callable[[], None]:
    """Do it once, after 4 mm of the flange's way."""
    left = [wrong.later] if wrong.later is not None else []

    def step() -> None:
        if left and np.linalg.norm(controller.flange[:3, 3] - flange) > _AT_M:
            left.pop()(controller)
    return step


def _doubted(rows: np.ndarray, ways: np.ndarray, way: np.ndarray, stiffness: np.ndarray,
             ) -> float | None:
    """Way [m] after which `limber record` doubts the motion's force; None if it does not."""
    places = np.array([0.0, 0.35, 0.7, 1.0])
    doubt = PullPlausibility(_CELL, PredictedPull(
        places * np.linalg.norm(way), places[:, None] * (stiffness @ way), _FACTOR,
        certain_directions(stiffness, way)))
    begin = int(np.argmax(ways > 1e-5))
    for first in range(max(begin - 20, 0), len(rows), 10):
        if doubt.take(rows[first:first + 10]):
            return float(ways[:first + 10].max())
    return None
