"""The part of the robot's panel that arms it, and shows its force while it moves."""

from pathlib import Path

import bpy

from .. import branches, jobs, live_force
from ..lines import draw_text
from ..operators.arming import LIMBER_OT_arm, why_not_armed
from ..operators.worker_operator import redraw_sidebars
from ..stages import stages

_LOOK_SECONDS = 0.2
_LOOK_AGAIN_SECONDS = 1.0
_seen: dict[str, bool] = {}


def draw_robot(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the live force if a robot moves, else the button that lets it."""
    is_ours = _moving() is not None
    folder = _folder(context)
    live = live_force.read(folder) if folder is not None else None
    if live is not None:
        _draw_force(layout, context, live)
    if is_ours:
        row = layout.row()
        row.scale_y = 2.0
        row.alert = True
        row.operator("limber.cancel_job", text="Stop Robot", icon="CANCEL")
        draw_text(layout, context, "Not an emergency stop: use the robot's own", "INFO")
        return
    trouble = why_not_armed(context)
    column = layout.column()
    button = column.operator("limber.arm", icon="ARMATURE_DATA")
    button.branch_uuid = branches.current_uuid(context.scene)
    if trouble:
        words, _, rest = trouble.partition(": ")
        draw_text(column, context, words, "LOCKED")
        draw_text(column, context, rest, "BLANK1")


def _draw_force(layout: bpy.types.UILayout, context: bpy.types.Context,
                live: live_force.LiveForce) -> None:
    column = layout.column(align=True)
    draw_text(column, context, f"{live.title}: {live.step}" if live.step else live.title,
              "FORCE_FORCE")
    words = "no reading" if live.force is None else f"{live.force:.2f} N"
    bar = column.row()
    bar.alert = live.share > 1.0
    bar.progress(factor=min(live.share, 1.0), text=f"{words} of {live.limit:.3g} N")
    expected = "" if live.expected is None else f", expected {live.expected:.2f} N"
    draw_text(column, context, f"Peak {live.peak:.2f} N{expected}")


def _moving() -> jobs.Job | None:
    """Return the job in which a robot moves now."""
    job = jobs.current()
    return job if job is not None and job.state is jobs.JobState.RUNNING and (
        job.title in _titles_in_motion()) else None


def _titles_in_motion() -> tuple[str, ...]:
    """Return the titles of the jobs in which a robot moves."""
    return (LIMBER_OT_arm.title,
            *(stage.label for stage in stages().values() if stage.moves_robot == "always"))


def _folder(context: bpy.types.Context) -> Path | None:
    """Return the folder of the branch that the robot moves, whichever is the current one."""
    job = _moving()
    return branches.current_folder(context.scene) if job is None else Path(job.folder)


def _look() -> float:
    """Redraw the sidebars while a robot moves; returns the time to the next check [s]."""
    folder = _folder(bpy.context)
    is_there = folder is not None and (folder / live_force.FILE).is_file()
    if is_there or _seen.get("there"):
        redraw_sidebars(bpy.context)
    _seen["there"] = is_there
    return _LOOK_SECONDS if is_there else _LOOK_AGAIN_SECONDS


def register() -> None:
    if not bpy.app.background:
        bpy.app.timers.register(_look, first_interval=_LOOK_AGAIN_SECONDS, persistent=True)


def unregister() -> None:
    if bpy.app.timers.is_registered(_look):
        bpy.app.timers.unregister(_look)
    _seen.clear()
