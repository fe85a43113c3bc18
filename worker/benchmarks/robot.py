"""The robot's table: stop times, faults, the stream, paths; all on the virtual robot.

No real robot was measured. Times are those of this computer under its load at the moment; the
virtual controller and the driver share it.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks.machine_stalls import FAILURES, Voided, Witness
from benchmarks.robot_branches import (
    FOLLOWED_ROWS,
    LEAST_STREAM_S,
    LOOP_ROWS,
    STREAM_ROWS,
    closed_loops,
    followed_paths,
    recorded_stream,
)
from benchmarks.robot_calibration import CALIBRATION_ROWS, calibrations
from benchmarks.robot_faults import (
    ENDS_ROBOT,
    EVERY,
    Outcome,
    cell_for,
    model_for,
    new_robot,
    provoke,
    restored,
    straight,
)
from benchmarks.robot_guard import GUARD_ROWS, guarded_paths
from benchmarks.robot_ros import LEAST_ROS_S, ROS_ROWS, ros_door
from benchmarks.robot_ros_faults import ROS_FAULT_ROWS, ros_faults
from benchmarks.robot_stops import RETREAT_ROW, STATES_ROW, retreats, wrong_states
from benchmarks.table import Asked, Part, Row, Setting
from benchmarks.trials import Trial, column, sound
from limber.robot.driver.link import RobotLink
from limber.robot.virtual.launch import VirtualRobot

_ADDRESS = "127.0.0.71"


_STOP_SECONDS = {125: 0.012, 500: 0.006}
"""Required time [s], by the controller's rate [Hz]."""
_FAULT_RUNS, _NAMED_SHARE = 5, 0.95


def _stop_asked(rate: int) -> tuple[Asked, ...]:
    return (Asked(f"force over the hard limit until the stop command, {rate} Hz, worst",
                  f"{1000 * _STOP_SECONDS[rate]:.0f} ms"),
            Asked(f"way after the limit at 50 mm/s, {rate} Hz, worst", "reported"))


def _faults_asked(told: str) -> tuple[Asked, ...]:
    return (Asked(f"{told} while moving: standstill and a report", "every one"),
            Asked(f"{told} while moving: the report names the fault", "95 %"))


@dataclass(frozen=True)
class _Stop:
    """One stop for a force: its time and how far the arm moved on.

    ``since`` and ``until`` [s, monotonic clock]: the force and the stop came between them.
    """

    latency: float
    way: float
    since: float
    until: float


def _stop_time(setting: Setting, voided: Voided, model: str) -> list[Row]:
    """From the step at which the force exceeds the limit until the stop command arrives.

    An FT300 sends its force every 10 ms, which is included. A stop delayed by no more than the
    machine stalled meanwhile is repeated, and reported with its time.
    """
    rate = 125 if model == "ur5" else 500
    asked = _STOP_SECONDS[rate]
    stops, late, runs = [], [], setting.at_most(20, 2)
    with new_robot(_ADDRESS, model, setting.seed) as robot:
        for _ in setting.budget.seeds(0, 2 * runs):
            stop = voided.again(partial(_one_stop, robot, model, 1.0 / rate), f"stop at {rate} Hz")
            over = stop.latency - asked
            if over > 1e-6 and len(late) < runs and voided.explains(
                    stop.since, stop.until, over, f"stop at {rate} Hz"):
                late.append(stop)
                continue
            stops.append(stop)
            if len(stops) == runs:
                break
    return _stop_rows(rate, stops, late)


def _stop_rows(rate: int, stops: list[_Stop], late: list[_Stop]) -> list[Row]:
    again = "" if not late else (f"; {len(late)} done again, the machine stood still: to "
                                 f"{1000 * max(stop.latency for stop in late):.1f} ms")
    time_asked, way_asked = _stop_asked(rate)
    way = Row(*way_asked, f"{1000 * max(stop.way for stop in stops + late):.1f} mm", None,
              len(stops + late))
    if not stops:
        return [Row(*time_asked, f"none that the machine let be measured{again}", None, 0), way]
    worst = max(stop.latency for stop in stops)
    median = np.median([stop.latency for stop in stops])
    return [Row(*time_asked, f"{1000 * worst:.1f} ms (median {1000 * median:.1f}){again}",
                worst <= _STOP_SECONDS[rate] + 1e-6, len(stops)), way]


def _one_stop(robot: VirtualRobot, model: str, step: float) -> _Stop:
    """Add a force over the limit to a moving arm and wait for the stop.

    Raises:
        AssertionError: something else stopped it.
    """
    restored(robot)
    with RobotLink(cell_for(_ADDRESS, model)) as link:
        time.sleep(0.2)
        link.tare()
        link.start(straight(robot, (0.0, 0.2, 0.0)))
        time.sleep(1.0)
        since = time.monotonic()
        before = robot.ask("added_wrench", wrench=[0, 0, 60.0, 0, 0, 0])
        came = time.monotonic()
        event = link.wait("stopped", seconds=5)
        assert event["reason"].startswith("hard force limit"), event["reason"]
        time.sleep(0.3)
        after = robot.state
    # The force acts from the next step on.
    acts = before["clock"] + step
    stopped = min(moment for line in after["log"] if line.endswith(("received", "dashboard"))
                  and (moment := float(line.split()[0])) > before["clock"])
    way = float(np.linalg.norm(np.subtract(after["pose"][:3], before["pose"][:3])))
    return _Stop(stopped - acts, way, since, came + stopped - acts)


def _faults(setting: Setting, voided: Voided, names: tuple[str, ...] = tuple(EVERY)) -> list[Row]:
    runs: dict[str, list[Trial]] = {}
    for name, budget in setting.budget.shares(list(names)):
        setting.progress(len(runs) / len(names), name)
        if some := _fault_runs(name, replace(setting, budget=budget), voided, 0 if runs else 1):
            runs[name] = some
            print(f"{name}: {len(some)} runs, {len(some) - len(sound(some))} failed", flush=True)
    every = [run for some in runs.values() for run in some]
    good, total = sound(every), len(every)
    stood = [run for run in good if run.part not in ENDS_ROBOT]
    slowest = column(stood, "standstill_s").max() if stood else np.nan
    least, most = (size(map(len, runs.values())) for size in (min, max))
    each = f"{least} to {most} runs of {len(runs)} of {len(names)} faults; " if len(
        names) > 1 else ""
    # A case that was not run is not known to be good.
    is_met = False if len(good) < total else True if len(runs) == len(names) else None
    asked = _faults_asked(_faults_told(names))
    share = float(column(good, "is_named").mean()) if good else np.nan
    return [Row(*asked[0], f"{len(good)} of {total}; {each}"
                f"slowest standstill {slowest:.2f} s{voided}", is_met, total),
            Row(*asked[1], f"{100 * share:.0f} %", share >= _NAMED_SHARE if good else None,
                len(good))]


def _faults_told(names: tuple[str, ...]) -> str:
    return f"{len(names)} faults" if len(names) > 1 else names[0]


def _fault_runs(name: str, setting: Setting, voided: Voided, at_least: int) -> list[Trial]:
    """Provoke a fault as often as there is time for: its standstill time [s], or how it failed."""
    robots: list[VirtualRobot] = []

    def run() -> Outcome:
        if not robots or robots[-1].process.poll() is not None:
            for robot in robots:
                robot.close()
            robots[:] = [new_robot(_ADDRESS, model_for(name),
                                   setting.seed + list(EVERY).index(name))]
        restored(robots[-1])
        return provoke(name, robots[-1], cell_for(_ADDRESS, model_for(name)))

    def trial(_number: int) -> dict[str, Any]:
        try:
            outcome = voided.again(run, name)
        except FAILURES as error:
            print(f"{name}: {error}", flush=True)
            raise
        if not outcome.is_named:
            print(f"{name}: reported as: {outcome.report}", flush=True)
        return {"standstill_s": outcome.standstill_s, "is_named": outcome.is_named}
    try:
        return setting.trials(name, setting.seeds(_FAULT_RUNS, 1), trial, "robot",
                              at_least=at_least, catch=FAILURES)
    finally:
        for robot in robots:
            robot.close()


def _watched(run: Callable[[Setting, Voided], list[Row]]) -> Callable[[Setting], list[Row]]:
    """Return a part that is notified when the machine stalled."""
    def measured(setting: Setting) -> list[Row]:
        with Witness() as witness:
            return run(setting, Voided(witness))
    return measured


PARTS = {
    "stop-500": Part(_watched(partial(_stop_time, model="ur5e")), 15, _stop_asked(500),
                     grows=True),
    "stop-125": Part(_watched(partial(_stop_time, model="ur5")), 15, _stop_asked(125), grows=True),
    "faults": Part(_watched(_faults), 150, _faults_asked(_faults_told(tuple(EVERY))),
                   grows=True),
    "wrong-states": Part(wrong_states, 30, (STATES_ROW,), grows=True),
    "retreats": Part(retreats, 60, (RETREAT_ROW,), grows=True),
    "calibration": Part(calibrations, 30, CALIBRATION_ROWS, grows=True),
    "ros": Part(_watched(ros_door), LEAST_ROS_S, ROS_ROWS, grows=True),
    "ros-faults": Part(ros_faults, 60, ROS_FAULT_ROWS, grows=True),
    "branches": Part(_watched(partial(followed_paths, address=_ADDRESS)), 60, FOLLOWED_ROWS,
                     grows=True),
    "guard": Part(guarded_paths, 300, GUARD_ROWS, grows=True),
    "loops": Part(_watched(partial(closed_loops, address=_ADDRESS)), 240, LOOP_ROWS, grows=True),
    "stream": Part(partial(recorded_stream, address=_ADDRESS), LEAST_STREAM_S, STREAM_ROWS,
                   grows=True)}
"""The table, in order of importance; ``--only`` also accepts each fault alone."""
PARTS |= {f"fault:{name}".replace(" ", "-"): Part(
    _watched(partial(_faults, names=(name,))), 15, _faults_asked(name), grows=True, alone=True)
    for name in EVERY}
