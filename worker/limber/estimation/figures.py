"""Pictures of an estimate: E along the branch, loss against evaluations, simulated on observed."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from limber.store import Branch

OBSERVED, SIMULATED, TRUE = "#222222", "#2a6fb0", "#c0602a"


def report_figures(branch: Branch, estimate: dict[str, Any]) -> Iterator[tuple[Any, str]]:
    """Yield each figure (matplotlib) of ``estimate.json`` with its caption.

    Args:
        branch: The opened branch folder.
        estimate: Content of its ``estimate.json``.
    """
    yield (young_along_branch(estimate),
           "Young's modulus along the branch with its 95 % interval.")
    yield (loss_over_evaluations(estimate),
           "Loss against forward simulations; the line is the best so far.")
    for pull in estimate["pulls"]:
        if np.size(pull["observed_m"]):
            yield (simulated_over_observed(pull, estimate),
                   f"Pull {pull['name']}: simulated (blue) over observed (black) at several "
                   "frames; bars are residuals, ten times enlarged.")
        if pull["measured_force_n"] and _numbers(pull["measured_force_n"]).size:
            yield (force_over_time(pull),
                   f"Pull {pull['name']}: force of the gripper on the branch.")


def young_along_branch(estimate: dict[str, Any]) -> Any:
    """E at the control points with intervals, and the truth where there is one."""
    figure, axes = _figure(5.2, 3.2)
    place = np.array(estimate["fractions"])
    young = np.array(estimate["young_pa"]) / 1e6
    interval = np.array(estimate["young_interval_pa"]) / 1e6
    axes.fill_between(place, interval[:, 0], interval[:, 1], color=SIMULATED, alpha=0.2, lw=0)
    axes.errorbar(place, young, np.abs(interval.T - young), fmt="o-", color=SIMULATED, capsize=4,
                  label="estimated, 95 %")
    truth = estimate.get("truth")
    if truth:
        axes.plot(truth["fractions"], np.array(truth["young_pa"]) / 1e6, "D", ms=7, mfc="none",
                  color=TRUE, label="true")
    if young.max() > 5 * young.min():
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0)
    axes.set_xlabel("place on the main path (0 base, 1 tip)")
    axes.set_ylabel("Young's modulus [MPa]")
    axes.set_xlim(0, 1)
    axes.legend(frameon=False)
    return figure


def loss_over_evaluations(estimate: dict[str, Any]) -> Any:
    """The paper's loss J [m^2] of every forward simulation."""
    figure, axes = _figure(5.2, 3.2)
    loss = np.array([np.nan if entry["loss_m2"] is None else entry["loss_m2"]
                     for entry in estimate["history"]], float)
    count = np.arange(1, len(loss) + 1)
    axes.semilogy(count, loss, ".", color="#999999")
    axes.semilogy(count, np.fmin.accumulate(loss), color=SIMULATED,
                  label=estimate["method"])
    axes.set_xlabel("forward simulations")
    axes.set_ylabel("loss J [m²]")
    axes.legend(frameon=False)
    return figure


def simulated_over_observed(pull: dict[str, Any], estimate: dict[str, Any]) -> Any:
    """Observed and simulated points at several frames, in the plane in which they move most."""
    figure, axes = _figure(5.2, 4.2)
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
        label = {"label": "simulated"} if number == len(observed) - 1 else {}
        axes.plot(*model.T, "-", color=SIMULATED, alpha=shade, lw=2, **label)
        label = {"label": "observed"} if label else {}
        axes.plot(*seen.T, "o", color=OBSERVED, alpha=shade, ms=4, **label)
        for start, end in zip(model, model + 10 * (seen - model), strict=True):
            axes.plot([start[0], end[0]], [start[1], end[1]], color=TRUE, alpha=shade, lw=0.8)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("sideways [m]")
    axes.set_ylabel("along the branch at rest [m]")
    axes.legend(frameon=False, loc="lower left")
    return figure


def force_over_time(pull: dict[str, Any]) -> Any:
    """Measured and simulated force of the gripper on the branch."""
    figure, axes = _figure(5.2, 3.0)
    measured, simulated = _numbers(pull["measured_force_n"]), _numbers(pull["simulated_force_n"])
    time = np.array(pull["all_times_s"])
    for axis, colour in zip(range(3), ("#b03a2e", "#2e8b57", "#2a6fb0"), strict=True):
        axes.plot(time, measured[:, axis], ".", ms=4, color=colour, alpha=0.6)
        axes.plot(time, simulated[:, axis], color=colour, label="xyz"[axis])
    axes.set_xlabel("time [s]")
    axes.set_ylabel("force [N], dots measured")
    axes.legend(frameon=False, ncol=3)
    return figure


def _numbers(values: Any) -> np.ndarray:
    """JSON's null, which stands for a number that was not measured, as NaN."""
    return np.array(values, dtype=float)


def _figure(width: float, height: float) -> tuple[Any, Any]:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes
