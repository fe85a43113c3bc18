"""Step 4: the motion along the path, with its energy."""

import bpy

from .. import scene
from ..bridge import animation
from .sidebar import SidebarPanel


class LIMBER_PT_play(SidebarPanel, bpy.types.Panel):
    bl_idname = "LIMBER_PT_play"
    bl_label = "4  Play"
    bl_order = 4

    @classmethod
    def poll(cls, context):
        surface = scene.find_surface(context.scene)
        return surface is not None and animation.MODIFIER in surface.modifiers

    def draw(self, context):
        playing = bool(context.screen) and context.screen.is_animation_playing
        self.layout.operator("limber.play", text="Stop" if playing else "Play",
                             icon="PAUSE" if playing else "PLAY")
        self.layout.prop(context.scene, "frame_current", text="Frame")
        energies = scene.find_surface(context.scene).get(scene.ENERGY_KEY)
        if energies is not None:
            last = len(energies) - 1
            number = min(max(context.scene.frame_current - context.scene.frame_start, 0), last)
            self.layout.label(text=f"Energy {1000 * energies[number]:.3g} mJ")


def register() -> None:
    bpy.utils.register_class(LIMBER_PT_play)


def unregister() -> None:
    bpy.utils.unregister_class(LIMBER_PT_play)
