"""Take a place from the 3D cursor."""

from typing import ClassVar

import bpy

from .. import properties
from ..stages import stages
from ..steps import PLACES


class LIMBER_OT_from_cursor(bpy.types.Operator):
    """Set this place to where the 3D cursor is; a list of places gets one more"""

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
            self.report({"ERROR"}, f"{self.stage} has no place {self.field!r}.")
            return {"CANCELLED"}
        group = properties.group_of(context.scene, stage)
        place = tuple(context.scene.cursor.location)
        if is_list:
            # One more of them.
            given = getattr(group, field.name)
            one = field.shown([[*place, *PLACES[field.name]]])
            setattr(group, field.name, f"{given}; {one}" if given.strip() else one)
            return {"FINISHED"}
        setattr(group, self.field, place)
        if field.is_optional:
            setattr(group, properties.OPEN + self.field, True)
        return {"FINISHED"}


def register() -> None:
    bpy.utils.register_class(LIMBER_OT_from_cursor)


def unregister() -> None:
    bpy.utils.unregister_class(LIMBER_OT_from_cursor)
