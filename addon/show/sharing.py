"""Export the branch's motion to other programs, and show it from all sides."""

import math
from pathlib import Path
from typing import ClassVar

import bpy
from mathutils import Vector

from ..branch import branches, parts
from ..branch.needs_result import NeedsBranchInObjectMode

_KINDS = (".abc", ".usd", ".usda", ".usdc", ".usdz")
RIG = "Turntable"
_KEY = "limber_turntable"
"""Key of the objects that the turntable made: pressed again, it makes them again."""


class LIMBER_OT_export_motion(NeedsBranchInObjectMode, bpy.types.Operator):
    """Write the moving branch, with its values at each vertex, to an Alembic (.abc) or USD file"""

    bl_idname = "limber.export_motion"
    bl_label = "Export Motion"

    filepath: bpy.props.StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: bpy.props.StringProperty(default=";".join(f"*{kind}" for kind in _KINDS),
                                          options={"HIDDEN"})
    whole: bpy.props.BoolProperty(
        name="Whole Branch", default=False,
        description="Also export marks, paths, skeleton and robot; otherwise only the branch")

    def invoke(self, context, event):
        if not self.filepath:
            surface = branches.find_surface(context.scene)
            self.filepath = f"{surface.name}.abc"
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        path = Path(bpy.path.abspath(self.filepath))
        kind = path.suffix.lower()
        if kind not in _KINDS:
            self.report({"ERROR"}, f"{path.name} has an unsupported ending. Use .abc, .usd, "
                                   ".usda, .usdc or .usdz.")
            return {"CANCELLED"}
        built = bpy.app.build_options.alembic if kind == ".abc" else bpy.app.build_options.usd
        if not built:
            self.report({"ERROR"}, f"This Blender was built without "
                                   f"{'Alembic' if kind == '.abc' else 'USD'}.")
            return {"CANCELLED"}
        surface = branches.find_surface(context.scene)
        things = [surface] if not self.whole else list(
            branches.parts_of(branches.branch_of(surface)).values())
        before = (context.view_layer.objects.active, list(context.selected_objects))
        try:
            _select(context, [thing for thing in things if thing.visible_get()], surface)
            self._write(context.scene, path)
        except RuntimeError as error:
            self.report({"ERROR"}, f"{path} cannot be written ({error}).")
            return {"CANCELLED"}
        finally:
            _select(context, before[1], before[0])
        self.report({"INFO"}, f"{path.name}: frames {context.scene.frame_start} to "
                              f"{context.scene.frame_end}")
        return {"FINISHED"}

    def _write(self, current: bpy.types.Scene, path: Path) -> None:
        if path.suffix.lower() == ".abc":
            bpy.ops.wm.alembic_export(
                filepath=str(path), start=current.frame_start, end=current.frame_end,
                selected=True, vcolors=True, as_background_job=False)
        else:
            bpy.ops.wm.usd_export(filepath=str(path), selected_objects_only=True,
                                  export_animation=current.frame_end > current.frame_start)


class LIMBER_OT_turntable(NeedsBranchInObjectMode, bpy.types.Operator):
    """Add a camera that circles the branch once, and look through it. Press again to fit the camera
    to the branch as it is shown now"""

    bl_idname = "limber.turntable"
    bl_label = "Turntable"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    frames: bpy.props.IntProperty(
        name="Frames", default=120, min=2, soft_max=1000,
        description="Number of frames of one turn, from the scene's first frame")
    above: bpy.props.FloatProperty(
        name="Above [deg]", default=15.0, min=-80.0, max=80.0,
        description="Elevation of the camera above the branch")

    def execute(self, context):
        current = context.scene
        surface = branches.find_surface(current)
        _remove_rig()
        rig = bpy.data.collections.new(RIG)
        current.collection.children.link(rig)
        middle, radius = _bounds(surface)
        pivot = bpy.data.objects.new(f"{RIG} pivot", None)
        lens = bpy.data.cameras.new(f"{RIG} camera")
        camera = bpy.data.objects.new(f"{RIG} camera", lens)
        for thing in (pivot, camera):
            rig.objects.link(thing)
            thing[_KEY] = True
        pivot.location, camera.parent = middle, pivot
        pivot.empty_display_size = 0.1 * radius
        distance = 1.15 * radius / math.sin(_half_angle(current.render, lens))
        tilt = math.radians(self.above)
        camera.location = (0.0, -distance * math.cos(tilt), distance * math.sin(tilt))
        camera.rotation_euler = (math.pi / 2 - tilt, 0.0, 0.0)
        lens.clip_start, lens.clip_end = distance / 1000, 10 * distance
        _turn(pivot, current.frame_start, self.frames)
        current.camera = camera
        return {"FINISHED"}


def _half_angle(render: bpy.types.RenderSettings, lens: bpy.types.Camera) -> float:
    """Return half of the angle of view [rad] of the picture's shorter side."""
    sides = (render.resolution_x * render.pixel_aspect_x,
             render.resolution_y * render.pixel_aspect_y)
    # The lens's own angle is that of the longer side.
    return math.atan(math.tan(lens.angle / 2) * min(sides) / max(sides))


def _turn(pivot: bpy.types.Object, first: int, frames: int) -> None:
    """Key one turn at constant speed, each frame: no interpolation of the user's choice changes it.
    """
    for number in range(frames + 1):
        pivot.rotation_euler[2] = 2 * math.pi * number / frames
        pivot.keyframe_insert("rotation_euler", index=2, frame=first + number)
    pivot.rotation_euler[2] = 0.0


def _bounds(surface: bpy.types.Object) -> tuple[Vector, float]:
    corners = [surface.matrix_world @ Vector(corner) for corner in surface.bound_box]
    middle = sum(corners, Vector()) / len(corners)
    return middle, max((corner - middle).length for corner in corners)


def _remove_rig() -> None:
    for thing in [thing for thing in bpy.data.objects if _KEY in thing]:
        homes = thing.users_collection
        parts.remove(thing)
        for home in homes:
            if home.name.startswith(RIG) and not home.all_objects and not home.children:
                bpy.data.collections.remove(home)


def _select(context: bpy.types.Context, things: list[bpy.types.Object],
            active: bpy.types.Object | None) -> None:
    for other in context.view_layer.objects:
        other.select_set(other in things)
    context.view_layer.objects.active = active


CLASSES = (LIMBER_OT_export_motion, LIMBER_OT_turntable)
