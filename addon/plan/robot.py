"""Let a robot move, once a person has typed the name of the motion; show its force."""

from pathlib import Path
from typing import ClassVar

import bpy

from .. import properties
from ..branch import branch_folder, branches
from ..branch.needs_result import branch_property
from ..jobs import jobs
from ..jobs.run_stage import StageOperator, stage_operator
from ..jobs.stages import stages
from ..jobs.worker_operator import redraw_sidebars
from ..panels.lines import draw_text
from . import live_force

_WIDTH = 420
_WARNING = ("The robot will move. Clear its workspace, and keep a hand",
            "at the emergency stop. The button Stop Robot does not replace it.")
_LOOK_SECONDS = 0.2
_LOOK_AGAIN_SECONDS = 1.0
_seen: dict[str, bool] = {}


class MovesRobot(StageOperator):
    """Mix-in: a stage that moves a robot; the worker compares the typed text with ``name``."""

    confirm: bpy.props.StringProperty(
        name="Name to Confirm", options={"SKIP_SAVE"},
        description="The person beside the robot types the name to confirm the motion")

    def begin(self, context, event):
        if bpy.app.background or context.window is None:
            return self.execute(context)
        self._is_asked = True
        self.branch_uuid = self.branch_uuid or branches.current_uuid(context.scene)
        return context.window_manager.invoke_props_dialog(self, width=_WIDTH,
                                                          confirm_text="Move the Robot")

    def draw(self, context):
        column = self.layout.column(align=True)
        for number, line in enumerate(_WARNING):
            column.label(text=line, icon="BLANK1" if number else "ERROR")
        name = self.name_of(context)
        self.layout.label(text=f"To continue, type: {name}")
        row = self.layout.row()
        row.alert = bool(self.confirm) and self.confirm != name
        row.prop(self, "confirm")

    def arguments(self, context):
        if jobs.is_running() or jobs.waiting():
            # It would move when its turn comes, perhaps with nobody there any more.
            raise ValueError("The worker is busy. The robot must move immediately or not at all. "
                             "Try again when no job is running or waiting.")
        if self.branch_uuid not in ("", branches.current_uuid(context.scene)):
            raise ValueError("Another branch has become the current one. Choose the branch that "
                             "the robot holds, and confirm again.")
        if trouble := self.trouble(context):
            raise ValueError(trouble)
        if not self.confirm:
            raise ValueError("Nobody confirmed that the robot may move. Type "
                             f"{self.name_of(context)}.")
        given = super().arguments(context)
        return [given[0], *self.orders(), *given[1:]]

    def orders(self) -> list[str]:
        """Return the options that let the robot move."""
        return ["--confirm", self.confirm, "--after-stop", "hold"]

    def name_of(self, context) -> str:
        """Return the text that has to be typed."""
        return properties.group_of(context.scene, self.stage).name

    def trouble(self, context) -> str:
        """Return why the robot may not move yet, or an empty text."""
        return ""


class LIMBER_OT_arm(MovesRobot, bpy.types.Operator):
    """Follow the plan with the robot of the dry run: approach, grasp, follow the path and return.
    The plan's name must be typed to confirm"""

    bl_idname = "limber.arm"
    bl_label = "Move the Robot"
    bl_options: ClassVar = {"REGISTER"}
    stage_name = "execute"
    title = "Robot motion along the plan"

    replace: bpy.props.BoolProperty(options={"HIDDEN", "SKIP_SAVE"})
    branch_uuid: branch_property()

    @classmethod
    def can_start(cls, context):
        if trouble := why_not_armed(context):
            cls.poll_message_set(trouble)
        return not trouble

    def orders(self):
        return ["--arm", *super().orders()]

    def trouble(self, context):
        return why_not_armed(context)

    def _take_keywords(self, context) -> None:
        """It has no properties of the stage: the panel's settings are those of the dry run."""


def why_not_armed(context: bpy.types.Context) -> str:
    """Return why the plan may not be followed yet, for lack of a current check; or an empty text.
    """
    stage, folder = stages()["execute"], branches.current_folder(context.scene)
    if folder is None:
        return "Open a branch first"
    group = properties.group_of(context.scene, stage)
    outcome = properties.outcome_of(context.scene, stage, str(folder))
    if outcome.get("status") != "done":
        return "Run the dry run with the robot first: it does not move the robot"
    try:
        given = properties.arguments_of(context.scene, stage, str(folder))
    except ValueError as error:
        return str(error)
    if outcome.get("arguments") != given:
        return "The settings have changed since the dry run: repeat it with the robot"
    record = branch_folder.read_record(folder)
    preview = record.stages.get(f"execute-preview:{group.name}") if record else None
    plan = f"plans/{group.name}.csv"
    if preview is None or plan not in record.files or (
            preview.reads.get(plan) != record.files[plan][0]):
        return "The plan has changed since the dry run: repeat it with the robot"
    return ""


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
        redraw_sidebars()
    _seen["there"] = is_there
    return _LOOK_SECONDS if is_there else _LOOK_AGAIN_SECONDS


CLASSES = (LIMBER_OT_arm, *(stage_operator(stage.name, MovesRobot)
                            for stage in stages().values() if stage.moves_robot == "always"))


def register() -> None:
    if not bpy.app.background:
        bpy.app.timers.register(_look, first_interval=_LOOK_AGAIN_SECONDS, persistent=True)


def unregister() -> None:
    if bpy.app.timers.is_registered(_look):
        bpy.app.timers.unregister(_look)
    _seen.clear()
