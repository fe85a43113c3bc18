"""Stop the worker."""

import bpy

from .. import jobs


class LIMBER_OT_cancel_job(bpy.types.Operator):
    """Stop the worker; what was there before stays as it was"""

    bl_idname = "limber.cancel_job"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context):
        return jobs.is_running()

    def execute(self, context):
        jobs.current().cancel()
        return {"FINISHED"}


def register() -> None:
    bpy.utils.register_class(LIMBER_OT_cancel_job)


def unregister() -> None:
    jobs.forget()
    bpy.utils.unregister_class(LIMBER_OT_cancel_job)
