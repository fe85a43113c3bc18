"""Step 2: from the scan to tetrahedra."""

import bpy

from .. import preferences
from ..worker import WorkerNotFound
from .sidebar import SidebarPanel


class LIMBER_PT_reconstruct(SidebarPanel, bpy.types.Panel):
    bl_idname = "LIMBER_PT_reconstruct"
    bl_label = "2  Reconstruct"
    bl_order = 2

    def draw(self, context):
        self.layout.prop(context.scene.limber, "branch_folder")
        self.layout.operator("limber.reconstruct", icon="MESH_DATA")
        try:
            preferences.worker_command()
        except WorkerNotFound:
            column = self.layout.column(align=True)
            column.label(text="No worker was found.", icon="ERROR")
            column.label(text="Name the Python that has limber")
            column.label(text="in the add-on's preferences.")


def register() -> None:
    bpy.utils.register_class(LIMBER_PT_reconstruct)


def unregister() -> None:
    bpy.utils.unregister_class(LIMBER_PT_reconstruct)
