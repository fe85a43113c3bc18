"""The view after an action."""

import bpy
from bpy_extras.view3d_utils import location_3d_to_region_2d, region_2d_to_location_3d
from mathutils import Vector

from ..branch import branches
from ..show.view_borders import covered_width
from . import startup_cube

_MARGIN = 0.08
"""Free border of a framed view, as a fraction of what is not covered."""


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
    thing.select_set(False)
    shape = thing.evaluated_get(context.evaluated_depsgraph_get())
    corners = [shape.matrix_world @ Vector(corner) for corner in shape.bound_box]
    for area in context.window.screen.areas:
        if area.type == "VIEW_3D":
            area.spaces.active.shading.color_type = "VERTEX"
            with context.temp_override(area=area):
                _frame(context, area, corners)


def _frame(context: bpy.types.Context, area: bpy.types.Area, corners: list[Vector]) -> None:
    """Show all ``corners`` [m] in the part of a view that neither toolbar nor sidebar covers."""
    region = next(region for region in area.regions if region.type == "WINDOW")
    view = area.spaces.active.region_3d
    left, right = covered_width(context, "TOOLS"), covered_width(context, "UI")
    width = region.width - left - right
    if min(width, region.height) <= 0:
        return
    middle = Vector((left + width / 2, region.height / 2))
    view.view_location = sum(corners, Vector()) / len(corners)
    view.view_distance = max(4.0 * max((corner - view.view_location).length
                                       for corner in corners), 1e-3)
    if view.view_perspective == "CAMERA":
        view.view_perspective = "PERSP"
    # By perspective one step is not exact: the next starts from where it ended.
    for _ in range(3):
        view.update()
        seen = [location_3d_to_region_2d(region, view, corner) for corner in corners]
        if None in seen:
            return
        low = Vector(tuple(map(min, *seen)))
        high = Vector(tuple(map(max, *seen)))
        size = max((high.x - low.x) / width, (high.y - low.y) / region.height)
        view.view_location += (
            region_2d_to_location_3d(region, view, (low + high) / 2, view.view_location)
            - region_2d_to_location_3d(region, view, middle, view.view_location))
        view.view_distance *= max(size / (1.0 - 2.0 * _MARGIN), 1e-3)


def push_undo(context: bpy.types.Context) -> None:
    """Make what was shown one undo step; without a window there is none."""
    if not bpy.app.background and context.window is not None:
        bpy.ops.ed.undo_push(message="Limber")
