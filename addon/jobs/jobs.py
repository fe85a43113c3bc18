"""Runs the worker as a process: queues it, reads its progress, cancels it. No bpy here.

Whoever owns the job calls :meth:`Job.poll` from Blender's main thread.
"""

import atexit
import enum
import subprocess
import time
from collections import deque
from typing import Any

from .worker_process import WorkerProcess

_GRACE_SECONDS = 8.0
_SILENT_SECONDS = 20.0
"""A worker reports every two seconds; after this long without a report, something is wrong.
Starting takes a few seconds."""
_IDLE_SECONDS = 30.0
_LEAST_CPU_SECONDS = 0.05
"""Least CPU time that counts as work within a beat; a sign of life itself takes some thousandths.
"""
_KNOWN_SHARE, _KNOWN_SECONDS = 0.03, 3.0
"""Least progress and time before the remaining time can be predicted."""


def _what_to_do(code: int) -> str:
    """Return possible causes of a worker's end without a reason of its own, and what to do."""
    if code < 0:
        return ("It was killed, by a person or because memory ran out. Earlier results are "
                "unchanged. Run it again.")
    return ("If its version differs from that of this add-on, choose another Python in the "
            "extension's preferences. Check the Worker shows the version.")


class JobState(enum.Enum):
    """State of a job."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


class Life(enum.Enum):
    """Whether a running worker works."""

    WORKING = ""
    IDLE = "The worker responds, but has computed nothing for {:.0f} s. It may be waiting or hung"
    SILENT = "The worker has not responded for {:.0f} s. It may be hung"


class Job:
    """One command of the worker in its own process, once it is its turn.

    Attributes:
        title: Title that the user reads.
        folder: The branch folder in which it works or that it makes, if any.
        fraction: Fraction done, 0 to 1.
        message: The current work of the worker.
        numbers: Further progress values, by name.
        result: Its last JSON object, once it has ended.
        error: Reason of its failure, for the user; empty otherwise.
        log: The last lines of its standard error.
    """

    def __init__(self, title: str, command: list[str], folder: str = ""):
        self.title = title
        self.command = command
        self.folder = folder
        self.state = JobState.WAITING
        self.fraction = 0.0
        self.message = "waiting for its turn"
        self.numbers: dict[str, Any] = {}
        self.result: dict[str, Any] = {}
        self.error = ""
        self.log: deque[str] = deque(maxlen=40)
        self._cancelled_at: float | None = None
        self._started_at = self._heard_at = self._worked_at = 0.0
        self._cpu_seconds = 0.0
        self._process: WorkerProcess | None = None

    def launch(self) -> None:
        """Start the process; OSError if the program cannot be started."""
        self._process = WorkerProcess(self.command, LIMBER_PARENT_PIPE="stdin")
        self.state, self.message = JobState.RUNNING, "starting"
        self._started_at = self._heard_at = self._worked_at = time.monotonic()

    @property
    def outcome(self) -> dict[str, Any]:
        """Its result with ``status`` and ``error``, also of a worker that ended without one."""
        return {**self.result, "status": self.state.value, "error": self.error}

    @property
    def pid(self) -> int:
        return self._process.pid

    def poll(self) -> JobState:
        """Read the worker's output since the last call; return the state."""
        if self.state is JobState.WAITING:
            _advance()
        if self.state is not JobState.RUNNING:
            return self.state
        code = self._process.poll()
        self._take_lines()
        if code is not None:
            self._process.stdin.close()
            self._finish(code)
        elif self._cancelled_at and time.monotonic() - self._cancelled_at > _GRACE_SECONDS:
            self._process.end_now()
        return self.state

    def wait(self) -> JobState:
        """Poll until the job has ended: for scripts and Blender without a window."""
        while self.poll() in (JobState.WAITING, JobState.RUNNING):
            time.sleep(0.05)
        return self.state

    def life(self) -> tuple[Life, float]:
        """Return whether the worker works, and the time since its last work [s]."""
        now = time.monotonic()
        if now - self._heard_at > _SILENT_SECONDS:
            return Life.SILENT, now - self._heard_at
        if now - self._worked_at > _IDLE_SECONDS:
            return Life.IDLE, now - self._worked_at
        return Life.WORKING, 0.0

    def elapsed(self) -> float:
        """Return its running time [s]."""
        return time.monotonic() - self._started_at

    def remaining(self) -> float | None:
        """Return the remaining time at this rate [s]; None while it is unknown.
        """
        elapsed = self.elapsed()
        if self.fraction < _KNOWN_SHARE or elapsed < _KNOWN_SECONDS:
            return None
        return elapsed * (1.0 - self.fraction) / self.fraction

    def cancel(self) -> None:
        """Ask the worker to stop; it keeps the previous results. It is killed if it does not stop.
        """
        if self.state is JobState.WAITING:
            self._give_up("")
        elif self.state is JobState.RUNNING and self._cancelled_at is None:
            self._cancelled_at = time.monotonic()
            self.message = "stopping"
            self._process.ask_to_end()

    def stop_now(self) -> None:
        """End the worker immediately because Blender is closing."""
        if self.state is JobState.WAITING:
            self._give_up("")
        elif self._process is not None and self._process.poll() is None:
            self._process.ask_to_end()
            try:
                self._process.wait(1.0)
            except subprocess.TimeoutExpired:
                self._process.end_now()
                self._process.wait(5.0)

    def _give_up(self, why: str) -> None:
        """It will not run."""
        self.state, self.message = JobState.CANCELLED, why
        if self in _waiting:
            _waiting.remove(self)

    def _take_lines(self) -> None:
        for content in self._process.told():
            self._heard_at = time.monotonic()
            if isinstance(content, str):
                self.log.append(content)
            elif _is_fraction(content.get("progress")):
                self._worked_at = self._heard_at
                self.fraction = float(content.pop("progress"))
                self.message = str(content.pop("message", ""))
                self.numbers = content
            elif "alive" in content:
                self._take_beat(content.get("cpu_s"))
            elif "status" in content:
                self.result = content

    def _take_beat(self, cpu_seconds: Any) -> None:
        if not isinstance(cpu_seconds, int | float):
            return
        if abs(cpu_seconds - self._cpu_seconds) > _LEAST_CPU_SECONDS:
            self._worked_at = self._heard_at
        self._cpu_seconds = float(cpu_seconds)

    def _finish(self, code: int) -> None:
        if code == 0:
            self.state, self.fraction = JobState.DONE, 1.0
        elif self._cancelled_at is not None or code == 130:
            self.state = JobState.CANCELLED
        else:
            self.state = JobState.FAILED
            said = [line for line in self.log if line.strip()][-2:]
            self.error = self.result.get("error") or " ".join(
                [f"The worker ended with exit code {code}.", *said, _what_to_do(code)])
        if self.state is not JobState.DONE and self.folder:
            # Jobs that were to continue from there have no input.
            for job in [job for job in _waiting if job.folder == self.folder]:
                job._give_up(f"not run because {self.title} failed before it")


def _is_fraction(value: Any) -> bool:
    return isinstance(value, int | float) and 0.0 <= value <= 1.0


_last: list[Job] = []
_waiting: list[Job] = []


def current() -> Job | None:
    """Return the job that runs, or the last one; one runs at a time."""
    return _last[0] if _last else None


def waiting() -> list[Job]:
    """Return the jobs that wait for their turn, in order."""
    return list(_waiting)


def is_running() -> bool:
    return bool(_last) and _last[0].state is JobState.RUNNING


def works_in(folder: str) -> bool:
    """Whether a running or waiting job belongs to a branch folder."""
    jobs = _waiting + [job for job in _last if job.state is JobState.RUNNING]
    return bool(folder) and any(job.folder == folder for job in jobs)


def start(title: str, command: list[str], folder: str = "") -> Job:
    """Start ``command`` as the current job.

    Raises:
        RuntimeError: another job is running.
        OSError: the program cannot be started.
    """
    if is_running():
        raise RuntimeError(f"{_last[0].title} is still running. Wait for it or cancel it.")
    job = Job(title, command, folder)
    job.launch()
    _last[:] = [job]
    return job


def add(title: str, command: list[str], folder: str = "", *, is_next: bool = False) -> Job:
    """Start ``command``, or queue it: it starts in its turn and is polled.

    Args:
        is_next: Put it before all waiting jobs.

    Raises:
        OSError: the program cannot be started.
    """
    if not is_running() and (is_next or not _waiting):
        return start(title, command, folder)
    job = Job(title, command, folder)
    _waiting.insert(0 if is_next else len(_waiting), job)
    return job


def _advance() -> None:
    """Start the first of the waiting jobs if none is running."""
    if is_running() or not _waiting:
        return
    job = _waiting.pop(0)
    _last[:] = [job]
    try:
        job.launch()
    except OSError as error:
        job.state, job.error = JobState.FAILED, str(error)


def dismiss() -> None:
    """Forget the last job if it has ended."""
    if not is_running():
        _last.clear()


def forget() -> None:
    """End the current job, if any, and forget it: the add-on is removed or Blender closes."""
    for job in (*_waiting, *_last):
        job.stop_now()
    _waiting.clear()
    _last.clear()


atexit.register(forget)
