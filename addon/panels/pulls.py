"""The part of the pulls' panel that plays recordings over the branch."""

import bpy

from .. import branch_folder, branches
from ..lines import draw_text
from ..operators.replay import pulls_of


def draw_pulls(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the recordings of the branch; of the visible one, its time and measured values."""
    folder = branches.current_folder(context.scene)
    names = pulls_of(None if folder is None else branch_folder.read_record(folder))
    if not names:
        return
    surface = branches.find_surface(context.scene)
    info = branches.info_of(surface) if surface is not None else {}
    shown = info.get("observation") or {}
    layout.label(text="Replay over the branch:")
    for name in names:
        is_shown = shown.get("is_shown", False) and shown["pull"] == name
        button = layout.operator("limber.replay_pull", text=name, depress=is_shown, icon="PLAY")
        button.pull, button.branch_uuid = name, branches.current_uuid(context.scene)
        if is_shown:
            _draw_timeline(layout, context, info)


def _draw_timeline(layout: bpy.types.UILayout, context: bpy.types.Context, info: dict) -> None:
    """Draw the visible frame's position in the recording."""
    frames, scene = info["frames"], context.scene
    count = sum(thing.get(branches.SHOWS_KEY) == "observed" for thing in scene.objects)
    column = layout.column(align=True)
    draw_text(column, context, (f"{(frames['count'] - 1) / frames['rate_hz']:.3g} s, {count} "
                                "points observed") if count else "No points were observed", "TIME")
    row = column.row(align=True)
    playing = bool(context.screen) and context.screen.is_animation_playing
    row.operator("limber.play", text="", icon="PAUSE" if playing else "PLAY")
    row.prop(scene, "frame_current", text="Frame")
    if "force" in (info.get("graphs") or {}):
        column.operator("limber.graph", text="Force over Time", icon="GRAPH",
                        depress=scene.limber.graph == "force").graph = "force"
    if "residual" in (info.get("frame_scalars") or {}):
        button = column.operator("limber.color_by", text="Colour by Distance", icon="COLOR")
        button.scalar, button.each_frame = "residual", True
