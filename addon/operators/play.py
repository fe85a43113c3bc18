"""Play the motion of the branch along its path."""

from typing import ClassVar

import bpy

from .. import scene
from ..bridge import animation
from .needs_result import NeedsBranch


class LIMBER_OT_play(NeedsBranch, bpy.types.Operator):
    """Play or stop the branch's motion along the path"""

    bl_idname = "limber.play"
    bl_label = "Play"

    def execute(self, context):
        trouble = animation.cache_trouble(scene.find_surface(context.scene))
        if trouble:
            self.report({"ERROR"}, trouble)
            return {"CANCELLED"}
        if not context.screen or not context.screen.is_animation_playing:
            context.scene.frame_set(context.scene.frame_start)
        if not bpy.app.background:
            bpy.ops.screen.animation_play()
        return {"FINISHED"}


class LIMBER_OT_color_by(bpy.types.Operator):
    """Colour the branch by this quantity"""

    bl_idname = "limber.color_by"
    bl_label = "Colour By"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    scalar: bpy.props.StringProperty()

    @classmethod
    def poll(cls, context):
        return scene.find_surface(context.scene) is not None

    def execute(self, context):
        try:
            scene.color_by(scene.find_surface(context.scene), self.scalar)
        except KeyError:
            self.report({"ERROR"}, f"The branch has no {self.scalar!r}. Open the result again.")
            return {"CANCELLED"}
        return {"FINISHED"}


def register() -> None:
    bpy.utils.register_class(LIMBER_OT_play)
    bpy.utils.register_class(LIMBER_OT_color_by)


def unregister() -> None:
    bpy.utils.unregister_class(LIMBER_OT_color_by)
    bpy.utils.unregister_class(LIMBER_OT_play)
