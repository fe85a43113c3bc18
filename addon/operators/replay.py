"""Move the branch as in a recording, and show the measured points over it."""

from pathlib import Path
from typing import ClassVar

import bpy

from .. import branch_folder
from .needs_result import branch_property, needed_folder
from .worker_operator import WorkerOperator


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


CLASSES = (LIMBER_OT_replay_pull,)
