"""The pie menu: what is done most, around the mouse."""

import bpy

from ..branch import branches
from .steps import draw_next


class LIMBER_MT_pie(bpy.types.Menu):
    """What is done most with a branch; the next step is below."""

    bl_idname = "LIMBER_MT_pie"
    bl_label = "Limber"

    def draw(self, context):
        # Blender's order: left, right, below, above, and the corners.
        pie = self.layout.menu_pie()
        pie.operator("limber.grab", icon="VIEW_PAN")
        pie.operator("limber.place_goal", icon="SPHERE")
        if not draw_next(pie, context.scene):
            pie.operator("limber.open_result", icon="FILE_FOLDER")
        pie.operator("limber.play", icon="PLAY")
        if branches.find_surface(context.scene) is None:
            pie.operator("limber.open_example", icon="PLAY")
            pie.operator("limber.import_cloud", text="Import a Scan", icon="IMPORT").filepath = ""
            return
        pie.menu("LIMBER_MT_colours", text="Colour By", icon="COLOR")
        pie.operator("limber.set_up_picture", icon="IMAGE_DATA")


CLASSES = (LIMBER_MT_pie,)
SHORTCUT = ({"name": "3D View", "space_type": "VIEW_3D"}, "wm.call_menu_pie", "L",
            {"name": LIMBER_MT_pie.bl_idname})
