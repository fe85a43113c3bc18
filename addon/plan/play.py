"""Play the motion of the branch along its path."""

from typing import ClassVar

import bpy

from ..branch import branches
from ..branch.needs_result import NeedsBranch
from ..bridge import animation
from ..show import scene


class LIMBER_OT_play(NeedsBranch, bpy.types.Operator):
    """Play or stop the branch's motion"""

    bl_idname = "limber.play"
    bl_label = "Play"

    def execute(self, context):
        trouble = animation.cache_trouble(branches.find_surface(context.scene))
        if trouble:
            self.report({"ERROR"}, trouble)
            return {"CANCELLED"}
        scene.fit_range(context.scene, branches.find_surface(context.scene))
        if not context.screen or not context.screen.is_animation_playing:
            context.scene.frame_set(context.scene.frame_start)
        if not bpy.app.background:
            bpy.ops.screen.animation_play()
        return {"FINISHED"}


class LIMBER_OT_retime(NeedsBranch, bpy.types.Operator):
    """Set at which frame of the scene the motion starts, and how fast it plays"""

    bl_idname = "limber.retime"
    bl_label = "Start and Speed"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    frame_start: bpy.props.IntProperty(name="First Frame", default=1, soft_min=1,
                                       description="Frame of the scene in which the motion starts")
    speed: bpy.props.FloatProperty(
        name="Speed", default=1.0, min=0.001, soft_max=10.0,
        description="1 plays in real time (a path: one pose per frame), 0.1 in slow motion")

    def invoke(self, context, event):
        return context.window_manager.invoke_props_dialog(self)

    def execute(self, context):
        surface, current = branches.find_surface(context.scene), context.scene
        trouble = animation.cache_trouble(surface)
        if trouble:
            self.report({"ERROR"}, trouble)
            return {"CANCELLED"}
        frames = branches.info_of(surface)["frames"]
        own = scene.own_speed(current, frames)
        branch = branches.branch_of(surface)
        animation.retime(branches.parts_of(branch).values(), surface, self.frame_start,
                         own * self.speed)
        scene.fit_range(current, surface)
        current.frame_end = max(current.frame_end, scene.last_frame(
            self.frame_start, frames["count"], own * self.speed))
        current.frame_set(current.frame_current)
        return {"FINISHED"}


CLASSES = (LIMBER_OT_retime, LIMBER_OT_play)
