"""The motion along the path, with its energy."""

import bpy
from bpy.app.handlers import persistent

from ..branch import branches
from ..bridge import animation
from ..panels import guide
from ..panels.sidebar import SidebarPanel


class LIMBER_PT_play(SidebarPanel, bpy.types.Panel):
    bl_idname = "LIMBER_PT_play"
    bl_label = "Play"
    bl_order = 20

    @classmethod
    def poll(cls, context):
        surface = branches.find_surface(context.scene)
        return surface is not None and animation.motion_of(surface) is not None

    def draw_header_preset(self, context):
        guide.draw(self.layout, "play")

    def draw(self, context):
        playing = bool(context.screen) and context.screen.is_animation_playing
        self.layout.operator("limber.play", text="Stop" if playing else "Play",
                             icon="PAUSE" if playing else "PLAY")
        self.layout.prop(context.scene, "frame_current", text="Frame")
        surface = branches.find_surface(context.scene)
        energies = surface.get(branches.ENERGY_KEY)
        if energies is not None:
            last = len(energies) - 1
            shown = round(animation.cache_frame(surface, context.scene.frame_current))
            number = min(max(shown, 0), last)
            self.layout.label(text=f"Energy {1000 * energies[number]:.3g} mJ")
        self.layout.operator("limber.retime", icon="PREVIEW_RANGE")
        row = self.layout.row(align=True)
        row.operator("limber.export_motion", icon="EXPORT")
        row.operator("limber.turntable", icon="CAMERA_DATA")
        self.layout.operator("limber.set_up_picture", icon="IMAGE_DATA")
        if context.scene.camera is not None:
            row = self.layout.row(align=True)
            row.operator("render.render", text="Render", icon="RENDER_STILL")
            motion = row.operator("render.render", text="Render Motion", icon="RENDER_ANIMATION")
            motion.animation = True


@persistent
def _redraw_sidebars(*_) -> None:
    """Keep frame and energy current while playing: Blender redraws the view alone."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                next(region for region in area.regions if region.type == "UI").tag_redraw()


def register() -> None:
    bpy.utils.register_class(LIMBER_PT_play)
    bpy.app.handlers.frame_change_post.append(_redraw_sidebars)


def unregister() -> None:
    bpy.app.handlers.frame_change_post.remove(_redraw_sidebars)
    bpy.utils.unregister_class(LIMBER_PT_play)
