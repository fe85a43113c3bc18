"""The worker's activity, at the top of the tab while it works or after it failed."""

import bpy

from ..jobs import jobs
from ..jobs.plain_words import error_texts
from . import guide
from .lines import draw_text
from .sidebar import SidebarPanel

_LOG_LINES = 12
_LONGEST_LINE = 400
_MODULI = 32
_OPEN = 100.0
"""Factor of uncertainty above which a modulus counts as unknown."""


class LIMBER_PT_job(SidebarPanel, bpy.types.Panel):
    bl_idname = "LIMBER_PT_job"
    bl_label = "Worker"
    bl_order = 1

    @classmethod
    def poll(cls, context):
        job = jobs.current()
        return jobs.is_running() or bool(jobs.waiting()) or (job is not None and bool(job.error))

    def draw_header_preset(self, context):
        guide.draw(self.layout, "job")

    def draw(self, context):
        job = jobs.current()
        if job is not None and job.state is jobs.JobState.RUNNING:
            _draw_running(self.layout, context, job)
        elif job is not None and job.error:
            row = self.layout.row()
            row.label(text=f"{job.title} failed", icon="ERROR")
            row.operator("limber.cancel_job", text="", icon="X")
            draw_text(self.layout, context, " ".join(error_texts(job.outcome)))
        if job is not None:
            _draw_log(self.layout, context, job)
        for number, waiting in enumerate(jobs.waiting()):
            row = self.layout.row()
            row.label(text=f"Then: {waiting.title}", icon="TIME")
            row.operator("limber.cancel_job", text="", icon="X").waiting = number


def _draw_running(layout: bpy.types.UILayout, context: bpy.types.Context, job: jobs.Job) -> None:
    draw_text(layout, context, job.title)
    layout.progress(factor=job.fraction, text=f"{100 * job.fraction:.0f} %")
    column = layout.column(align=True)
    for line in (job.message, time_words(job), *number_lines(job.numbers)):
        draw_text(column, context, line)
    life, seconds = job.life()
    if life is not jobs.Life.WORKING:
        draw_text(column, context, life.value.format(seconds), "ERROR")
    layout.operator("limber.cancel_job", icon="X")


def _draw_log(layout: bpy.types.UILayout, context: bpy.types.Context, job: jobs.Job) -> None:
    said = [line for line in job.log if line.strip()][-_LOG_LINES:]
    if not said:
        return
    header, body = layout.panel("limber_job_log", default_closed=True)
    header.label(text="Log")
    if body is not None:
        column = body.column(align=True)
        for line in said:
            draw_text(column, context, line[:_LONGEST_LINE])


def time_words(job: jobs.Job) -> str:
    """Return the running time of a job, and its remaining time if that is known."""
    words = f"{_span(job.elapsed())} so far"
    remaining = job.remaining()
    return words if remaining is None else f"{words}, about {_span(remaining)} left"


def _span(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def number_lines(numbers: dict) -> list[str]:
    """Return further progress values of a worker as text: the loss and E of a fit."""
    lines = []
    if isinstance(numbers.get("best_m2"), int | float):
        lines.append(f"Lowest loss {numbers['best_m2']:.3g} m²")
    young, factor = numbers.get("young_mpa"), numbers.get("young_factor")
    if isinstance(young, str):
        values = young.split()
        if isinstance(factor, str) and len(factor.split()) == len(values):
            values = [_with_interval(*pair) for pair in zip(values, factor.split(), strict=True)]
        more = f" and {len(values) - _MODULI} more" if len(values) > _MODULI else ""
        lines.append(f"E {', '.join(values[:_MODULI])} MPa{more}")
    return lines


def _with_interval(value: str, factor: str) -> str:
    """Return a modulus with its interval, if the worker's words are numbers."""
    try:
        middle, times = float(value), float(factor)
    except ValueError:
        return value
    return f"{value} ({middle / times:.3g} to {middle * times:.3g})" if times < _OPEN else (
        f"{value} (not yet known)")


CLASSES = (LIMBER_PT_job,)
