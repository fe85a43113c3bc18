"""The motion along the path, with its energy."""

import bpy

from ..branch import branches
from ..bridge import animation
from ..jobs.worker_operator import redraw_sidebars
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


CLASSES = (LIMBER_PT_play,)
# Frame and energy stay current while it plays: Blender redraws the view alone.
HANDLERS = (("frame_change_post", redraw_sidebars),)
