"""The branch: its folder, what it holds, and what its colours mean."""

import json

import bpy

from .. import preferences, scene
from ..operators import live_loads
from .sidebar import SidebarPanel


class LIMBER_PT_result(SidebarPanel, bpy.types.Panel):
    bl_idname = "LIMBER_PT_result"
    bl_label = "Branch"
    bl_order = 1

    def draw(self, context):
        settings = context.scene.limber
        self.layout.prop(settings, "branch_folder")
        self.layout.prop(settings.scene, "plan")
        self.layout.prop(settings.scene, "motion")
        self.layout.operator("limber.open_result", icon="FILE_FOLDER")
        self.layout.prop(settings, "show_expert")
        if not preferences.has_worker():
            column = self.layout.column(align=True)
            column.label(text="No worker was found.", icon="ERROR")
            column.label(text="Name the Python that has limber:")
            column.operator("preferences.addon_show", text="Preferences",
                            icon="PREFERENCES").module = preferences.KEY
        surface = scene.find_surface(context.scene)
        if surface is not None:
            self.layout.operator("limber.grab", icon="VIEW_PAN")
            _draw_live(self.layout, settings)
            row = self.layout.row()
            row.prop(settings, "show_legend")
            row.prop(settings, "show_scan")
            _draw_legend(self.layout, json.loads(surface[scene.INFO_KEY]))


def _draw_live(layout: bpy.types.UILayout, settings) -> None:
    """Draw what acts on the branch while it is held, and what it does."""
    header, body = layout.panel("limber_live_loads", default_closed=True)
    header.label(text="Live Loads")
    if body is None:
        return
    column = body.column(align=True)
    for line in live_loads.lines or ["Grab the branch: these act at once"]:
        column.label(text=line)
    body.prop(settings, "live_weight")
    body.prop(settings.load, "use_wind")
    if settings.load.use_wind:
        body.prop(settings.load, "wind")
    body.prop(settings.load, "snow", slider=True)
    body.prop(settings, "fruit_mass", slider=True)
    body.prop(settings.load, "fruit")
    body.prop(settings.load, "cut")


def _draw_legend(layout: bpy.types.UILayout, info: dict) -> None:
    column = layout.column(align=True)
    for note in info["notes"]:
        column.label(text=note)
    for name, scale in info["scalars"].items():
        row = layout.row(align=True)
        row.operator("limber.color_by", text=scale["title"], icon="COLOR").scalar = name
        layout.label(text=f"{scale['ticks'][0]} to {scale['ticks'][-1]}")


def register() -> None:
    bpy.utils.register_class(LIMBER_PT_result)


def unregister() -> None:
    bpy.utils.unregister_class(LIMBER_PT_result)
