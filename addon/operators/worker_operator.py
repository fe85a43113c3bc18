"""The base of operators that run a command of the worker, as a job with progress or waiting."""

import bpy

from .. import jobs, preferences
from ..lines import wrapped
from ..plain_words import error_texts, warning_text
from ..worker import WorkerNotFound

_INTERVAL_SECONDS = 0.1
_POPUP_SHARE = 0.6
"""Width of an error beside the mouse, of the window's."""


class WorkerOperator:
    """Mix-in: ``arguments`` states what to run, ``finish`` what to do with the result.

    Called from a button it runs beside the interface, after running or waiting jobs. From a script
    or without a window the call waits for it. ``folder`` is its branch folder; ``is_next`` puts it
    before all waiting jobs.
    """

    title = "Working"
    is_next = False
    _is_beside = False
    _timer = None
    _job: jobs.Job | None = None

    @classmethod
    def poll(cls, context):
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
        if bpy.app.background or context.window is None:
            return self.execute(context)
        self._is_beside = True
        if not self._start(context):
            return {"CANCELLED"}
        manager = context.window_manager
        self._timer = manager.event_timer_add(_INTERVAL_SECONDS, window=context.window)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        redraw_sidebars(context)
        if self._job.poll() in (jobs.JobState.WAITING, jobs.JobState.RUNNING):
            return {"PASS_THROUGH"}
        self._remove_timer(context)
        return self._end(context)

    def cancel(self, context):
        """Blender closes or loads another file: the worker must not continue unseen."""
        self._remove_timer(context)
        if self._job is not None:
            # Not a failure: the panel of the next file must not show one.
            self._job.cancel()
            self._job.stop_now()
            self._job.poll()

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

    def _remove_timer(self, context) -> None:
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            self._timer = None


def _no_result(job: jobs.Job) -> str:
    said = " ".join(line for line in list(job.log)[-2:] if line.strip())[:200]
    return ("The worker ended without a result, so nothing is shown. Check that the Python in the "
            "extension's preferences has Limber in this version. The worker's output was: "
            f"{said or 'nothing'}")


def redraw_sidebars(context: bpy.types.Context) -> None:
    """Redraw the panels, but not the view: a million points take their time."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "PREFERENCES":
                area.tag_redraw()
            elif area.type == "VIEW_3D":
                next(region for region in area.regions if region.type == "UI").tag_redraw()
