"""Retreats from random stops at a wall and with a branch in the gripper, without a wall clock.

The driver's loop runs on the virtual controller that it steps itself, so a machine under load
changes nothing. The branch is a linear spring, stiff along its axis.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np

from benchmarks import robot_stepped
from benchmarks.robot_stepped import Run, Spring, Wall
from benchmarks.table import Asked, Row, Setting
from benchmarks.trial_log import Numbers, numbers_of, source_digest
from limber.core.errors import LimberError
from limber.robot.cell.cell import Cell
from limber.robot.motion.contact_speed import speed_within
from limber.robot.motion.trajectory import Trajectory, along, densely
from limber.robot.virtual.controller import Controller

RETREAT_ROW = Asked("retreats from random stops on branch and wall: force under 1 N at the end, or "
                    "why not", "50 of 50")
_COUNT, _LEFT_N = 50, 1.0
TOOL = np.array([0.0, 0.0, 0.15])
_WAY_M = 0.03
_SECONDS = 100.0  # of the robot's time
_OVER = "the program that drives the robot has ended"  # the bench's own end of a run


class _Patches:
    """Attributes that are replaced, and put back."""

    def __init__(self) -> None:
        self._before: list[tuple[Any, str, Any]] = []

    def setattr(self, target: Any, name: str, value: Any) -> None:
        self._before.append((target, name, getattr(target, name)))
        setattr(target, name, value)

    def undo(self) -> None:
        for target, name, value in reversed(self._before):
            setattr(target, name, value)


@contextmanager
def patched() -> Iterator[_Patches]:
    patches = _Patches()
    try:
        yield patches
    finally:
        patches.undo()


def retreats(setting: Setting) -> list[Row]:
    """Stop at random, retreat, and read the force that is left."""
    source = source_digest(("robot",), __file__, robot_stepped.__file__)
    first = 1000 * setting.seed
    trials = [each.values for each in numbers_of(
        "retreats", range(first, first + setting.at_most(_COUNT, 4)), partial(
            _trial, source=source), source, setting.kept / "robot.jsonl", setting.budget,
        progress=setting.progress)]
    free = sum(each["left_n"] < _LEFT_N and not each["why"] for each in trials)
    told = sum(bool(each["why"]) for each in trials)
    good, count = free + told, len(trials)
    # A stop that was not made is not known to be left.
    is_met = False if good < count else True if count >= _COUNT else None
    return [Row(*RETREAT_ROW, f"{free} of {count} under 1 N, {told} said why not; largest force "
                f"before {max(each['peak_n'] for each in trials):.1f} N", is_met, count)]


def _trial(seed: int, source: str) -> Numbers:
    with patched() as patches:
        try:
            event, load = _retreat(np.random.default_rng(seed), patches)
        except LimberError as error:
            return Numbers("retreats", seed, source, {"left_n": np.inf, "peak_n": 0.0,
                                                      "why": str(error)})
    why = "" if event["event"] == "reached" else event["reason"]
    if _OVER in why:
        # Nobody waits so long for an arm that holds on to a branch.
        return Numbers("retreats", seed, source, {"left_n": np.inf, "peak_n": load.peak, "why": ""})
    print(f"seed {seed}: {type(load).__name__}, peak {load.peak:.1f} N, left {load.now:.2f} N "
          f"{why}", flush=True)
    return Numbers("retreats", seed, source, {"left_n": load.now, "peak_n": load.peak, "why": why})


def _retreat(rng: np.random.Generator, patches: robot_stepped.Patch,
             ) -> tuple[dict[str, Any], Wall | Spring]:
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
    run = Run(cell, controller, patches)
    event = run.follow(
        {"order": "follow", "times": path.times, "poses": path.poses, "expected": None},
        seconds=_SECONDS, at_pause=lambda: "retreat", at_stop=lambda: "retreat",
        stop_at=float(stop_at))
    return event, load


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
