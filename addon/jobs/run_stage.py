"""Run a stage of the worker with the scene's settings: one operator per stage."""

from pathlib import Path

import bpy

from .. import properties
from ..branch import branch_folder, branches
from ..branch.needs_result import branch_property, check_identity, needed_folder
from ..scan import deleted_points
from . import trouble_mark
from .stages import SettingError, Stage, stages
from .steps import FIRST
from .worker_operator import WorkerOperator


class StageOperator(WorkerOperator):
    """Mix-in: runs ``stage``; keyword arguments of the operator change the scene's settings."""

    stage_name = ""
    _folder: Path | None = None
    _given: list[str] | None = None
    _name = ""
    _is_asked = False

    @property
    def stage(self) -> Stage:
        return stages()[self.stage_name]

    @property
    def title(self) -> str:
        return self.stage.label

    def begin(self, context, event):
        try:
            self._take_keywords(context)
            trouble = "" if self.replace else self._foreign(context)
        except (ValueError, OSError):
            # Starting it reports the same, with the position.
            trouble = ""
        if not trouble or bpy.app.background or context.window is None:
            return super().begin(context, event)
        self._is_asked = self.replace = True
        self.branch_uuid = self.branch_uuid or branches.current_uuid(context.scene)
        return context.window_manager.invoke_confirm(
            self, event, title="Replace the branch?", message=trouble, confirm_text="Replace",
            icon="QUESTION")

    def execute(self, context):
        if self._is_asked:
            # The user has answered: from here on as from the button.
            self._is_asked = False
            return super().begin(context, None)
        return super().execute(context)

    def arguments(self, context):
        self._take_keywords(context)
        stage, scene = self.stage, context.scene
        if stage.makes_branch:
            if "without" in stage.fields:
                self._leave_out(context)
            values = properties.values_of(properties.group_of(context.scene, stage), stage)
            trouble = self._foreign(context)
            if trouble and not self.replace:
                raise ValueError(f"{trouble} Choose another branch folder, or run it with "
                                 "replace=True.")
            if branches.current_folder(scene) is None:
                branches.use_folder(scene, str(branch_folder.folder_for(self._source(context))))
            self._folder = branches.current_folder(scene)
            if not self.replace:
                check_identity(scene, self._folder, self.branch_uuid)
            return stage.arguments({**values, "output": str(self._folder)})
        self._folder = needed_folder(scene, self.branch_uuid)
        self._given = properties.arguments_of(context.scene, stage, str(self._folder))
        self._name = getattr(properties.group_of(context.scene, stage), "name", "")
        return self._given

    def _start(self, context):
        first = FIRST.get(self.stage_name, "")
        if not first:
            return super()._start(context)
        try:
            # Errors in the settings are reported before anything runs.
            self.arguments(context)
            if self._lacks(context, stages()[first]):
                how = "INVOKE_DEFAULT" if self._is_beside else "EXEC_DEFAULT"
                getattr(bpy.ops.limber, properties.attribute_name(first))(
                    how, branch_uuid=self.branch_uuid)
        except (ValueError, OSError, RuntimeError) as error:
            self.report({"ERROR"}, str(error))
            return False
        return super()._start(context)

    def _lacks(self, context, stage: Stage) -> bool:
        """Whether the branch has no result of a stage, or one of another input."""
        record = branch_folder.read_record(self._folder)
        entry = record and record.of(stage, properties.values_of(
            properties.group_of(context.scene, stage), stage, {"name"}))
        return record is not None and (entry is None or record.is_stale(stage, entry))

    def folder(self, context):
        return str(self._folder)

    def finish(self, context, result):
        self.report({"INFO"}, f"{self.title}: done in {result.get('seconds', 0.0):.0f} s")
        if self.stage_name == "predict":
            position = result.get("grasp_position_m") or result.get("position_m")
            if position:
                self.report({"INFO"}, f"The grasp comes to rest at {position} m")
        if self.stage_name == "suggest-pull" and (best := result.get("best")):
            self.report({"INFO"}, f"Hold it at {best['grasp_point_m']} m and pull to "
                                  f"{best['end_m']} m")
        if bpy.app.background or not _is_seen(self.stage):
            return
        self._show_what_was_made(context)
        # The folder that this job filled, whichever one the scene names by now.
        bpy.ops.limber.open_result("INVOKE_DEFAULT", directory=str(self._folder))

    def _show_what_was_made(self, context) -> None:
        """Show the plan or the motion that this stage has just made."""
        shown = context.scene.limber.scene
        made = next((name.removeprefix("frames/").removesuffix(".pc2")
                     for name in self.stage.writes if name.endswith(".pc2")), "")
        if not made or not self._name:
            return
        if any(name.startswith("plans/") for name in self.stage.writes):
            shown.plan, shown.motion = self._name, ""
        else:
            shown.motion = made.format(name=self._name)

    def ended(self, context, outcome):
        properties.keep_outcome(context.scene, self.stage, str(self._folder),
                                {**outcome, "arguments": self._given})
        if outcome.get("place"):
            trouble_mark.show(context.scene, self.stage, outcome["place"])
        else:
            trouble_mark.remove(context.scene, self.stage)

    def _take_keywords(self, context) -> None:
        group = properties.group_of(context.scene, self.stage)
        for name in _own_properties(self.stage):
            if not self.properties.is_property_set(name):
                continue
            if name == ("output" if self.stage.makes_branch else "branch_folder"):
                branches.use_folder(context.scene, getattr(self, name))
                continue
            setattr(group, name, getattr(self, name))
            if hasattr(group, properties.OPEN + name):
                setattr(group, properties.OPEN + name, True)

    def _leave_out(self, context) -> None:
        """Give the points that the user deleted from the scan, as they are now."""
        group = properties.group_of(context.scene, self.stage)
        deleted = deleted_points.write(context.scene, self._source(context))
        if deleted is not None:
            group.without = str(deleted)
        elif deleted_points.is_ours(group.without):
            group.without = ""

    def _source(self, context) -> Path:
        """Return the scan or surface from which a new branch is made."""
        field = next(field for field in self.stage.fields.values() if field.is_argument)
        given = getattr(properties.group_of(context.scene, self.stage), field.name)
        path = Path(bpy.path.abspath(given)) if given else None
        if path is None or not path.is_file():
            raise SettingError(f"Choose a {'scan' if field.name == 'cloud' else field.name} "
                               f"first. {field.description}")
        return path

    def _foreign(self, context) -> str:
        """Return why the folder does not belong to this scan, or an empty text."""
        if not self.stage.makes_branch:
            return ""
        source = self._source(context)
        folder = branches.current_folder(context.scene)
        if folder is None or branch_folder.belongs(folder, branch_folder.file_sha256(source)):
            return ""
        return f"{folder.name} was not made from {source.name}. Its results would be overwritten."


def _is_seen(stage: Stage) -> bool:
    """Whether the stage's result is shown in the scene."""
    return any(name in ("mesh.vtu", "targets.json", "energy.npz")
               or name.startswith(("plans/", "frames/", "executions/")) for name in stage.writes)


def stage_operator(name: str, base: type = StageOperator) -> type:
    """Return the operator of a stage; ``base`` is the mix-in that runs it."""
    stage = stages()[name]
    return type(f"LIMBER_OT_{properties.attribute_name(name)}", (base, bpy.types.Operator), {
        "__annotations__": _own_properties(stage) | {"branch_uuid": branch_property(),
            "replace": bpy.props.BoolProperty(
            name="Replace", options={"HIDDEN", "SKIP_SAVE"},
            description="Replace the branch even if the folder belongs to another scan")},
        "__doc__": stage.summary.rstrip("."), "__module__": __name__, "stage_name": name,
        "bl_idname": f"limber.{properties.attribute_name(name)}", "bl_label": stage.label})


def _own_properties(stage: Stage) -> dict:
    """Return the properties of a stage's operator by name: those that panels keep."""
    hidden = {name for field in stage.fields.values() if not field.is_kept
              for name in (field.name, properties.OPEN + field.name)}
    # Not saved: the button does not repeat what a script gave once.
    return {name: value for name, value in
            properties.stage_properties(stage, {"SKIP_SAVE"}).items() if name not in hidden}


CLASSES = tuple(stage_operator(stage.name) for stage in stages().values()
                if stage.step and stage.moves_robot != "always")
