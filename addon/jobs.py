"""Runs the worker as a process: starts it, reads its progress, cancels it. No bpy here.

Threads only read the process's output into a queue; whoever owns the job calls :meth:`Job.poll`
from Blender's main thread.
"""

import atexit
import enum
import json
import os
import queue
import signal
import subprocess
import threading
import time
from collections import deque
from typing import Any

from .worker import worker_environment

_GRACE_SECONDS = 8.0
_POSIX = os.name == "posix"


class JobState(enum.Enum):
    """Where a job is."""

    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


class Job:
    """One command of the worker in a process of its own.

    Attributes:
        title: What the user reads.
        fraction: Share done, 0 to 1.
        message: What the worker is at.
        result: Its last JSON object, once it has ended.
        error: Why it failed, for the user; empty otherwise.
        log: The last lines of its standard error.
    """

    def __init__(self, title: str, command: list[str]):
        self.title = title
        self.command = command
        self.state = JobState.RUNNING
        self.fraction = 0.0
        self.message = "starting"
        self.result: dict[str, Any] = {}
        self.error = ""
        self.log: deque[str] = deque(maxlen=40)
        self._lines: queue.SimpleQueue[tuple[str, str]] = queue.SimpleQueue()
        self._cancelled_at: float | None = None
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, encoding="utf-8", errors="replace",
            # Its input closes when Blender ends, however that comes; then it ends too.
            env=worker_environment() | {"LIMBER_PARENT_PIPE": "stdin"},
            start_new_session=_POSIX)
        self._readers = [
            threading.Thread(target=self._read, args=(name, stream), daemon=True)
            for name, stream in (("out", self._process.stdout), ("err", self._process.stderr))]
        for reader in self._readers:
            reader.start()

    @property
    def pid(self) -> int:
        return self._process.pid

    def poll(self) -> JobState:
        """Take in what the worker has said since the last call; returns the state."""
        if self.state is not JobState.RUNNING:
            return self.state
        code = self._process.poll()
        if code is not None:
            for reader in self._readers:
                # A grandchild may keep the pipe open; what matters was said by then.
                reader.join(timeout=2.0)
        self._take_lines()
        if code is not None:
            self._process.stdin.close()
            self._finish(code)
        elif self._cancelled_at and time.monotonic() - self._cancelled_at > _GRACE_SECONDS:
            self._signal(kill=True)
        return self.state

    def wait(self) -> JobState:
        """Poll until the job has ended: for scripts and Blender without a window."""
        while self.poll() is JobState.RUNNING:
            time.sleep(0.05)
        return self.state

    def cancel(self) -> None:
        """Ask the worker to stop; it keeps what was there before. Killed if it does not."""
        if self.state is JobState.RUNNING and self._cancelled_at is None:
            self._cancelled_at = time.monotonic()
            self.message = "stopping"
            self._signal(kill=False)

    def stop_now(self) -> None:
        """End the worker at once: Blender is closing."""
        if self._process.poll() is None:
            self._signal(kill=False)
            try:
                self._process.wait(1.0)
            except subprocess.TimeoutExpired:
                self._signal(kill=True)
                self._process.wait(5.0)

    def _read(self, name: str, stream) -> None:
        # Closed at its end, whoever else has had it open.
        with stream:
            for line in stream:
                self._lines.put((name, line.rstrip("\n")))

    def _take_lines(self) -> None:
        while not self._lines.empty():
            name, line = self._lines.get()
            content = _json_object(line) if name == "out" else None
            if content is None:
                self.log.append(line)
            elif _is_fraction(content.get("progress")):
                self.fraction = float(content["progress"])
                self.message = str(content.get("message", ""))
            elif "status" in content:
                self.result = content

    def _finish(self, code: int) -> None:
        if code == 0:
            self.state, self.fraction = JobState.DONE, 1.0
        elif self._cancelled_at is not None or code == 130:
            self.state = JobState.CANCELLED
        else:
            self.state = JobState.FAILED
            said = [line for line in self.log if line.strip()]
            self.error = self.result.get("error") or (
                f"The worker ended with exit code {code}. " + " ".join(said[-2:]))

    def _signal(self, *, kill: bool) -> None:
        try:
            if _POSIX:
                # The whole group: a mesher or a pool may be running under the worker.
                os.killpg(self._process.pid, signal.SIGKILL if kill else signal.SIGTERM)
            elif kill:
                self._process.kill()
            else:
                self._process.terminate()
        except ProcessLookupError:
            return


def _is_fraction(value: Any) -> bool:
    return isinstance(value, int | float) and 0.0 <= value <= 1.0


def _json_object(line: str) -> dict[str, Any] | None:
    try:
        content = json.loads(line)
    except (ValueError, RecursionError):
        # Native libraries print lines of their own among ours.
        return None
    return content if isinstance(content, dict) else None


_last: list[Job] = []


def current() -> Job | None:
    """Return the job that runs, or the last one; one runs at a time."""
    return _last[0] if _last else None


def is_running() -> bool:
    return bool(_last) and _last[0].state is JobState.RUNNING


def start(title: str, command: list[str]) -> Job:
    """Start ``command`` as the current job.

    Raises:
        RuntimeError: another job is running.
        OSError: the program cannot be started.
    """
    if is_running():
        raise RuntimeError(f"{_last[0].title} is still running; wait for it or cancel it.")
    _last[:] = [Job(title, command)]
    return _last[0]


def forget() -> None:
    """End the current job, if any, and forget it: the add-on goes away or Blender closes."""
    for job in _last:
        job.stop_now()
    _last.clear()


atexit.register(forget)
