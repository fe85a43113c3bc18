"""Open a branch folder: its surface coloured and moving, paths, goal and marks."""

import json
import tempfile
from pathlib import Path

import bpy

from .. import properties
from ..jobs.stages import stages
from ..jobs.worker_operator import WorkerOperator
from ..plan import goal_ball
from ..scan.viewing import clear_view, look_at, push_undo
from ..show import frame_colours, scene, scene_data
from . import branch_folder, branches
from .needs_result import folder_to_open


class LIMBER_OT_open_result(WorkerOperator, bpy.types.Operator):
    """Show what the branch folder holds"""

    bl_idname = "limber.open_result"
    bl_label = "Open Result"
    title = "Opening"
    is_next = True

    directory: bpy.props.StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE"})
    _temporary = None
    _is_asked = False

    def begin(self, context, event):
        if not (self.directory or branches.current_path(context.scene) or bpy.app.background):
            self._is_asked = True
            context.window_manager.fileselect_add(self)
            return {"RUNNING_MODAL"}
        return super().begin(context, event)

    def execute(self, context):
        if self._is_asked:
            # The folder has been chosen: from here on as from the button.
            self._is_asked = False
            return super().begin(context, None)
        return super().execute(context)

    def arguments(self, context):
        if self.directory:
            folder = Path(bpy.path.abspath(self.directory))
            if not (folder / branch_folder.MANIFEST).is_file():
                raise ValueError(f"{folder} is not a branch folder because it has no file "
                                 f"{branch_folder.MANIFEST}. Choose another folder.")
        else:
            folder = folder_to_open(context.scene)
        self._temporary = tempfile.TemporaryDirectory(prefix="limber-open-")
        stage = stages()["scene"]
        values = properties.values_of(properties.group_of(context.scene, stage), stage,
                                      {"plan", "motion", "strength"})
        return stage.arguments({**values, "branch_folder": str(folder),
                                "data": str(self._data_path)})

    def finish(self, context, result):
        with self._temporary:
            if not self._data_path.is_file():
                raise ValueError("The worker succeeded but wrote nothing to show. Its output was: "
                                 f"{json.dumps(result)} {' '.join(self._job.log)}")
            data = scene_data.read_scene_data(self._data_path)
        before = branches.current_folder(context.scene)
        if trouble := frame_colours.keep(data):
            self.report({"WARNING"}, trouble)
        shown = scene.show_branch(context.scene, data)
        if before is None or before.resolve() != data.folder.resolve():
            branches.use_folder(context.scene, shown.collection[branches.FOLDER_KEY])
        if scene.place_scans(context.scene, data):
            # It would hide the branch; a switch in the panel shows it again.
            context.scene.limber.show_scan = False
        if data.info.get("plan"):
            # Its numbers are those for the panel.
            context.scene.limber.plan.name = data.info["plan"]
            # The visible plan is the one that a robot would follow.
            context.scene.limber.execute.name = data.info["plan"]
        self._take_over_settings(context, data.folder)
        goal_ball.tell_again(context.scene)
        told = [*data.info["notes"], *shown.notes]
        if shown.is_first:
            told += filter(None, [clear_view(context.scene)])
            look_at(context, shown.surface)
        push_undo(context)
        self.report({"INFO"}, f"{data.info['name']}: {'; '.join(told)}")

    def _take_over_settings(self, context, folder: Path) -> None:
        """Set the panels to the settings that made the branch: running again then changes nothing.
        """
        record = branch_folder.read_record(folder)
        for stage in stages().values() if record else ():
            group = properties.group_of(context.scene, stage)
            entry = record.of(stage, properties.values_of(group, stage, {"name"}))
            if entry is not None:
                properties.take_over(group, stage, entry.settings)

    @property
    def _data_path(self) -> Path:
        return Path(self._temporary.name) / "scene.npz"


CLASSES = (LIMBER_OT_open_result,)
