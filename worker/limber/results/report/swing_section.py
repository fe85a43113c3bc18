"""The report's section on the free swing used in a fit."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from limber.core.errors import InputError
from limber.core.files.reading import FileContent, read_json_as
from limber.results.report.charts import chart

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_Interval = tuple[float, float]
_Track = list[list[tuple[float | None, float | None, float | None]]]
"""Position of each marker at each time [m]; None where it was not observed."""


class SwingFile(FileContent):
    """Content of ``swing.json`` that is shown."""

    pull: str
    young_pa: float = Field(gt=0)
    young_interval_pa: _Interval
    damping_ratio: float
    damping_ratio_interval: _Interval
    release_s: float
    release_deviation_s: float
    frequency_hz: float
    relative_residual: float
    warnings: list[str] = Field([])
    times_s: list[float] = Field(min_length=2)
    seen_m: _Track
    simulated_m: _Track


def read_swing(path: Path) -> SwingFile:
    """Read the output of ``limber swing``.

    Raises:
        InputError: it cannot be read, has other content, or its tracks have unequal lengths.
    """
    swing = read_json_as(path, SwingFile, "the result of a swing")
    counts = {len(markers) for track in (swing.seen_m, swing.simulated_m) for markers in track}
    if len(swing.seen_m) != len(swing.times_s) or len(swing.simulated_m) != len(swing.times_s) or (
            len(counts) != 1 or not counts.pop()) or any(
            None in value for markers in swing.simulated_m for value in markers):
        raise InputError(f"{path}: the observed and simulated tracks do not have the same markers "
                         "and times.",
                         "The result of a swing was expected.",
                         "The file is damaged. Run `limber swing` again.")
    return swing


def swing_rows(swing: SwingFile) -> list[list[str]]:
    """Return the results of a free swing, one row per quantity: value and 95 % interval."""
    release = [swing.release_s + side * 1.96 * swing.release_deviation_s
               for side in (-1, 1)]
    rows = [["quantity", "value", "95 % interval"]]
    for label, value, interval, form, scale in (
            ("Young's modulus, mean [MPa]", swing.young_pa, swing.young_interval_pa,
             ".4g", 1e-6),
            ("damping ratio of the first vibration", swing.damping_ratio,
             swing.damping_ratio_interval, ".3g", 1.0),
            ("time of release [s]", swing.release_s, release, ".4g", 1.0)):
        low, high = interval
        rows.append([label, f"{scale * value:{form}}",
                     f"{scale * low:{form}} to {scale * high:{form}}"])
    return [*rows, ["first frequency [Hz]", f"{swing.frequency_hz:.4g}", "-"],
            ["residual relative to the largest displacement",
             f"{100 * swing.relative_residual:.2g} %",
             "-"]]


def along_path(swing: SwingFile) -> tuple[np.ndarray, np.ndarray]:
    """Return the displacement [m] along its path of the marker with the largest swing: observed
    (NaN if not observed) and simulated, shape [f] each.
    """
    seen, simulated = np.array(swing.seen_m, float), np.array(swing.simulated_m, float)
    most = int(np.argmax(np.ptp(simulated, axis=0).max(axis=1)))
    direction = np.linalg.svd(simulated[:, most] - simulated[:, most].mean(axis=0))[2][0]
    return seen[:, most] @ direction, simulated[:, most] @ direction


def swing_over_time(swing: SwingFile) -> "Figure":
    """Draw observed and simulated displacement of the marker with the largest swing."""
    from limber.results.report.estimate_figures import OBSERVED, SIMULATED

    figure, axes = chart(5.2, 3.0, "time [s]", "displacement [mm]")
    seen, simulated = along_path(swing)
    axes.plot(swing.times_s, 1e3 * seen, ".", ms=4, color=OBSERVED, label="observed")
    axes.plot(swing.times_s, 1e3 * simulated, color=SIMULATED, label="simulated")
    axes.legend(frameon=False)
    return figure
