"""A cell or a sensor that is wrong: refused before the motion, or stopped in its first 10 mm.

The driver's loop steps the virtual controller itself. The branch is a linear spring; its nudge and
its pull are judged as `limber record` judges them, with moduli known to a factor of two.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.robot_retreats import TOOL, branch_spring, direction, patched
from benchmarks.robot_stepped import Run
from benchmarks.table import Asked, Row, Setting
from limber.core.numerics.rigid_kernels import crossed
from limber.robot.cell.cell import Cell
from limber.robot.driver.link import COLUMNS
from limber.robot.interface import Sample
from limber.robot.motion.trajectory import along, densely
from limber.robot.pull_plausibility import (
    NUDGE_M,
    NUDGE_M_S,
    NUDGE_SECONDS,
    PredictedPull,
    PullPlausibility,
    certain_directions,
    nudge_direction,
)
from limber.robot.virtual.controller import Controller
from limber.robot.virtual.payload import Nothing

_FARTHEST_M, _WAY_M, _AT_M = 0.01, 0.02, 0.004
_SEEDS, _FACTOR = 10, 2.0
_CELL = Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6},
             tool={"grasp_pose": (*TOOL, 0, 0, 0), "mass_kg": 0.0})


class _Misread(Nothing):
    """A load whose force the sensor misreads by a matrix [3, 3]."""

    def __init__(self, load: Nothing, matrix: np.ndarray):
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
    noticed = _moved(wrong, controller, nudge, NUDGE_M * side, spring.stiffness, None)
    if noticed is not None:
        return noticed
    poses = densely(np.array([start, start + np.r_[_WAY_M * way, 0, 0, 0]]))
    return _moved(wrong, controller, {"times": along(poses, 0.02, 0.3), "poses": poses},
                  _WAY_M * way, spring.stiffness, _later(wrong, controller, flange))


def _moved(wrong: _Wrong, controller: Controller, motion: dict[str, Any], way: np.ndarray,
           stiffness: np.ndarray, later: Callable[[Sample], None] | None) -> float | None:
    """Way [m] after which a wrong state was noticed in a motion along ``way`` [3] [m]."""
    start, flange = controller.pose[:3].copy(), controller.flange[:3, 3].copy()
    order = {"order": "follow", "expected": None, "start_joints": controller.joints.tolist()
             } | motion
    if wrong.order is not None:
        order = wrong.order(order, controller.joints)
    with patched() as patches:
        run = Run(_CELL, controller, patches)
        if later is not None:
            run.control.each_sample = later
        event = run.follow(order, seconds=10.0)
    if event["event"] == "refused":
        return 0.0
    if event["event"] == "stopped":
        return float(np.linalg.norm(controller.flange[:3, 3] - flange))
    return _doubted(run.rows, np.linalg.norm(run.rows[:, 1:4] - start, axis=1), way, stiffness)


def _later(wrong: _Wrong, controller: Controller, flange: np.ndarray) -> Callable[[Sample], None]:
    """Do it once, after 4 mm of the flange's way."""
    left = [wrong.later] if wrong.later is not None else []

    def step(sample: Sample) -> None:
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
    padded = np.full((len(rows), len(COLUMNS)), np.nan)
    padded[:, :rows.shape[1]] = rows
    for first in range(max(begin - 20, 0), len(rows), 10):
        if doubt.take(padded[first:first + 10]):
            return float(ways[:first + 10].max())
    return None
