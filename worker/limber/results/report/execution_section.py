"""The figure of an execution by a robot: the measured force against the predicted one."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from limber.core.errors import InputError
from limber.recordings.time_series import read_stream
from limber.results.report.estimate_figures import OBSERVED, SIMULATED

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_POINTS = 1500
_GAP_SECONDS = 0.5
_NAMES = [*(f"{kind}_f{axis}_n" for kind in ("smooth", "expected") for axis in "xyz"),
          *(f"expected_{entry}_n2" for entry in ("xx", "yy", "zz"))]


def force_along_path(path: Path) -> "Figure":
    """Draw the measured force (smoothed), and the predicted one with its 95 % interval; InputError
    if the log is damaged, or predicts no force."""
    from matplotlib.figure import Figure

    log = read_stream(path)
    missing = [name for name in _NAMES if name not in log.columns]
    if missing:
        raise InputError(f"{path} has no column {missing[0]}.",
                         "It is not the log of an execution.",
                         "Execute the plan again.")
    table = log.values[:, [log.columns.index(name) for name in _NAMES]]
    known = np.isfinite(table).all(axis=1)
    if not known.any():
        raise InputError(f"{path} has no predicted force.",
                         "The execution did not predict the force on the branch.",
                         "Execute the plan again.")
    known = np.flatnonzero(known)
    known = known[::max(1, len(known) // _MOST_POINTS)]
    times, table = log.times[known] - log.times[known[0]], table[known]
    # The line is interrupted where no force was predicted.
    after = np.flatnonzero(np.diff(times) > _GAP_SECONDS) + 1
    times, table = np.insert(times, after, np.nan), np.insert(table, after, np.nan, axis=0)
    felt, expected, variances = table[:, :3], table[:, 3:6], table[:, 6:]
    figure = Figure(figsize=(9.0, 5.2), layout="constrained")
    for axes, column, name in zip(figure.subplots(3, 1, sharex=True), range(3), "xyz",
                                  strict=True):
        half = 1.96 * np.sqrt(np.maximum(variances[:, column], 0.0))
        axes.fill_between(times, expected[:, column] - half, expected[:, column] + half,
                          color=SIMULATED, alpha=0.2, lw=0)
        axes.plot(times, expected[:, column], color=SIMULATED, label="predicted, 95 % interval")
        axes.plot(times, felt[:, column], ".", ms=2, color=OBSERVED, label="measured")
        axes.set_ylabel(f"force {name} [N]")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25)
        if name == "x":
            axes.legend(frameon=False, ncols=2)
    axes.set_xlabel("time since the robot started [s]")
    return figure
