"""Step 1: the scan."""

import bpy

from .sidebar import SidebarPanel


class LIMBER_PT_import_cloud(SidebarPanel, bpy.types.Panel):
    bl_idname = "LIMBER_PT_import_cloud"
    bl_label = "1  Import"
    bl_order = 1

    def draw(self, context):
        settings = context.scene.limber
        self.layout.prop(settings, "cloud_path")
        self.layout.prop(settings, "cloud_unit")
        self.layout.operator("limber.import_cloud", icon="IMPORT")


def register() -> None:
    bpy.utils.register_class(LIMBER_PT_import_cloud)


def unregister() -> None:
    bpy.utils.unregister_class(LIMBER_PT_import_cloud)
