"""The report's section on wind, snow, fruit and cuts that act on a branch."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from limber.core.files.reading import FileContent, read_arrays, read_json_as, require_shapes
from limber.geometry.tets.tet_mesh import TetMesh
from limber.results.findings import failure_sentence
from limber.results.motion_files import read_pc2
from limber.results.report.charts import draw_faces, two_views

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_Interval = tuple[float, float]
_Way = tuple[float, float, float]


class Gusts(FileContent):
    """Gusts in ``loads/NAME.json``: effects beyond those of the mean wind."""

    factor: float
    peak_factor: float
    dynamic: float
    damping: float
    mean_speed_m_s: float
    mean_tip_displacement_m: _Way


class LoadFile(FileContent):
    """Content of ``loads/NAME.json`` that is shown."""

    tip_displacement_m: _Way
    sag_m: float
    sag_interval_m: _Interval | None = None
    greatest_strain: float
    greatest_strain_interval: _Interval | None = None
    strain_over_limit: float
    frequencies_hz: list[float] = Field(min_length=1)
    frequencies_before_hz: list[float] = Field(min_length=1)
    first_frequency_interval_hz: _Interval | None = None
    wind_force_n: _Way
    added_mass_kg: float
    cut_mass_kg: float
    bears_times: float | None = None
    bears_times_interval: _Interval | None = None
    held_by: str | None = None
    gusts: Gusts | None = None


def read_load(path: Path) -> LoadFile:
    """Read the output of ``limber load --name``.

    Raises:
        InputError: it cannot be read, or has other content.
    """
    return read_json_as(path, LoadFile, "the result of a load")


def load_rows(load: LoadFile) -> list[list[str]]:
    """Return the effects of the loads on the branch, each with its interval if known."""
    tip = 1e3 * float(np.linalg.norm(load.tip_displacement_m))
    rows = [["quantity", "value", "95 % interval"],
            ["force of the wind [N]", f"{np.linalg.norm(load.wind_force_n):.3g}", ""],
            ["added mass [kg]", f"{load.added_mass_kg:.4g}", ""],
            ["mass cut off [kg]", f"{load.cut_mass_kg:.4g}", ""],
            ["displacement of the tip [mm]", f"{tip:.1f}", ""],
            ["downward part of it [mm]", f"{1e3 * load.sag_m:.1f}",
             _between(load.sag_interval_m, 1e3, 1)],
            ["largest strain", f"{load.greatest_strain:.5f}",
             _between(load.greatest_strain_interval, 1.0, 5)],
            ["largest strain over the failure strain of the wood",
             f"{100 * load.strain_over_limit:.0f} %",
             failure_sentence(load.strain_over_limit)],
            ["first frequency [Hz]", f"{load.frequencies_hz[0]:.3f}",
             _between(load.first_frequency_interval_hz, 1.0, 3)],
            ["first frequency before [Hz]", f"{load.frequencies_before_hz[0]:.3f}", ""]]
    if load.bears_times is not None:
        ended = {"strain": "then the wood fails", "equilibrium": "then it has no equilibrium"}.get(
            load.held_by or "", "larger loads were not tried")
        rows.append([f"factor on these loads that the branch bears ({ended})",
                     f"{load.bears_times:.2f}",
                     _between(load.bears_times_interval, 1.0, 2)])
    if load.gusts is not None:
        mean = 1e3 * float(np.linalg.norm(load.gusts.mean_tip_displacement_m))
        rows += [["mean wind [m/s]", f"{load.gusts.mean_speed_m_s:.2f}", ""],
                 ["displacement of the tip in the mean wind [mm]", f"{mean:.1f}", ""],
                 ["peak load of the gusts over the mean load", f"{load.gusts.factor:.2f}", ""],
                 ["dynamic amplification of the sway (1: quasi-static)",
                  f"{load.gusts.dynamic:.2f}", ""],
                 ["damping of the first mode, including the air",
                  f"{100 * load.gusts.damping:.1f} %",
                  ""]]
    return [row for row in rows if row[1] not in ("0", "0.0")]


def _between(interval: _Interval | None, factor: float, digits: int) -> str:
    if interval is None:
        return "not known"
    return " to ".join(f"{factor * value:.{digits}f}" for value in interval)


def bent_branch(mesh: TetMesh, frames: Path) -> "Figure":
    """Draw the branch as scanned (grey) and under the loads, coloured by its largest strain.

    Args:
        mesh: The branch's mesh.
        frames: Path of ``frames/load-NAME.pc2``, with its ``.npz`` beside it.

    Raises:
        InputError: the frames are damaged or belong to another mesh.
    """
    import matplotlib.pyplot as plt

    nodes, corners = np.unique(mesh.surface_faces(), return_inverse=True)
    corners = corners.reshape(-1, 3)
    positions, _, _ = read_pc2(frames)
    values = read_arrays(frames.with_suffix(".npz"), "the fields of a motion")
    arrays = {**values, "positions": positions}
    require_shapes(frames, arrays, {"positions": (2, len(nodes), 3),
                                    "principal_strain": (2, len(nodes))}, "the frames of a load")
    strain = 100 * arrays["principal_strain"][1][corners].mean(axis=1)
    shades = plt.get_cmap("inferno")
    largest = max(float(strain.max()), 1e-9)
    norm = plt.Normalize(0.0, largest)
    figure, views = two_views(positions.reshape(-1, 3))
    grey = np.tile((0.8, 0.8, 0.8, 1.0), (len(corners), 1))
    for axis, across, depth in views:
        for state, colours in zip(positions, (grey, shades(0.9 * norm(strain))), strict=True):
            draw_faces(axis, state[corners], colours, across, depth)
    scale = plt.cm.ScalarMappable(plt.Normalize(0.0, largest / 0.9), shades)
    bar = figure.colorbar(scale, ax=figure.axes, label="largest principal strain [%]", shrink=0.7)
    bar.ax.set_ylim(0.0, largest)
    return figure


def strain_along_path(from_m: np.ndarray, to_m: np.ndarray, strain: np.ndarray) -> "Figure":
    """Draw the largest strain of each piece of the main path.

    Args:
        from_m, to_m: Ends of the pieces, from the root [m], shape [n].
        strain: Largest principal strain in each, shape [n].
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 3.2), layout="constrained")
    axes = figure.add_subplot()
    axes.bar(from_m, 100 * strain, to_m - from_m, align="edge", edgecolor="white")
    axes.set(xlabel="distance from the root along the main path [m]", ylabel="largest strain [%]")
    axes.spines[["top", "right"]].set_visible(False)
    return figure
