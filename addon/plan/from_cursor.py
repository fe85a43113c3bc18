"""Take a position from the 3D cursor, or a region from an object or from selected points."""

from pathlib import Path
from typing import ClassVar

import bpy
from mathutils import Vector

from .. import properties
from ..branch import branches
from ..jobs.stages import stages
from ..jobs.steps import PLACES, REGIONS
from . import goal_ball

_BALLS = ("goal", "tip_goal")
"""Regions that are balls; the others are boxes."""


class LIMBER_OT_from_cursor(bpy.types.Operator):
    """Set this position to the 3D cursor; a list of positions gets a new entry"""

    bl_idname = "limber.from_cursor"
    bl_label = "From 3D Cursor"
    bl_options: ClassVar = {"REGISTER", "UNDO", "INTERNAL"}

    stage: bpy.props.StringProperty()
    field: bpy.props.StringProperty()

    def execute(self, context):
        stage = stages().get(self.stage)
        field = stage.fields.get(self.field) if stage else None
        is_list = field is not None and field.name in PLACES
        if field is None or not (is_list or (field.kind == "vector" and field.length == 3)):
            self.report({"ERROR"}, f"{self.stage} has no position {self.field!r}.")
            return {"CANCELLED"}
        group = properties.group_of(context.scene, stage)
        cursor = context.scene.cursor.location
        if stage.name == "reconstruct":
            scan = _scan_of(context)
            if scan is None:
                self.report({"ERROR"}, "The scan is not shown. Import it, then place the cursor.")
                return {"CANCELLED"}
            properties.put(group, field, _in_file(scan, [scan.matrix_world.inverted() @ cursor])[0])
            return {"FINISHED"}
        place = tuple(branches.in_branch(context.scene, cursor))
        if is_list:
            # One more of them.
            given = getattr(group, field.name)
            one = field.shown([[*place, *PLACES[field.name]]])
            setattr(group, field.name, f"{given}; {one}" if given.strip() else one)
            return {"FINISHED"}
        surface = branches.find_surface(context.scene)
        if stage.name == "plan" and self.field in _BALLS and surface is not None:
            goal_ball.put(context.scene, surface, self.field, place)
            return {"FINISHED"}
        setattr(group, self.field, place)
        if field.is_optional:
            setattr(group, properties.OPEN + self.field, True)
        return {"FINISHED"}


class LIMBER_OT_from_object(bpy.types.Operator):
    """Take this region of the plan from the active object: its bounding box, or the ball about its
    centre"""

    bl_idname = "limber.from_object"
    bl_label = "From Active Object"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    region: bpy.props.EnumProperty(name="Region", items=[
        (name, name.replace("_", " ").capitalize(), "") for name in REGIONS])

    @classmethod
    def poll(cls, context):
        thing = context.active_object
        if thing is None or (branches.branch_of(thing) is not None
                             and goal_ball.place_of(thing) is None):
            cls.poll_message_set("Add an object that marks the region, and select it")
            return False
        return True

    def execute(self, context):
        thing, plan = context.active_object, context.scene.limber.plan
        if (place := goal_ball.place_of(thing)) is not None and self.region in _BALLS:
            # Its size is only visual; the tolerance stays.
            setattr(plan, self.region, place)
            setattr(plan, properties.OPEN + self.region, True)
            return {"FINISHED"}
        corners = [branches.in_branch(context.scene, thing.matrix_world @ Vector(corner))
                   for corner in thing.bound_box]
        low, high = (tuple(bound(corner[axis] for corner in corners) for axis in range(3))
                     for bound in (min, max))
        if self.region == "target_box":
            goal_ball.choose(plan, "target_box")
            given = {"target_box": low + high}
        elif self.region == "workspace":
            given = {"workspace": low + high}
        else:
            given = {self.region: tuple((a + b) / 2 for a, b in zip(low, high, strict=True))}
            # An empty gives a point: the tolerance stays.
            plan.goal_tolerance = max(b - a for a, b in zip(low, high, strict=True)) / 2 or (
                plan.goal_tolerance)
        surface = branches.find_surface(context.scene)
        if self.region in _BALLS and surface is not None:
            goal_ball.put(context.scene, surface, self.region, given[self.region])
            return {"FINISHED"}
        for name, value in given.items():
            setattr(plan, name, value)
            setattr(plan, properties.OPEN + name, True)
        return {"FINISHED"}


class LIMBER_OT_crop_scan(bpy.types.Operator):
    """Keep only the part of the scan inside the active object's bounding box, or around the points
    that are selected in the scan itself"""

    bl_idname = "limber.crop_scan"
    bl_label = "Crop to Active Object"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if _scan_of(context) is None or context.active_object is None:
            cls.poll_message_set("Import a scan, add an object around the part to keep, and select "
                                 "that object; or select points of the scan in Edit Mode")
            return False
        return True

    def execute(self, context):
        thing, scan = context.active_object, _scan_of(context)
        places = _selected(scan) if thing == scan else [
            scan.matrix_world.inverted() @ thing.matrix_world @ Vector(corner)
            for corner in thing.bound_box]
        if len(places) < 2:
            self.report({"ERROR"}, "No points are selected. Select the points to keep in Edit "
                                   "Mode, or an object around them.")
            return {"CANCELLED"}
        settings = context.scene.limber.reconstruct
        places = _in_file(scan, places)
        settings.crop = [bound(place[axis] for place in places)
                         for bound in (min, max) for axis in range(3)]
        setattr(settings, properties.OPEN + "crop", True)
        self.report({"INFO"}, "The scan is cropped when it is reconstructed")
        return {"FINISHED"}


def _scan_of(context: bpy.types.Context) -> bpy.types.Object | None:
    """Return the active scan, else that of the current branch."""
    active = context.active_object
    if active is not None and branches.SCAN_KEY in active:
        return active
    path = context.scene.limber.reconstruct.cloud
    return next((thing for thing in context.scene.objects if branches.SCAN_KEY in thing
                 and path and thing.name.startswith(f"{Path(path).stem} scan")), None)


def _in_file(scan: bpy.types.Object, places: list[Vector]) -> list[list[float]]:
    """Return positions of a scan's object in the coordinates of its file."""
    # In double precision, since map coordinates are large.
    offset = scan.get(branches.OFFSET_KEY, (0.0,) * 3)
    return [[place[axis] + offset[axis] for axis in range(3)] for place in places]


def _selected(scan: bpy.types.Object) -> list[Vector]:
    if scan.mode == "EDIT":
        scan.update_from_editmode()
    return [vertex.co for vertex in scan.data.vertices if vertex.select]


CLASSES = (LIMBER_OT_crop_scan, LIMBER_OT_from_object, LIMBER_OT_from_cursor)
