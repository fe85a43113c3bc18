"""Take a choice that an error offers: set its option, and run the stage again."""

import json
from typing import ClassVar

import bpy

from .. import properties
from ..branch.needs_result import branch_property
from . import plain_words
from .stages import stages


class LIMBER_OT_take_choice(bpy.types.Operator):
    """Set this and run the step again"""

    bl_idname = "limber.take_choice"
    bl_label = "Do This"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    stage: bpy.props.StringProperty(name="Stage")
    option: bpy.props.StringProperty(name="Setting")
    value: bpy.props.StringProperty(name="Value", description="As JSON")
    branch_uuid: branch_property()

    @classmethod
    def description(cls, context, given):
        stage = stages().get(given.stage)
        field = stage.fields.get(given.option) if stage else None
        return f"Set this and run the step again. {field.description if field else ''}"

    def invoke(self, context, event):
        return self._run(context, "INVOKE_DEFAULT")

    def execute(self, context):
        return self._run(context, "EXEC_DEFAULT")

    def _run(self, context, how: str):
        stage, value = stages()[self.stage], json.loads(self.value)
        field, group = stage.fields[self.option], properties.group_of(context.scene, stage)
        properties.put(group, field, value)
        self.report({"INFO"}, plain_words.choice_title(field, value))
        try:
            return getattr(bpy.ops.limber, properties.attribute_name(stage.name))(
                how, branch_uuid=self.branch_uuid) & {"FINISHED", "CANCELLED"} or {"FINISHED"}
        except RuntimeError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}


CLASSES = (LIMBER_OT_take_choice,)
