"""After an installation the worker compiles its code once, in the background: for the first grab.

It neither waits for jobs nor delays them. Its completion is recorded for the version of the worker,
in the extension's own folder.
"""

import hashlib
from pathlib import Path

import bpy

from .. import preferences
from . import jobs
from .worker import WorkerNotFound
from .worker_operator import redraw_sidebars

_FIRST_SECONDS, _LOOK_SECONDS = 2.0, 0.5
_WARM = ("doctor", "--warm", "--json", "--progress", "json")
_running: list[jobs.Job] = []


def current() -> jobs.Job | None:
    """Return the job that compiles now; None if no job does."""
    return _running[0] if _running else None


def begin() -> bool:
    """Start compiling if this worker has not compiled yet; returns whether it was started."""
    try:
        command = preferences.worker_command()
    except WorkerNotFound:
        return False
    if _done_file(command).is_file():
        return False
    job = jobs.Job("Compiling once", [*command, *_WARM])
    try:
        job.launch()
    except OSError:
        # The first job reports why the worker does not start.
        return False
    _running[:] = [job]
    return True


def look() -> float | None:
    """Check its progress; returns the time to the next check [s], or None when it has ended."""
    job = current()
    if job is None:
        return None
    state = job.poll()
    redraw_sidebars(bpy.context)
    if state is jobs.JobState.RUNNING:
        return _LOOK_SECONDS
    _running.clear()
    if state is jobs.JobState.DONE:
        path = _done_file(job.command[:-len(_WARM)])
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return None


def _done_file(command: list[str]) -> Path:
    """Return the file that marks that this worker has compiled since the add-on was installed."""
    installed = Path(__file__).stat().st_mtime_ns
    name = hashlib.sha256(f"{command}{installed}".encode()).hexdigest()[:16]
    try:
        folder = Path(bpy.utils.extension_path_user(preferences.KEY, path="compiled"))
    except ValueError:
        # Not installed as an extension: a script, or a checkout.
        folder = Path(bpy.app.tempdir)
    return folder / name


def draw(layout: bpy.types.UILayout) -> None:
    """Show its progress while it compiles; in a header, so that nothing moves under the mouse."""
    job = current()
    if job is not None:
        layout.label(text=f"Compiling {100 * job.fraction:.0f} %", icon="SORTTIME")


def _begin_and_look() -> float | None:
    return look() if current() is not None or begin() else None


def register() -> None:
    if not bpy.app.background:
        bpy.app.timers.register(_begin_and_look, first_interval=_FIRST_SECONDS, persistent=True)


def unregister() -> None:
    if bpy.app.timers.is_registered(_begin_and_look):
        bpy.app.timers.unregister(_begin_and_look)
    while _running:
        _running.pop().stop_now()
