"""The figure of a free swing that was fitted."""

from typing import TYPE_CHECKING

import numpy as np

from limber.results.report.charts import chart

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def along_path(seen: np.ndarray, simulated: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the displacement [m] along its path of the marker with the largest swing, observed
    (NaN if not) and simulated, shape [n] each, from those of all markers, [n, markers, 3]."""
    most = int(np.argmax(np.ptp(simulated, axis=0).max(axis=1)))
    direction = np.linalg.svd(simulated[:, most] - simulated[:, most].mean(axis=0))[2][0]
    return seen[:, most] @ direction, simulated[:, most] @ direction


def swing_over_time(times: np.ndarray, seen: np.ndarray, simulated: np.ndarray) -> "Figure":
    """Draw observed and simulated displacement of the marker with the largest swing."""
    from limber.results.report.estimate_figures import OBSERVED, SIMULATED

    figure, axes = chart(5.2, 3.0, "time [s]", "displacement [mm]")
    seen, simulated = along_path(seen, simulated)
    axes.plot(times, 1e3 * seen, ".", ms=4, color=OBSERVED, label="observed")
    axes.plot(times, 1e3 * simulated, color=SIMULATED, label="simulated")
    axes.legend(frameon=False)
    return figure
