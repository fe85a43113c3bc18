"""Figures of an estimate: E along the branch, loss over evaluations, simulated over observed."""

from collections.abc import Iterator
from datetime import datetime
from typing import Any

import numpy as np

from limber.core.constants import DATA_COLOURS
from limber.estimation.uncertainty.covariance import OUTLIER
from limber.estimation.uncertainty.identifiability import UNRESOLVED_DEVIATION
from limber.results.report.section import chart

OBSERVED, SIMULATED, TRUE = (DATA_COLOURS[key] for key in ("measured", "simulated", "true"))
FORCE = "#2e8b57"
_BEFORE = "#bbbbbb"
AXIS_LINES = {"x": "-", "y": "--", "z": ":"}
"""A direction is a line style, so that colours distinguish measured from simulated."""
AXIS_DOTS = {"x": "o", "y": "s", "z": "^"}


def report_figures(estimate: dict[str, Any]) -> Iterator[tuple[Any, str]]:
    """Yield each figure (matplotlib) of the content of ``estimate.json``, with its caption."""
    yield (young_along_branch(estimate), _interval_caption(estimate))
    yield (what_the_pulls_tell(estimate),
           "How well the pulls determine each parameter: standard deviation (of a modulus E: of "
           "its logarithm) before the fit, at its start, and after it. Above "
           f"{UNRESOLVED_DEVIATION:g} (line) a modulus is linked to its neighbour.")
    yield (loss_over_evaluations(estimate),
           "Loss against forward simulations; the line is the lowest so far.")
    for pull in estimate["pulls"]:
        if np.size(pull["observed_m"]):
            yield (simulated_over_observed(pull, estimate),
                   f"Pull {pull['name']}: the model (black) over the observed points "
                   "(turquoise) at several frames; orange bars are residuals, ten times enlarged.")
        if np.size(pull.get("point_residual", ())):
            yield (residuals_over_time(pull),
                   f"Pull {pull['name']}: residuals of each point and of the force, divided by "
                   f"their standard deviation. About 1 is noise; crosses (above {OUTLIER}) are "
                   "outliers.")
        if pull["measured_force_n"] and _numbers(pull["measured_force_n"]).size:
            yield (force_over_time(pull),
                   f"Pull {pull['name']}: force of the gripper on the branch.")
    if estimate.get("drift"):
        yield (modulus_over_days(estimate),
               "Modulus of each pull over the joint one, with 95 % intervals, and its change per "
               "day.")
    if estimate.get("held_out"):
        yield (held_out_scores(estimate),
               "Pulls predicted by a fit without them: error relative to the pull's travel and "
               "peak force.")


def young_along_branch(estimate: dict[str, Any]) -> Any:
    """E at the control points with intervals, and the truth if known."""
    figure, axes = chart(5.2, 3.2, "position on the main path (0 base, 1 tip)",
                         "Young's modulus [MPa]")
    fractions = np.array(estimate["fractions"])
    young = np.array(estimate["young_pa"]) / 1e6
    interval = np.array(estimate["young_interval_pa"]) / 1e6
    sensor = np.array(estimate.get("young_interval_sensor_pa", estimate["young_interval_pa"]))
    if len(fractions) == 1:
        # One modulus for the whole branch.
        fractions, young = np.array([0.0, 1.0]), np.repeat(young, 2)
        interval, sensor = np.repeat(interval, 2, axis=0), np.repeat(sensor, 2, axis=0)
    axes.fill_between(fractions, *interval.T, color=SIMULATED, alpha=0.18, lw=0,
                      label="95 %, including radii and mesh")
    axes.errorbar(fractions, young, np.abs(sensor.T / 1e6 - young), fmt="o-", color=SIMULATED,
                  capsize=4, label="estimated, 95 % from the sensors alone")
    if truth := estimate.get("truth"):
        axes.plot(truth["fractions"], np.array(truth["young_pa"]) / 1e6, "D", ms=7, mfc="none",
                  color=TRUE, label="assumed" if truth.get("assumed") else "true")
    is_wide = young.max() > 5 * young.min() or interval[:, 1].max() > 20 * young.max()
    axes.set_yscale("log" if is_wide else "linear")
    axes.set_ylim(bottom=None if is_wide else 0)
    axes.set_xlim(0, 1)
    figure.legend(frameon=False, ncols=2, fontsize=8, loc="outside upper left")
    return figure


def what_the_pulls_tell(estimate: dict[str, Any]) -> Any:
    """Standard deviations of the parameters before and after the fit, one per row."""
    before = np.array(estimate["deviations_before_fit"], float)
    after = np.sqrt(np.abs(np.diag(np.array(estimate["covariance"], float))))
    groups = [*estimate["groups"]]
    extra = estimate["parameters"][len(set(groups)):]
    names = [f"E{k + 1}" for k in range(len(groups))] + list(extra)
    after = np.concatenate([after[groups], after[len(set(groups)):]])
    # Parameter names are words; stacked vertically they do not overlap.
    figure, axes = chart(6.0, 1.2 + 0.3 * len(names), "standard deviation", "")
    rows = np.arange(len(names))
    least = 1e-4
    axes.barh(rows - 0.2, np.clip(before[:len(names)], least, 1e3), 0.38, color=_BEFORE,
              label="before the fit")
    axes.barh(rows + 0.2, np.clip(after, least, 1e3), 0.38, color=SIMULATED, label="after the fit")
    axes.axvline(UNRESOLVED_DEVIATION, color=TRUE, lw=0.8)
    axes.set_xscale("log")
    axes.set_yticks(rows, names)
    axes.invert_yaxis()
    figure.legend(frameon=False, ncols=2, loc="outside upper right")
    return figure


def residuals_over_time(pull: dict[str, Any]) -> Any:
    """Standardised residual of every point and of the force at every frame."""
    figure, axes = chart(5.2, 3.0, "time [s]", "residual / standard deviation")
    points = _numbers(pull["point_residual"])
    time = np.array(pull["all_times_s"])
    force = _numbers(pull["force_residual"])
    shades = ["#222222", "#666666", "#999999", "#c4c4c4"]
    columns = [(f"point {k + 1}", points[:, k], shades[k % 4]) for k in range(points.shape[1])]
    if np.isfinite(force).any():
        columns.append(("force", force, FORCE))
    for label, values, colour in columns[:9]:
        axes.plot(time, values, ".-", ms=3, lw=0.7, color=colour, label=label)
        far = np.where(np.isfinite(values), values, 0.0) > OUTLIER
        axes.plot(time[far], values[far], "x", color=TRUE, ms=7)
    axes.axhline(OUTLIER, color=TRUE, lw=0.8)
    axes.set_ylim(bottom=0)
    figure.legend(frameon=False, ncol=5, fontsize=8, loc="outside upper left")
    return figure


def modulus_over_days(estimate: dict[str, Any]) -> Any:
    """Each pull's modulus over the joint one against the day of its recording."""
    figure, axes = chart(5.2, 3.2, "days", "E of the pull over the joint E")
    known = [each for each in estimate["pull_moduli"] if each["recorded"]]
    times = np.array([datetime.fromisoformat(each["recorded"]).timestamp() for each in known])
    days = (times - times.min()) / 86400.0
    factor = np.array([each["factor"] for each in known])
    low, high = np.array([each["interval"] for each in known]).T
    axes.errorbar(days, factor, [factor - low, high - factor], fmt="o", color=SIMULATED)
    rate = np.log1p(estimate["drift"]["per_day"])
    middle = np.exp(np.mean(np.log(factor)) + rate * (np.sort(days) - days.mean()))
    axes.plot(np.sort(days), middle, color=SIMULATED, lw=1)
    return figure


def held_out_scores(estimate: dict[str, Any]) -> Any:
    """Errors of predicted pulls in percent, of points and force."""
    scores = estimate["held_out"]
    figure, axes = chart(5.2, 1.2 + 0.45 * len(scores), "error of the predicted pull [%]", "")
    rows = np.arange(len(scores))
    for shift, key, colour, label in (
            (0.2, "relative_distance", SIMULATED, "points, relative to travel"),
            (-0.2, "relative_force", FORCE, "force, relative to its peak")):
        values = 100 * _numbers([score.get(key) for score in scores.values()])
        axes.barh(rows + shift, np.nan_to_num(values), 0.36, color=colour, label=label)
    axes.set_yticks(rows, [name if score.get("in_fit", True) else f"{name} (not in the fit)"
                           for name, score in scores.items()])
    figure.legend(frameon=False, ncol=2, fontsize=8, loc="outside upper right")
    return figure


def loss_over_evaluations(estimate: dict[str, Any]) -> Any:
    """The paper's loss J [m^2] of every forward simulation."""
    figure, axes = chart(5.2, 3.2, "forward simulations", "loss J [m²]")
    loss = _numbers([entry["loss_m2"] for entry in estimate["history"]])
    count = np.arange(1, len(loss) + 1)
    axes.semilogy(count, loss, ".", color="#999999")
    axes.semilogy(count, np.fmin.accumulate(loss), color=SIMULATED, label=estimate["method"])
    axes.legend(frameon=False)
    return figure


def simulated_over_observed(pull: dict[str, Any], estimate: dict[str, Any]) -> Any:
    """Observed and simulated points at several frames, in the plane of largest motion."""
    figure, axes = chart(5.2, 4.2, "sideways [m]", "along the branch at rest [m]")
    observed, simulated = _numbers(pull["observed_m"]), _numbers(pull["simulated_m"])
    rest = np.array(estimate["control_points_m"])
    centre = rest.mean(axis=0)
    up = np.linalg.svd(rest - centre)[2][0]
    up = up * np.sign(up[2] or 1.0)
    motion = (simulated - simulated[0]).reshape(-1, 3)
    sideways = motion - np.outer(motion @ up, up)
    across = np.linalg.svd(sideways, full_matrices=False)[2][0]
    plane = np.column_stack([across, up])
    for number in range(len(observed)):
        shade = 0.3 + 0.7 * (number + 1) / len(observed)
        seen, model = (observed[number] - centre) @ plane, (simulated[number] - centre) @ plane
        is_last = number == len(observed) - 1
        axes.plot(*model.T, "-", color=SIMULATED, alpha=shade, lw=2,
                  label="simulated" if is_last else None)
        axes.plot(*seen.T, "o", color=OBSERVED, alpha=shade, ms=4,
                  label="observed" if is_last else None)
        for start, end in zip(model, model + 10 * (seen - model), strict=True):
            axes.plot([start[0], end[0]], [start[1], end[1]], color=TRUE, alpha=shade, lw=0.8)
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(frameon=False, loc="lower left")
    return figure


def force_over_time(pull: dict[str, Any]) -> Any:
    """Measured and simulated force of the gripper on the branch."""
    figure, axes = chart(5.2, 3.0, "time [s]", "force [N]")
    measured, simulated = _numbers(pull["measured_force_n"]), _numbers(pull["simulated_force_n"])
    time = np.array(pull["all_times_s"])
    for column, name in enumerate("xyz"):
        axes.plot(time, measured[:, column], AXIS_DOTS[name], ms=3, color=OBSERVED,
                  label=f"{name} measured")
        axes.plot(time, simulated[:, column], AXIS_LINES[name], color=SIMULATED,
                  label=f"{name} simulated")
    figure.legend(frameon=False, ncols=3, fontsize=8, loc="outside upper left")
    return figure


def _interval_caption(estimate: dict[str, Any]) -> str:
    parts = estimate.get("young_deviation") or {}
    shares = [f"{name} {100 * max(np.atleast_1d(parts[key])):.1f} %" for key, name in
              (("sensor", "sensors"), ("geometry", "shape from the scan"), ("mesh", "mesh"))
              if parts.get(key) is not None]
    missing = "" if not parts else (
        " The radii have no stated deviation, so the interval does not include their error."
        if parts.get("geometry") is None else " The position of the scan's axis is assumed exact."
        if parts.get("axis_is_exact", True) else "")
    named = f"; largest standard deviations from: {', '.join(shares)}" if shares else ""
    return f"Young's modulus along the branch with its 95 % interval{named}.{missing}"


def _numbers(values: Any) -> np.ndarray:
    """Values as an array; JSON's null (not measured) becomes NaN."""
    return np.array(values, dtype=float)
