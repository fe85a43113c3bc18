"""Common parts of the report's figures: charts with labels, and two views of a branch."""

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def chart(width: float, height: float, across: str, up: str, *, has_grid: bool = False,
          ) -> tuple["Figure", "Axes"]:
    """Return a figure of one chart, with labels; without a grid, top and right spines are off."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots()
    axes.set(xlabel=across, ylabel=up)
    if has_grid:
        axes.grid(alpha=0.25)
    else:
        axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


_NUMBER_INCHES = 0.6  # width of a number below an axis


def two_views(points: np.ndarray) -> tuple["Figure", list[tuple["Axes", int, int]]]:
    """Return a figure of the front and the side of ``points`` [n, 3], each with its axes,
    horizontal or depth coordinate; z points up."""
    import matplotlib.pyplot as plt
    from matplotlib.ticker import MaxNLocator

    extent = np.ptp(points, axis=0)
    height = 7.0
    widths = np.clip(height * extent[:2] / max(extent[2], 1e-9), 2.0, 6.0)
    figure, axes = plt.subplots(1, 2, figsize=(widths.sum() + 2.5, height), layout="constrained",
                                width_ratios=widths)
    for axis, label, width in zip(axes, "xy", widths, strict=True):
        axis.set(xlabel=f"{label} [m]", ylabel="z [m]", aspect="equal")
        # A view may be as narrow as a branch: few tick labels, rotated so that they do not overlap.
        drawn = min(width, height * float(np.ptp(points[:, "xy".index(label)]) / extent[2]))
        axis.xaxis.set_major_locator(MaxNLocator(
            max(1, int(drawn / _NUMBER_INCHES)), steps=[1, 2, 5, 10]))
        if drawn < 2 * _NUMBER_INCHES:
            axis.tick_params(axis="x", rotation=90)
        axis.grid(alpha=0.25)
    return figure, [(axes[0], 0, 1), (axes[1], 1, 0)]


def draw_faces(axis: "Axes", corners: np.ndarray, colours: np.ndarray, across: int, depth: int,
               ) -> None:
    """Draw triangles [n, 3, 3] in their colours, back to front."""
    from matplotlib.collections import PolyCollection

    order = np.argsort(corners[:, :, depth].mean(axis=1) * (1 if across else -1))
    flat: Any = corners[order][:, :, [across, 2]]
    axis.add_collection(PolyCollection(flat, facecolors=colours[order], edgecolors="face",
                                       linewidths=0.1))
    axis.autoscale_view()
