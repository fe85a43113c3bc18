"""Both sides of a closed loop: its findings, and the truth of the virtual branch."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from limber.cli.closed_loop.robot_observer import Watch
from limber.cli.closed_loop.task_sizes import TaskSizes
from limber.core.json_values import plain
from limber.estimation.simulated_pull import TrueBranch

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
        "force_within_share": executed["force_within_share"],
        "force_error_of_peak": executed["force_error_of_peak"],
        "predicted_peak_force_n": executed["predicted_peak_force_n"],
        "predicted_force_sigma_n": executed["predicted_force_sigma_n"],
        "peak_force_n": executed["peak_force_n"], "path_error_m": executed["path_error_m"],
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
