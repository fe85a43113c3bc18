"""Move the branch as in a recording, and show the measured points over it; its part of a panel."""

from pathlib import Path
from typing import ClassVar

import bpy

from ..branch import branch_folder, branches
from ..branch.needs_result import branch_property, needed_folder
from ..jobs.worker_operator import WorkerOperator
from ..panels.lines import draw_text


class LIMBER_OT_replay_pull(WorkerOperator, bpy.types.Operator):
    """Move the current model of the branch as this recording moved the real branch, and show the
    measured points over it in each frame"""

    bl_idname = "limber.replay_pull"
    bl_label = "Replay a Pull"
    bl_options: ClassVar = {"REGISTER"}
    title = "Replaying the pull"

    pull: bpy.props.StringProperty(name="Pull", description="Name of the recording")
    branch_uuid: branch_property()
    _folder: Path | None = None

    def arguments(self, context):
        folder = needed_folder(context.scene, self.branch_uuid)
        if self.pull not in pulls_of(branch_folder.read_record(folder)):
            raise ValueError(f"The branch has no pull {self.pull!r}. Import one first.")
        self._folder = folder
        return ["simulate", "--pull", self.pull, "--", str(folder)]

    def folder(self, context):
        return str(self._folder)

    def finish(self, context, result):
        context.scene.limber.scene.motion = self.pull
        bpy.ops.limber.open_result(
            "EXEC_DEFAULT" if bpy.app.background else "INVOKE_DEFAULT",
            directory=str(self._folder))


def pulls_of(record: branch_folder.BranchRecord | None) -> list[str]:
    """Return the names of a branch's recordings, sorted."""
    return record.names("pulls/{name}/pull.toml") if record else []


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


CLASSES = (LIMBER_OT_replay_pull,)
