"""The branch: its folder, its contents, and the meaning of its colours."""

import bpy

from .. import compat, preferences
from ..bend import live_loads
from ..branch import branches
from ..bridge.materials import WOOD
from ..plan import energy_field
from ..show import graph as viewport_graph
from ..show import seeing
from . import guide
from .comparing import draw_branches
from .lines import draw_text
from .sidebar import SidebarPanel
from .steps import draw_next

_NO_GRAPH = {"young": "Estimate first", "energy": "Plan a path first",
             "force": "Estimate from a pull with forces first"}


class LIMBER_PT_result(SidebarPanel, bpy.types.Panel):
    bl_idname = "LIMBER_PT_result"
    bl_label = "Branch"
    bl_order = 2

    def draw_header_preset(self, context):
        guide.draw(self.layout, "result")

    def draw(self, context):
        settings = context.scene.limber
        surface = branches.find_surface(context.scene)
        if branches.current_path(context.scene):
            self.layout.prop(settings, "branch", text="", icon="OUTLINER")
        self.layout.prop(settings, "branch_folder", text="Folder")
        if surface is None and branches.branches(context.scene):
            draw_text(self.layout, context, "Not shown: press Open Result", "INFO")
        draw_branches(self.layout, context)
        draw_next(self.layout, context.scene)
        if surface is not None:
            self.layout.prop(settings.scene, "plan", **compat.placeholder("the newest"))
            self.layout.prop(settings.scene, "motion", **compat.placeholder("of the plan"))
        self.layout.operator("limber.open_result", icon="FILE_FOLDER")
        self.layout.prop(settings, "show_expert")
        if not preferences.has_worker():
            column = self.layout.column(align=True)
            draw_text(column, context, "No worker was found.", "ERROR")
            draw_text(column, context, "Choose the Python that has limber:")
            column.operator("preferences.addon_show", text="Preferences",
                            icon="PREFERENCES").module = preferences.KEY
        if surface is not None:
            self.layout.operator("limber.grab", icon="VIEW_PAN")
            _draw_live(self.layout, context, settings)
            _draw_colours(self.layout, context, surface, settings)
            _draw_in_sight(self.layout, context, surface, settings)


def _draw_live(layout: bpy.types.UILayout, context: bpy.types.Context, settings) -> None:
    """Draw the loads on the branch while it is held, and their effect."""
    header, body = layout.panel("limber_live_loads", default_closed=True)
    header.label(text="Live Loads")
    if body is None:
        return
    column = body.column(align=True)
    for line in live_loads.lines or ["Grab the branch to see these loads act"]:
        draw_text(column, context, line)
    body.prop(settings, "live_weight")
    body.prop(settings.load, "use_wind")
    if settings.load.use_wind:
        body.prop(settings.load, "wind")
    body.prop(settings.load, "snow", slider=True)
    body.prop(settings, "fruit_mass", slider=True)
    body.prop(settings.load, "fruit")
    body.prop(settings.load, "cut")


def _draw_colours(layout: bpy.types.UILayout, context: bpy.types.Context,
                  surface: bpy.types.Object, settings) -> None:
    """Draw the quantity that colours the branch, with the range of the colours."""
    info = branches.info_of(surface)
    header, body = layout.panel("limber_colours")
    header.label(text="Colours")
    if body is None:
        return
    for note in info["notes"]:
        draw_text(body, context, note)
    if info.get("frame_scalars"):
        body.prop(settings, "each_frame")
    name = _shown_scalar(surface)
    title, _, rest = _title(info, settings, name).partition(" (")
    body.menu(LIMBER_MT_colours.bl_idname, text=_upper(title) or "Choose", icon="COLOR")
    if name in info["scalars"]:
        draw_text(body, context, _span(info["scalars"][name], rest), "BLANK1")
    if "stress_over_strength" in info["scalars"]:
        row = body.row(heading="Strength [Pa]")
        row.prop(settings.scene, "use_strength", text="")
        value = row.row()
        value.active = settings.scene.use_strength
        value.prop(settings.scene, "strength", text="")


class LIMBER_MT_colours(bpy.types.Menu):
    """Quantities by which the branch can be coloured."""

    bl_idname = "LIMBER_MT_colours"
    bl_label = "Colour By"

    def draw(self, context):
        surface, settings = branches.find_surface(context.scene), context.scene.limber
        info = branches.info_of(surface)
        for name in (*info["scalars"], WOOD):
            title = _title(info, settings, name).partition(" (")[0]
            entry = self.layout.operator(
                "limber.color_by", text=_upper(title),
                icon="CHECKMARK" if name == _shown_scalar(surface) else "BLANK1")
            entry.scalar, entry.each_frame = name, settings.each_frame


def _shown_scalar(surface: bpy.types.Object) -> str:
    """Return the quantity by which the branch is coloured; empty if by none."""
    if shown := surface.get(branches.FRAME_SCALAR_KEY):
        return shown
    active = surface.data.color_attributes.active_color
    name = "" if active is None else active.name.removesuffix("_color")
    return name if name in (*branches.info_of(surface)["scalars"], WOOD) else ""


def _title(info: dict, settings, name: str) -> str:
    """Return the title of what the branch is coloured by, with its remark; empty if by nothing."""
    return _scale(info, settings, name)["title"] if name in info["scalars"] else name


def _upper(title: str) -> str:
    return title[:1].upper() + title[1:]


def _scale(info: dict, settings, name: str) -> dict:
    """Return the scale of a quantity as it would be shown: in each frame, or the worst of all."""
    moving = info.get("frame_scalars") or {}
    return moving[name] if settings.each_frame and name in moving else info["scalars"][name]


def _span(scale: dict, rest: str) -> str:
    """Return the range of the colours, with the text in brackets in the title."""
    ticks = scale["ticks"]
    span = f"{ticks[1]} everywhere" if scale.get("is_one") else f"{ticks[0]} to {ticks[-1]}"
    return f"{span} ({rest}" if rest else span


def _draw_in_sight(layout: bpy.types.UILayout, context: bpy.types.Context,
                   surface: bpy.types.Object, settings) -> None:
    """Draw the parts of the branch that can be shown and hidden, and the choice of graph."""
    header, body = layout.panel("limber_in_sight", default_closed=True)
    header.label(text="Show")
    if body is None:
        return
    row = body.row()
    row.prop(settings, "show_legend")
    row.prop(settings, "show_scan")
    branch = branches.branch_of(surface)
    if energy_field.of(branch) is not None:
        body.prop(settings, "show_energy_slice")
    for group, (title, _) in seeing.GROUPS.items():
        things = seeing.things_of(branch, group)
        if things:
            is_hidden = things[0].hide_viewport
            button = body.operator("limber.show", text=title, depress=not is_hidden,
                                   icon="HIDE_ON" if is_hidden else "HIDE_OFF")
            button.group, button.hide = group, not is_hidden
    body.prop(settings, "graph", text="")
    if settings.graph != viewport_graph.NONE and (
            settings.graph not in viewport_graph.graphs_of(surface)):
        draw_text(body, context, _NO_GRAPH[settings.graph], "INFO")


CLASSES = (LIMBER_MT_colours, LIMBER_PT_result)
