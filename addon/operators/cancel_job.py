"""Stop the worker."""

import bpy

from .. import jobs


class LIMBER_OT_cancel_job(bpy.types.Operator):
    """Stop the worker. Earlier results are kept"""

    bl_idname = "limber.cancel_job"
    bl_label = "Cancel"

    waiting: bpy.props.IntProperty(
        name="Waiting", default=-1, min=-1, options={"SKIP_SAVE"},
        description="Number of the waiting job to cancel, from 0; -1 cancels the running job")

    @classmethod
    def poll(cls, context):
        return jobs.is_running() or bool(jobs.waiting())

    def execute(self, context):
        queue = jobs.waiting()
        if self.waiting >= len(queue) or (self.waiting < 0 and not jobs.is_running()):
            self.report({"WARNING"}, "The job has already ended or started.")
            return {"CANCELLED"}
        (jobs.current() if self.waiting < 0 else queue[self.waiting]).cancel()
        return {"FINISHED"}


def register() -> None:
    bpy.utils.register_class(LIMBER_OT_cancel_job)


def unregister() -> None:
    jobs.forget()
    bpy.utils.unregister_class(LIMBER_OT_cancel_job)
