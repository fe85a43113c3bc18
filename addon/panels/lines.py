"""Texts of the panels in lines as wide as the sidebar, measured in the interface's font."""

from functools import lru_cache

import blf
import bpy

_DEFAULT_WIDTH = 280
"""Width of a sidebar that nobody has dragged, at a scale of 1 [pixels]."""
_BESIDE, _ICON = 58, 21
"""Width of the tabs, the scroll bar and the margins beside a text, and of an icon before it, at a
scale of 1 [pixels]."""
_LABEL_SHARE = 0.4
_GAP = 8
"""Width between a text and what stands beside it [pixels]."""


def draw_text(layout: bpy.types.UILayout, context: bpy.types.Context, text: str,
              icon: str = "NONE") -> None:
    """Draw a text in as many lines as the sidebar's width asks for, an icon before the first."""
    column = layout.column(align=True)
    space = room(context) - (0 if icon == "NONE" else _ICON * _scale(context))
    for number, line in enumerate(wrapped(text, space)):
        column.label(text=line, icon=icon if number == 0 or icon == "NONE" else "BLANK1")


def draw_pair(layout: bpy.types.UILayout, context: bpy.types.Context, title: str, value: str,
              share: float = 0.5) -> None:
    """Draw a title that takes ``share`` of the width with its value beside it, else above it."""
    space = room(context)
    if width(title) > share * space - _GAP or width(value) > (1.0 - share) * space - _GAP:
        draw_text(layout, context, title)
        draw_text(layout, context, value, "BLANK1")
        return
    row = layout.split(factor=share)
    row.label(text=title)
    row.label(text=value)


def has_room_beside(context: bpy.types.Context, title: str, value: str) -> bool:
    """Whether a title is as narrow as Blender leaves room for it at the left of its field, and the
    field's text as narrow as the field.
    """
    space = room(context)
    return width(title) <= _LABEL_SHARE * space - _GAP and (
        width(value) <= (1.0 - _LABEL_SHARE) * space - 3 * _GAP)


def room(context: bpy.types.Context) -> float:
    """Return the width for a text in a panel of the sidebar [pixels]."""
    region, scale = context.region, _scale(context)
    width = region.width if region is not None and region.type == "UI" else _DEFAULT_WIDTH * scale
    return max(width, 2 * _BESIDE * scale) - _BESIDE * scale


def wrapped(text: str, space: float) -> tuple[str, ...]:
    """Return the lines of a text, none wider than ``space`` [pixels]: words stay whole if they fit.
    """
    lines: list[str] = []
    for word in text.split():
        if lines and width(f"{lines[-1]} {word}") <= space:
            lines[-1] += f" {word}"
            continue
        while width(word) > space and len(word) > 1:
            fits = next(count for count in range(len(word) - 1, 0, -1)
                        if count == 1 or width(word[:count]) <= space)
            lines.append(word[:fits])
            word = word[fits:]
        lines.append(word)
    return tuple(lines)


def width(text: str) -> float:
    """Return the width of a text as a panel draws it [pixels]."""
    return _measured(text, bpy.context.preferences.ui_styles[0].widget.points * _scale(bpy.context))


@lru_cache(maxsize=4096)
def _measured(text: str, size: float) -> float:
    # The user may change the interface's scale and font size while Blender runs.
    blf.size(0, size)
    return blf.dimensions(0, text)[0]


def _scale(context: bpy.types.Context) -> float:
    # Without a window it is 0.
    return context.preferences.system.ui_scale or 1.0
