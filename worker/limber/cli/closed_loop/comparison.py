"""Both sides of a closed loop: its findings, and the truth of the virtual branch."""

import threading
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from limber.cli.closed_loop.cell_layout import TaskSizes
from limber.core.json_values import plain
from limber.estimation.simulated_pull import TrueBranch
from limber.robot.virtual.launch import VirtualRobot

# The virtual robot as observed from outside, while another process controls it.

STILL_M_S = 1e-4
_GUIDED_M = 0.015  # the tip moves this far from the grasp's rest while it is guided
_MOVED_M_S = 0.01
_AT_END_M = 5e-4
_EVERY_SECONDS, _CLOSELY_SECONDS = 0.05, 0.004


@dataclass(frozen=True)
class Overload:
    """Effects of a provoked overload: time until the arm stood still [s], and how far the gripper
    still moved [m]."""

    standstill: float
    travel: float


@dataclass
class Watch:
    """Records the states of robot and branch in a thread, which alone may query it meanwhile; a
    context manager. ``overload``: wrench on the sensor from when the branch is driven [N, N m],
    shape [6], or None; ``overloaded``: its effects."""

    robot: VirtualRobot
    overload: np.ndarray | None = None
    states: list[dict[str, Any]] = field(default_factory=list)
    overloaded: Overload | None = None

    def __enter__(self) -> "Watch":
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_exception: object) -> None:
        self._ended.set()
        self._thread.join()
        if self.overload is not None:
            self.robot.ask("added_wrench", wrench=[0.0] * 6)

    @property
    def extrapolation_error(self) -> float:
        """Largest error of the virtual branch's own force [N]."""
        return max((state.get("extrapolation_error_n", 0.0) for state in self.states), default=0.0)

    def at_the_end(self) -> np.ndarray | None:
        """Return positions of the branch's visible points at the end of the path [m], shape [n, 3]:
        where it was held still, farthest from where it was grasped."""
        held = [state for state in self.states if state["branch"] == "held"]
        still = [state for state in held if _speed(state) < STILL_M_S]
        if not still:
            return None
        positions = np.array([state["flange"] for state in still])
        away = np.linalg.norm(positions - held[0]["flange"], axis=1)
        is_at_end = np.linalg.norm(positions - positions[away.argmax()], axis=1) < _AT_END_M
        return np.mean([state["points"] for state, is_there in zip(still, is_at_end, strict=True)
                        if is_there], axis=0)

    def _run(self) -> None:
        start: np.ndarray | None = None
        while not self._ended.wait(_EVERY_SECONDS):
            state = self.robot.state
            self.states.append(state)
            # The flange's: the tool that poses are of is set for a motion, and put back.
            position = np.array(state["flange"])
            if state["branch"] != "held":
                start = None
                continue
            start = position if start is None else start
            is_moving = np.linalg.norm(position - start) > _GUIDED_M and _speed(state) > _MOVED_M_S
            if self.overload is not None and self.overloaded is None and is_moving:
                self._overload()

    def _overload(self) -> None:
        assert self.overload is not None
        before = self.robot.ask("added_wrench", wrench=list(map(float, self.overload)))
        began = time.monotonic()
        while not self._ended.wait(_CLOSELY_SECONDS):
            state = self.robot.state
            if _speed(state) < STILL_M_S:
                offset = np.subtract(state["flange"], before["flange"])
                self.overloaded = Overload(time.monotonic() - began, float(np.linalg.norm(offset)))
                return


def _speed(state: dict[str, Any]) -> float:
    return float(np.linalg.norm(state["tool_speed"][:3]))


GOAL_TOLERANCE_M = 0.01
"""Distance from the goal at which the flower is in it."""


@dataclass(frozen=True)
class Planned:
    """Results of the pulls so far, and the plan made with them."""

    estimated: dict[str, Any]
    goal: np.ndarray
    task: TaskSizes
    plan: dict[str, Any]
    pull_count: int = 1
    reason: str = ""

    @property
    def open_factor(self) -> float:
        """The widest interval of a modulus: ratio of its ends."""
        low, high = np.array(self.estimated["young_interval_pa"], float).T
        return float((high / low).max())


def compared(truth: TrueBranch, moved: np.ndarray, planned: Planned, executed: dict[str, Any],
             watch: Watch, stopped: tuple[str, Watch], soft_force: float) -> dict[str, Any]:
    """Return estimated against true E, force along the path, the flower, the overload."""
    from limber.results.report.report_tables import true_moduli

    estimated, goal = planned.estimated, planned.goal
    young = np.array(true_moduli(estimated, {"young_true_pa": list(truth.young),
                                             "fractions": list(truth.fractions)}))
    seen = watch.at_the_end()
    flower = None if seen is None else seen[-1] + moved
    off = np.inf if flower is None else float(np.linalg.norm(flower - goal))
    interval = np.array(estimated["young_interval_pa"], float)
    reason, second = stopped
    overload = second.overloaded
    return plain({
        "young_true_pa": young,
        "young_pa": estimated["young_pa"], "young_interval_pa": interval,
        "covered": (interval[:, 0] <= young) & (young <= interval[:, 1]),
        **{name: executed[name] for name in (
            "force_within_share", "force_error_of_peak", "predicted_peak_force_n",
            "predicted_force_sigma_n", "peak_force_n", "path_error_m")},
        "limit_broken": bool(executed["peak_force_n"] > soft_force),
        "pull_count": planned.pull_count, "open_factor": planned.open_factor,
        "no_further_pull": planned.reason, "holding_force_n": planned.task.holding_force,
        "max_force_n": planned.task.max_force,
        "flower_goal_m": goal, "flower_planned_m": planned.plan.get("target_end_m"),
        "flower_m": flower, "flower_off_m": None if flower is None else off,
        "flower_in_goal": off <= GOAL_TOLERANCE_M,
        "overload_reason": reason,
        "overload_way_m": overload.travel if overload else None,
        "overload_standstill_s": overload.standstill if overload else None,
        "extrapolation_error_n": max(watch.extrapolation_error, second.extrapolation_error)})


def comparison(result: dict[str, Any]) -> list[tuple[str, list[list[str]]]]:
    """Return titles and tables of a loop's findings, for a terminal."""
    from limber.results.report.report_tables import modulus_rows

    force = [["force along the path", ""],
             ["predicted peak", f"{result['predicted_peak_force_n']:.2f} N"],
             ["measured peak", f"{result['peak_force_n']:.2f} N"],
             ["within 5 % of the peak or its interval",
              f"{100 * result['force_within_share']:.1f} % of the path"],
             ["difference, 95 % of the path below",
              f"{100 * result['force_error_of_peak']:.1f} % of the peak"],
             ["largest error of the virtual branch's own force",
              f"{result['extrapolation_error_n']:.2f} N"]]
    rows = [["", "x [mm]", "y [mm]", "z [mm]"]]
    for title, key in (("flower's goal", "flower_goal_m"), ("as planned", "flower_planned_m"),
                       ("final position", "flower_m")):
        if result[key] is not None:
            rows.append([title, *(f"{1000 * value:.1f}" for value in result[key])])
    overload_travel, still = result["overload_way_m"], result["overload_standstill_s"]
    pulls = [["pulls", str(result["pull_count"])],
             ["widest interval, upper over lower end", f"{result['open_factor']:.1f}"],
             ["no further pull", result["no_further_pull"]],
             ["holds the flower in its goal", f"{result['holding_force_n']:.2f} N"],
             ["allowed along the path", f"{result['max_force_n']:.2f} N"]]
    stop = [["a provoked overload", ""], ["stopped by", result["overload_reason"]],
            ["distance after it", "-" if overload_travel is None
             else f"{1000 * overload_travel:.1f} mm"],
            ["until standstill", "-" if still is None else f"{1000 * still:.0f} ms"]]
    return [("Young's modulus", modulus_rows(result, result)), ("Sufficient?", pulls),
            ("Predicted against measured", force), ("The flower", rows), ("Safety", stop)]
