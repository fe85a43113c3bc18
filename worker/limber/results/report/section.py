"""Sections of the report: text, tables and embedded pictures, and charts to draw in."""

import base64
import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.core.errors import Command, InputError, Option

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

@dataclass
class Section:
    """One section of the page; ``missing`` is the command that would fill it."""

    title: str
    text: list[str] = field(default_factory=list)
    pictures: list[tuple[str, str]] = field(default_factory=list)
    tables: list[tuple[str, list[list[str]]]] = field(default_factory=list)
    missing: str = ""

    def draw(self, figure: Any, caption: str) -> None:
        """Add a matplotlib figure as an embedded PNG."""
        self.pictures.append((inline_png(_png(figure)), caption))


def read_png(path: Path) -> bytes:
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).", "It should be shown at the "
                         "top of the report.", "Omit ", Option("picture"), ", or name the PNG "
                         "that ", Command("scene"), " rendered.") from error
    if not data.startswith(b"\x89PNG"):
        raise InputError(f"{path} is not a PNG file.", "The report shows only PNG.", "Name a PNG.")
    return data


def _png(figure: Any) -> bytes:
    import matplotlib.pyplot as plt

    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=130, bbox_inches="tight")
    plt.close(figure)
    return stream.getvalue()


def inline_png(data: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(data).decode("ascii")


# Common parts of the report's figures: charts with labels, and two views of a branch.

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
