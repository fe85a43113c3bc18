"""First actions, while the scene has neither a branch nor a scan."""

import bpy

from ..branch import branches
from . import guide
from .lines import draw_text
from .sidebar import SidebarPanel


class LIMBER_PT_start(SidebarPanel, bpy.types.Panel):
    bl_idname = "LIMBER_PT_start"
    bl_label = "Start Here"
    bl_order = 0

    @classmethod
    def poll(cls, context):
        return not branches.current_path(context.scene) and not any(
            branches.SCAN_KEY in thing for thing in context.scene.objects) and (
            branches.find_surface(context.scene) is None)

    def draw_header_preset(self, context):
        guide.draw(self.layout, "start")

    def draw(self, context):
        column = self.layout.column()
        column.scale_y = 1.3
        column.operator("limber.open_example", icon="PLAY")
        column.operator("limber.import_cloud", text="Import a Scan", icon="IMPORT").filepath = ""
        column.operator("limber.open_result", text="Open a Branch Folder", icon="FILE_FOLDER")
        draw_text(self.layout, context, "A scan may also be dropped into the view")
        if "Limber" not in bpy.data.workspaces:
            self.layout.operator("limber.workspace", icon="WORKSPACE")


CLASSES = (LIMBER_PT_start,)
