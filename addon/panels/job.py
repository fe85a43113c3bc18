"""What the worker is doing, on top of the tab while it works or after it failed."""

import textwrap

import bpy

from .. import jobs
from .sidebar import SidebarPanel


class LIMBER_PT_job(SidebarPanel, bpy.types.Panel):
    bl_idname = "LIMBER_PT_job"
    bl_label = "Worker"
    bl_order = 0

    @classmethod
    def poll(cls, context):
        return jobs.is_running() or (jobs.current() is not None and bool(jobs.current().error))

    def draw(self, context):
        job = jobs.current()
        if job.state is jobs.JobState.RUNNING:
            self.layout.label(text=job.title)
            self.layout.progress(factor=job.fraction, text=f"{100 * job.fraction:.0f} %")
            self.layout.label(text=job.message)
            self.layout.operator("limber.cancel_job", icon="X")
            return
        column = self.layout.column(align=True)
        column.label(text=f"{job.title} failed", icon="ERROR")
        for line in textwrap.wrap(job.error, 40)[:12]:
            column.label(text=line)


def register() -> None:
    bpy.utils.register_class(LIMBER_PT_job)


def unregister() -> None:
    bpy.utils.unregister_class(LIMBER_PT_job)
