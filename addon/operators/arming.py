"""Let a robot move, once a person has typed the name of the motion."""

from typing import ClassVar

import bpy

from .. import branch_folder, branches, jobs, properties
from ..stages import stages
from .needs_result import branch_property
from .run_stage import StageOperator, stage_operator

_WIDTH = 420
_WARNING = ("The robot will move. Clear its workspace, and keep a hand",
            "at the emergency stop. The button Stop Robot does not replace it.")


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


_registered: list[type] = []


def register() -> None:
    for operator in (LIMBER_OT_arm, *(stage_operator(stage.name, MovesRobot)
                                      for stage in stages().values()
                                      if stage.moves_robot == "always")):
        bpy.utils.register_class(operator)
        _registered.append(operator)


def unregister() -> None:
    while _registered:
        bpy.utils.unregister_class(_registered.pop())
