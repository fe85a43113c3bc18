"""Drawings over the 3D view: what covers it, and texts in it."""

from collections.abc import Iterable

import blf
import bpy


def covered_width(context: bpy.types.Context, kind: str) -> float:
    """Return how many pixels of the view its toolbar ("TOOLS") or sidebar ("UI") covers."""
    region = next((region for region in context.area.regions if region.type == kind), None)
    return 0.0 if region is None or region.width <= 1 else float(region.width)


def write(lines: Iterable[str], x: float, y: float, size: float, step: float,
          colour: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)) -> None:
    """Write lines, each ``step`` above the one before it [pixels]; legible before any background.
    """
    blf.size(0, size)
    blf.color(0, *colour)
    blf.enable(0, blf.SHADOW)
    blf.shadow(0, 5, 0.0, 0.0, 0.0, 0.9)
    for number, line in enumerate(lines):
        blf.position(0, x, y + number * step, 0)
        blf.draw(0, line)
    blf.disable(0, blf.SHADOW)
