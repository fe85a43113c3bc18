"""Differences between Blender 4.2 and 5.2, and between builds, in one module."""

import ctypes
import os

import bpy

IS_MODULE = bool(getattr(bpy.app, "module", not bpy.app.binary_path))
"""Whether this is the ``bpy`` package in a plain Python, not Blender's program. In 4.2 only the
missing program shows it.
"""

PATH_OPTIONS: set[str] = (
    {"PATH_SUPPORTS_BLEND_RELATIVE"}
    if "is_path_supports_blend_relative" in bpy.types.Property.bl_rna.properties else set())
"""Options of a property that holds a path: it may begin with ``//``, and Blender keeps it correct.
"""

POINT_SHADER = "POINT_UNIFORM_COLOR" if bpy.app.version >= (4, 5, 0) else "UNIFORM_COLOR"
"""Built-in shader of points with a size in pixels."""

COLOURED_POINT_SHADER = "POINT_FLAT_COLOR" if bpy.app.version >= (4, 5, 0) else "FLAT_COLOR"
"""The same with a colour per point; if it exists the other draws points of one pixel."""


def can_denoise() -> bool:
    """Whether Cycles has OpenImageDenoise; Debian's build does not, and cannot render with it."""
    try:
        import _cycles
    except ImportError:
        return False
    return bool(getattr(_cycles, "with_openimagedenoise", False))


def use_nodes(thing: bpy.types.Material | bpy.types.World) -> None:
    """Give a material or world its nodes; from 5.0 on it always has them."""
    if bpy.app.version < (5, 0, 0):
        thing.use_nodes = True


def curve_lists(thing: bpy.types.Object) -> list:
    """Return the lists of an object's animation that hold its curves; from 5.0 on those of its
    slot.
    """
    data = thing.animation_data
    if data is None or data.action is None:
        return []
    if hasattr(data.action, "fcurves"):
        return [data.action.fcurves]
    bags = (strip.channelbag(data.action_slot) for layer in data.action.layers
            for strip in layer.strips)
    return [bag.fcurves for bag in bags if bag is not None]


def fcurves_of(thing: bpy.types.Object) -> list[bpy.types.FCurve]:
    """Return the curves of an object's animation."""
    return [curve for curves in curve_lists(thing) for curve in curves]


def flush_native_output() -> None:
    """Flush the output of Blender's C code, so that it does not follow later output."""
    if os.name == "posix":
        ctypes.CDLL(None).fflush(None)


def placeholder(text: str) -> dict[str, str]:
    """Return the argument of ``UILayout.prop`` that shows a text while a field is empty; none if
    this Blender does not have it.
    """
    known = bpy.types.UILayout.bl_rna.functions["prop"].parameters
    return {"placeholder": text} if "placeholder" in known else {}
