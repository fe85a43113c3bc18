"""The base of operators that run a command of the worker, as a job with progress or waiting.

While a job runs no operator does: Blender saves automatically, and undo and other add-ons work. A
timer looks at the jobs, and calls the operator again when its job has ended.
"""

from typing import Any, NamedTuple

import bpy

from .. import preferences
from ..panels.lines import wrapped
from . import jobs
from .plain_words import error_texts, warning_text
from .worker import WorkerNotFound

_INTERVAL_SECONDS, _SOON_SECONDS = 0.1, 0.01
_POPUP_SHARE = 0.6
"""Width of an error beside the mouse, of the window's."""


class _Beside(NamedTuple):
    """A job beside the interface, and what its operator needs when it is called again."""

    operator: str
    job: jobs.Job
    keywords: dict[str, Any]
    state: dict[str, Any]


_beside: list[_Beside] = []
_ended: list[dict[str, Any]] = []
"""State of the operator that is called again, for as long as it is called."""


class WorkerOperator:
    """Mix-in: ``arguments`` states what to run, ``finish`` what to do with the result.

    Called from a button it runs beside the interface, after running or waiting jobs. From a script
    or without a window the call waits for it. ``folder`` is its branch folder; ``is_next`` puts it
    before all waiting jobs. A subclass overrides ``can_start`` and ``begin`` in place of ``poll``
    and ``invoke``.
    """

    title = "Working"
    is_next = False
    _is_beside = False
    _timer = None
    _job: jobs.Job | None = None

    @classmethod
    def poll(cls, context):
        return bool(_ended) or cls.can_start(context)

    @classmethod
    def can_start(cls, context: bpy.types.Context) -> bool:
        """Return whether it can be pressed."""
        if jobs.is_running() and bpy.app.background:
            cls.poll_message_set("The worker is busy")
            return False
        return True

    def arguments(self, context: bpy.types.Context) -> list[str]:
        """Return the command and its arguments, without --json; ValueError if one is missing."""
        raise NotImplementedError

    def folder(self, context: bpy.types.Context) -> str:
        """Return the absolute branch folder of the operator, after ``arguments``; or an empty text.
        """
        return ""

    def finish(self, context: bpy.types.Context, result: dict) -> None:
        """Use the worker's result; ValueError states why it cannot be used."""
        raise NotImplementedError

    def execute(self, context):
        if not self._start(context):
            return {"CANCELLED"}
        self._job.wait()
        return self._end(context)

    def invoke(self, context, event):
        if not _ended:
            return self.begin(context, event)
        vars(self).update(_ended.pop())
        # Only a modal operator's reports are shown; it ends at once.
        manager = context.window_manager
        self._timer = manager.event_timer_add(_SOON_SECONDS, window=context.window)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def begin(self, context: bpy.types.Context, event: bpy.types.Event | None) -> set[str]:
        """Start the job beside the interface; without a window, wait for it."""
        if bpy.app.background or context.window is None:
            return self.execute(context)
        self._is_beside = True
        if not self._start(context):
            return {"CANCELLED"}
        given = {name: value for name, value in self.as_keywords().items()
                 if self.properties.is_property_set(name)}
        _beside.append(_Beside(self.bl_idname, self._job, given, dict(vars(self))))
        if not bpy.app.timers.is_registered(_look):
            bpy.app.timers.register(_look, first_interval=_INTERVAL_SECONDS)
        return {"FINISHED"}

    def modal(self, context, event):
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        context.window_manager.event_timer_remove(self._timer)
        return self._end(context)

    def ended(self, context: bpy.types.Context, outcome: dict) -> None:
        """Keep its outcome: ``status``, ``error``, ``warnings``, ``seconds``."""

    def _start(self, context) -> bool:
        try:
            stage, *rest = self.arguments(context)
            command = [*preferences.worker_command(), stage, "--json", "--progress", "json", *rest]
            folder = self.folder(context)
            self._job = jobs.add(self.title, command, folder, is_next=self.is_next) if (
                self._is_beside) else jobs.start(self.title, command, folder)
        except (ValueError, RuntimeError, OSError, WorkerNotFound) as error:
            self._complain(context, str(error))
            return False
        return True

    def _end(self, context):
        job = self._job
        if job.state is jobs.JobState.DONE and "status" not in job.result:
            job.state, job.error = jobs.JobState.FAILED, _no_result(job)
        self.ended(context, job.outcome)
        for warning in job.result.get("warnings", []):
            self.report({"WARNING"}, warning_text(job.result, warning))
        if job.state is jobs.JobState.CANCELLED:
            self.report({"INFO"}, f"{self.title}: {job.message or 'cancelled'}")
            return {"CANCELLED"}
        if job.state is jobs.JobState.FAILED:
            self._complain(context, " ".join(error_texts(job.outcome)))
            return {"CANCELLED"}
        try:
            self.finish(context, job.result)
        except ValueError as error:
            self._complain(context, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}

    def _complain(self, context, text: str) -> None:
        """Report an error; in a window in lines, since one would run past the screen."""
        if self._is_beside:
            text = "\n".join(wrapped(text, _POPUP_SHARE * context.window.width))
        self.report({"ERROR"}, text)


def _look() -> float | None:
    """Poll the jobs beside the interface; return the time to the next look [s], None: no more."""
    redraw_sidebars()
    for one in [one for one in _beside
                if one.job.poll() not in (jobs.JobState.WAITING, jobs.JobState.RUNNING)]:
        _beside.remove(one)
        operator = getattr(bpy.ops.limber, one.operator.replace("LIMBER_OT_", "limber.")[7:])
        _ended.append(one.state)
        # The window that it was called from may be closed.
        with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
            operator("INVOKE_DEFAULT", **one.keywords)
    return _INTERVAL_SECONDS if _beside else None


def leave_file(*_args: Any) -> None:
    """Another file is loaded: no worker continues unseen, and the next file shows no failure."""
    for one in _beside:
        one.job.cancel()
        one.job.stop_now()
        one.job.poll()
    _beside.clear()
    jobs.dismiss()


def _no_result(job: jobs.Job) -> str:
    said = " ".join(line for line in list(job.log)[-2:] if line.strip())[:200]
    return ("The worker ended without a result, so nothing is shown. Check that the Python in the "
            "extension's preferences has Limber in this version. The worker's output was: "
            f"{said or 'nothing'}")


def redraw_sidebars(*_: Any) -> None:
    """Redraw the panels, but not the view: a million points take their time."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "PREFERENCES":
                area.tag_redraw()
            elif area.type == "VIEW_3D":
                next(region for region in area.regions if region.type == "UI").tag_redraw()


HANDLERS = (("load_pre", leave_file),)


def unregister() -> None:
    if bpy.app.timers.is_registered(_look):
        bpy.app.timers.unregister(_look)
    _beside.clear()
    jobs.forget()
