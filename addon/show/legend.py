"""The legend in the 3D view: the branch's colours with their values, and what balls and lines are.
"""

import json
import textwrap

import blf
import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ..branch import branches
from ..plan import energy_field
from . import frame_colours, scene
from .graph import strip
from .view_borders import covered_width, write

_MARGIN, _WIDTH, _HEIGHT, _TEXT = 24, 16, 160, 12
_BETWEEN, _LINE_LETTERS = 20, 20
_KEY_LINE, _KEY_SIZE = 18, 10
_GAP = 60  # above the lower edge: Blender's text there stays readable


def shown_scales(surface: bpy.types.Object) -> list[dict]:
    """Return the scales of everything coloured now: the branch's, then those of its surroundings.
    """
    scales = [frame_colours.shown_scale(surface) or _scale_at_rest(surface)]
    branch = branches.branch_of(surface)
    for thing in branches.parts_of(branch).values():
        is_seen = thing.visible_get() or (energy_field.is_sliced(bpy.context.scene)
                                          and thing == energy_field.of(branch))
        if branches.SCALE_KEY in thing and is_seen:
            scales.append(json.loads(thing[branches.SCALE_KEY]))
    told = {scale["title"]: scale for scale in scales if scale is not None}
    return list(told.values())


def shown_marks(surface: bpy.types.Object) -> list[str]:
    """Return the kinds of balls, lines and rings of the branch in sight, as :data:`scene.NAMES`."""
    seen = {thing[branches.SHOWS_KEY]
            for thing in branches.parts_of(branches.branch_of(surface)).values()
            if thing.visible_get()}
    return [kind for kind in scene.NAMES if kind in seen]


def _scale_at_rest(surface: bpy.types.Object) -> dict | None:
    active = surface.data.color_attributes.active_color
    scalars = branches.info_of(surface).get("scalars", {})
    return scalars.get(active.name.removesuffix("_color")) if active is not None else None


def bar(stops: list[list[float]], x: float, y: float, width: float, height: float,
        ) -> tuple[list, list, list]:
    """Return corners, their colours and triangles of a bar of rows ``[position, r, g, b]``."""
    places, triangles = strip([[y + stop[0] * height, x, x + width] for stop in stops])
    colours = [(*display(np.array(stop[1:])), 1.0) for stop in stops for _ in range(2)]
    return [place[::-1] for place in places], colours, triangles


def display(linear: np.ndarray) -> np.ndarray:
    """Return linear components of colours as sRGB."""
    return np.where(linear < 0.0031308, 12.92 * linear,
                    1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def _draw() -> None:
    context = bpy.context
    surface = branches.find_surface(context.scene)
    if (surface is None or not context.scene.limber.show_legend or not surface.visible_get()
            or not context.space_data.overlay.show_overlays):
        return
    shading = context.space_data.shading
    if shading.type == "WIREFRAME" or (shading.type == "SOLID" and shading.color_type != "VERTEX"):
        return
    size = context.preferences.system.ui_scale
    x, y = covered_width(context, "TOOLS") + _MARGIN * size, _GAP * size
    scales = shown_scales(surface)
    for scale in scales:
        places, colours, triangles = bar(scale["stops"], x, y, _WIDTH * size, _HEIGHT * size)
        shader = gpu.shader.from_builtin("SMOOTH_COLOR")
        gpu.state.blend_set("ALPHA")
        batch_for_shader(shader, "TRIS", {"pos": places, "color": colours},
                         indices=triangles).draw(shader)
        gpu.state.blend_set("NONE")
        x += _write(scale, x, y, size) + _BETWEEN * size
    if scales:
        y += (_HEIGHT + 26 + 16 * max(len(_title_lines(scale)) for scale in scales)) * size
    x = covered_width(context, "TOOLS") + _MARGIN * size
    for number, kind in enumerate(reversed(shown_marks(surface))):
        _draw_key(kind, x, y + number * _KEY_LINE * size, size)


def _draw_key(kind: str, x: float, y: float, size: float) -> None:
    """Draw the colour of a kind of mark, and its name."""
    side = _KEY_SIZE * size
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    shader.uniform_float("color", (*display(np.array(scene.COLORS[kind])), 1.0))
    batch_for_shader(shader, "TRIS", {"pos": [(x, y), (x + side, y), (x + side, y + side),
                                              (x, y + side)]},
                     indices=[(0, 1, 2), (0, 2, 3)]).draw(shader)
    write([scene.NAMES[kind]], x + side + 6 * size, y, _TEXT * size, 0.0)


def _write(scale: dict, x: float, y: float, size: float) -> float:
    """Write title and values of a scale; returns its width [pixels]."""
    ticks, lines = scale["ticks"], _title_lines(scale)
    write(map(str, ticks), x + (_WIDTH + 6) * size, y - 4 * size, _TEXT * size,
          _HEIGHT * size / max(len(ticks) - 1, 1))
    write(reversed(lines), x, y + (_HEIGHT + 10) * size, _TEXT * size, 16 * size)
    return max(blf.dimensions(0, line)[0] for line in lines)


def _title_lines(scale: dict) -> list[str]:
    return textwrap.wrap(scale["title"] + (", log scale" if scale["log"] else ""), _LINE_LETTERS)


DRAWN = (_draw, "POST_PIXEL")
