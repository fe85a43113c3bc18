"""Stop the worker, or dismiss its failure."""

import bpy

from . import jobs


class LIMBER_OT_cancel_job(bpy.types.Operator):
    """Stop the worker. Earlier results are kept"""

    bl_idname = "limber.cancel_job"
    bl_label = "Cancel"

    waiting: bpy.props.IntProperty(
        name="Waiting", default=-1, min=-1, options={"SKIP_SAVE"},
        description="Number of the waiting job to cancel, from 0; -1 cancels the running job")

    @classmethod
    def poll(cls, context):
        return jobs.current() is not None or bool(jobs.waiting())

    def execute(self, context):
        queue, last = jobs.waiting(), jobs.current()
        if self.waiting < 0 and last is not None and last.error:
            jobs.dismiss()
            return {"FINISHED"}
        if self.waiting >= len(queue) or (self.waiting < 0 and not jobs.is_running()):
            self.report({"WARNING"}, "The job has already ended or started.")
            return {"CANCELLED"}
        (jobs.current() if self.waiting < 0 else queue[self.waiting]).cancel()
        return {"FINISHED"}


CLASSES = (LIMBER_OT_cancel_job,)
