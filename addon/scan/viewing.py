"""The view after an action."""

import bpy

from ..branch import branches
from . import startup_cube


def clear_view(scene: bpy.types.Scene) -> str:
    """Hide Blender's startup cube, which encloses a branch; returns a text for the user."""
    cube = startup_cube.find(scene)
    if cube is None:
        return ""
    startup_cube.hide(scene, cube)
    return f"Blender's startup cube ({cube.name}) was hidden. Undo shows it again"


def look_at(context: bpy.types.Context, thing: bpy.types.Object) -> None:
    """Make ``thing`` active, and show it whole in the 3D views, in its colours.

    Not selected: an outline would cover the colours of thin twigs. Without a window there is no
    view to set.
    """
    branches.activate(context.scene, thing)
    if bpy.app.background or context.window is None:
        return
    thing.select_set(True)
    for area in context.window.screen.areas:
        if area.type != "VIEW_3D":
            continue
        area.spaces.active.shading.color_type = "VERTEX"
        region = next(region for region in area.regions if region.type == "WINDOW")
        with context.temp_override(area=area, region=region):
            bpy.ops.view3d.view_selected()
    thing.select_set(False)


def push_undo(context: bpy.types.Context) -> None:
    """Make what was shown one undo step; without a window there is none."""
    if not bpy.app.background and context.window is not None:
        bpy.ops.ed.undo_push(message="Limber")
