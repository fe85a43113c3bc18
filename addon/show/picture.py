"""Set a picture of the branch up: camera, light, plain ground, and a legend that stays legible."""

from typing import ClassVar

import bpy
import numpy as np
from mathutils import Vector

from ..branch import branches, parts
from ..branch.branches import SHOWS_KEY, VIEW_KEY
from ..branch.needs_result import NeedsBranchInObjectMode
from ..branch.parts import ShownBranch
from . import picture_legend as legend
from . import scale_bar, scene, studio
from .scene_data import SceneData

_KEY = "limber_picture"
"""Key of the collections that this operator made: pressed again, it makes them again."""
_WIDTH = 1440
"""Of a picture 1080 pixels high."""
_FRONT = (0.0, 1.0, -0.15)


class LIMBER_OT_set_up_picture(NeedsBranchInObjectMode, bpy.types.Operator):
    """Add a camera that sees the whole motion, lights, a ground, a legend and a scale (both only
    where the legend is shown), and render colours as the legend has them. Other lights are left
    out of the picture. Press again after changes"""

    bl_idname = "limber.set_up_picture"
    bl_label = "Set Up Picture"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    def execute(self, context):
        current, surface = context.scene, branches.find_surface(context.scene)
        scene.fit_range(current, surface)
        _remove_earlier()
        before = set(bpy.data.collections)
        branch = branches.branch_of(surface)
        direction = Vector(surface.get(VIEW_KEY, _FRONT)).normalized()
        data = SceneData({"view_points": _seen(current, branch), "view_direction": np.array(
            direction)}, branches.info_of(surface))
        has_legend = current.limber.show_legend
        camera = studio.set_up_studio(current, data, studio.Picture(
            _WIDTH, legend_share=studio.LEGEND_SHARE if has_legend else 0.0))
        info, points = data.info, data.arrays["view_points"]
        middle = (info.get("base") or {}).get("centre_m", points.mean(axis=0))
        foot = np.array([middle[0], middle[1], info["ground_m"]]) + surface.delta_location
        if has_legend:
            scale_bar.add(camera.users_collection[0], camera, foot, info["size_m"])
            legend.add_legend(current, camera, data, _shown(branch, surface))
        made = set(bpy.data.collections) - before
        ours = {thing for collection in made for thing in collection.objects}
        for each in (*made, *ours):
            each[_KEY] = True
        for thing in current.objects:
            if thing.type == "LIGHT" and thing not in ours:
                thing.hide_render = True
        _look_through_it(context)
        branches.activate(current, surface)
        self.report({"INFO"}, "Press Render for the picture")
        return {"FINISHED"}


def _seen(scene: bpy.types.Scene, branch: bpy.types.Collection) -> np.ndarray:
    """Return corners of everything in the picture, at rest and moved [m], shape [n, 3]."""
    frame, corners = scene.frame_current, []
    for each in {scene.frame_start, (scene.frame_start + scene.frame_end) // 2, scene.frame_end}:
        scene.frame_set(each)
        graph = bpy.context.evaluated_depsgraph_get()
        for thing in branches.parts_of(branch).values():
            if thing.hide_render or thing.hide_viewport or thing.type not in ("MESH", "CURVE"):
                continue
            shape = thing.evaluated_get(graph)
            corners += [shape.matrix_world @ Vector(corner) for corner in shape.bound_box]
    scene.frame_set(frame)
    return np.array(corners, float)


def _shown(branch: bpy.types.Collection, surface: bpy.types.Object) -> ShownBranch:
    shown = ShownBranch(branch, surface)
    for thing in branches.parts_of(branch).values():
        if not thing.hide_render:
            shown.objects.setdefault(thing[SHOWS_KEY], []).append(thing)
    return shown


def _look_through_it(context: bpy.types.Context) -> None:
    if bpy.app.background or context.window is None:
        return
    for area in context.window.screen.areas:
        if area.type == "VIEW_3D":
            area.spaces.active.region_3d.view_perspective = "CAMERA"


def _remove_earlier() -> None:
    for collection in [each for each in bpy.data.collections if _KEY in each]:
        for thing in list(collection.objects):
            if _KEY in thing:
                parts.remove(thing)
        if collection.all_objects or collection.children:
            # The user has put something in: it is the user's now.
            del collection[_KEY]
        else:
            bpy.data.collections.remove(collection)
    parts.remove_unused()


CLASSES = (LIMBER_OT_set_up_picture,)
