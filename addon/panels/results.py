"""The main numbers of a stage, with their units, as its result names them."""

from typing import Any

import bpy

from .lines import draw_pair

_UNITS = {"m": "m", "m2": "m²", "m3": "m³", "mm": "mm", "pa": "Pa", "j": "J", "n": "N", "s": "s",
          "percent": "%", "mb": "MB", "hz": "Hz", "kg": "kg", "rad": "rad"}
_MOST_LINES = 14
_LONGEST_LIST = 6


def draw_results(layout: bpy.types.UILayout, context: bpy.types.Context, name: str,
                 result: dict[str, Any]) -> None:
    """Draw a collapsible section with the numbers of a result."""
    lines = result_lines(result)
    if not lines:
        return
    header, body = layout.panel(f"limber_result_{name}", default_closed=True)
    header.label(text="Result")
    if body is not None:
        column = body.column(align=True)
        for title, value in lines[:_MOST_LINES]:
            draw_pair(column, context, title, value)


def result_lines(result: dict[str, Any]) -> list[tuple[str, str]]:
    """Return title and value with unit of each number, and of each short list of numbers."""
    lines = []
    for key, value in result.items():
        values = value if isinstance(value, list) else [value]
        numbers = all(isinstance(one, int | float) and not isinstance(one, bool) for one in values)
        if not values or not numbers or len(values) > _LONGEST_LIST:
            continue
        words, _, last = key.rpartition("_")
        unit = _UNITS.get(last, "") if words else ""
        title = (words if unit else key).replace("_", " ").capitalize()
        lines.append((title, f"{', '.join(f'{one:.4g}' for one in values)} {unit}".strip()))
    return lines
