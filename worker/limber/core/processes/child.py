"""Programs as child processes: objects as JSON lines in both directions, limits, their end.

A child ends with its parent: its standard input closes, or the kernel ends it
(:mod:`limber.core.processes.end_with_parent`).
"""

import contextlib
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from limber.core.errors import Cancelled, InputError, LimberError, SafetyStop, Text, WorkError
from limber.core.json_values import json_objects
from limber.core.processes.end_with_parent import PARENT_PIPE
from limber.core.processes.process_limits import CORES, UNLIMITED, Limits, LimitWatch, kill_tree
from limber.core.progress import SILENT, Progress

Found = TypeVar("Found")

_ERRORS: dict[int, type[LimberError]] = {2: InputError, 4: SafetyStop, 130: Cancelled}
_GRACE_SECONDS, _LEAVE_SECONDS = 10.0, 1.0
_TICK_SECONDS, _MODULE_TICK_SECONDS, _MEMORY_SECONDS = 0.1, 0.05, 0.1


class Child:
    """A program that writes JSON objects line by line, and may be sent some; a context manager.
    ``hear`` takes each in a thread; those for which it returns False are kept in ``objects``, the
    newest ``most_objects``, changed with ``news`` held. ``then`` is called there when no more come
    (``has_ended``); ``keeps_errors``: :meth:`tail` tells its standard error; options are of
    :class:`subprocess.Popen`."""

    def __init__(self, command: Sequence[str], hear: Callable[[dict[str, Any]], bool] | None = None,
                 then: Callable[[], object] = lambda: None, *, most_objects: int | None = None,
                 keeps_errors: bool = False, **options: Any):
        self.objects: list[dict[str, Any]] = []
        self.has_ended = False
        self.news = threading.Condition()
        self._hear, self._then = hear, then
        self._most_objects = most_objects
        self._writing = threading.Lock()
        self._errors = tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace",
                                              ) if keeps_errors else None
        standard: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        if keeps_errors:
            standard["stderr"] = self._errors
        self.process = subprocess.Popen(command, text=True, encoding="utf-8", errors="replace",
                                        **(standard | options))
        self._listener = threading.Thread(target=self._listen, name="child", daemon=True)
        self._listener.start()

    def __enter__(self) -> "Child":
        return self

    def __exit__(self, *_exception: object) -> None:
        self.kill()

    @property
    def alive(self) -> bool:
        """Whether the process is running."""
        return self.process.poll() is None

    def send(self, content: dict[str, Any] | str) -> None:
        """Write an object, or its JSON, to its standard input; ConnectionError if it has ended, or
        closed it."""
        line = content if isinstance(content, str) else json.dumps(content)
        try:
            with self._writing:
                assert self.process.stdin is not None
                self.process.stdin.write(line + "\n")
                self.process.stdin.flush()
        except (OSError, ValueError) as error:
            raise ConnectionError(str(error)) from error

    def wait(self, find: Callable[[], Found | None], seconds: float) -> Found | None:
        """Return what ``find`` finds in ``objects``, as soon as it does; None if not within
        ``seconds``, nor when no more come."""
        end = time.monotonic() + seconds
        with self.news:
            while True:
                found = find()
                left = end - time.monotonic()
                if found is not None or self.has_ended or left <= 0:
                    return found
                self.news.wait(left)

    def first(self) -> dict[str, Any] | None:
        """Take the oldest object; for :meth:`wait`."""
        return self.objects.pop(0) if self.objects else None

    def tail(self, count: int = 4) -> str:
        """Return the last lines that it wrote on standard error."""
        if self._errors is None or self._errors.closed:
            return ""
        self._errors.seek(0)
        return " | ".join(self._errors.read().strip().splitlines()[-count:])

    def close_input(self) -> None:
        """Close its standard input, as this process's end does."""
        with self._writing:
            if self.process.stdin is not None and not self.process.stdin.closed:
                try:
                    self.process.stdin.close()
                except OSError:
                    # It exited while a line was being written.
                    self.process.kill()

    def close(self, seconds: float = 5.0) -> None:
        """Close its input, which makes it exit; kill it if it does not exit in time."""
        self.close_input()
        try:
            self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.process.kill()
        self._release()

    def terminate(self, seconds: float) -> None:
        """Ask it to end; kill it and its descendants if it does not in time."""
        self.process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(seconds)
        self.kill()

    def kill(self) -> None:
        """Kill it and its descendants, if it is running, and let go of its files."""
        if self.alive:
            kill_tree(self.process.pid)
        self._release()

    def _release(self) -> None:
        self.process.wait()
        self._listener.join(_LEAVE_SECONDS)
        for stream in (self.process.stdin, self._errors):
            if stream is not None:
                with contextlib.suppress(OSError):  # nobody reads what was not sent
                    stream.close()

    def _listen(self) -> None:
        try:
            # A descendant may keep it open for longer: only who reads it can close it.
            with self.process.stdout or contextlib.nullcontext(()) as lines:
                for content in json_objects(lines):
                    was_taken = self._hear is not None and self._hear(content)
                    with self.news:
                        if not was_taken:
                            self.objects.append(content)
                            if self._most_objects is not None:
                                del self.objects[:-self._most_objects]
                        self.news.notify_all()
        finally:
            # Who hears of the end may ask for its exit code.
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(_LEAVE_SECONDS)
            with self.news:
                self.has_ended = True
                self.news.notify_all()
        self._then()


def run_module(module: str, arguments: list[str], name: str, limits: Limits, *,
               folder: Path | None = None,
               waiting: Callable[[float], None] = lambda _seconds: None) -> tuple[int, str]:
    """Run ``python -m MODULE ARGUMENTS PARENT``, for compiled code that may crash, hang or exhaust
    the memory; PARENT is for :func:`~.end_with_parent.end_by_kernel`. Returns the exit code, and
    the last line on standard error or "". ``waiting`` is called with the elapsed seconds; an
    exception from it ends the process. WorkError, with ``name``, if it exceeded its limits."""
    command = [sys.executable, "-m", module, *arguments, str(os.getpid())]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with Child(command, keeps_errors=True, env=environment, cwd=folder, stdin=subprocess.DEVNULL,
               stdout=subprocess.DEVNULL) as child:
        watch = LimitWatch(name, limits, child.process.pid, _MEMORY_SECONDS)
        while True:
            try:
                return child.process.wait(_MODULE_TICK_SECONDS), child.tail(1)
            except subprocess.TimeoutExpired:
                waiting(watch.seconds)
            if error := watch.broken():
                raise error


def run_stage(arguments: Sequence[str], progress: Progress = SILENT) -> dict[str, Any]:
    """Run ``limber ARGUMENTS`` in a process, to which memory and native crashes are confined, and
    return its JSON result; ``progress`` gets its reports, and ends it when cancelled, as Ctrl-C
    does. LimberError of the stage by its exit code; WorkError if it crashed or exceeded its
    limits."""
    # What follows "--" is no option.
    end = arguments.index("--") if "--" in arguments else len(arguments)
    command = [sys.executable, "-m", "limber", *arguments[:end], "--json", "--progress", "json",
               *arguments[end:]]
    return run_json_process(arguments[0], command, progress,
                            fix=f"Run it alone to see more: limber {' '.join(arguments)}")


def run_json_process(name: str, command: Sequence[str], progress: Progress = SILENT, *,
                     limits: Limits = UNLIMITED, cores: int | None = None,
                     fix: str = "") -> dict[str, Any]:
    """Run a program that writes progress and result as stages do; return its result. Its standard
    input closes when this process ends, as ``LIMBER_PARENT_PIPE=stdin`` tells it; ``cores``: how
    many of ours it may use, else all; ``fix``: what to do if it ends without a result. LimberError
    as :func:`run_stage`."""
    environment = os.environ | {PARENT_PIPE: "stdin"}
    if cores is not None:
        environment[CORES] = str(cores)
    with Child(command, keeps_errors=True, env=environment) as child:
        try:
            result = _followed(name, child, progress, limits)
        except BaseException:
            child.terminate(_GRACE_SECONDS)
            raise
        if child.process.returncode != 0:
            raise _failure(name, child, result, fix)
    if told := {each["text"]: Text.from_json(each["parts"])
                for each in result.pop("warning_parts", ())}:
        result["warnings"] = [told.get(text, text) for text in result["warnings"]]
    return result


def _followed(name: str, child: Child, progress: Progress, limits: Limits) -> dict[str, Any]:
    """Relay the reports of the process until it has ended; return its result."""
    watch = LimitWatch(name, limits, child.process.pid)
    result: dict[str, Any] = {}
    while True:
        # Asked before: what an ended process wrote comes within a tick.
        was_alive = child.alive
        content = child.wait(child.first, _TICK_SECONDS)
        if content is None and (child.has_ended or not was_alive):
            # A grandchild may keep the pipe open.
            child.process.wait()
            return result
        result = _taken(content or {}, progress) or result
        if progress.cancelled:
            raise Cancelled
        if error := watch.broken():
            raise error


def _taken(content: dict[str, Any], progress: Progress) -> dict[str, Any]:
    """Pass a report of progress on; return the content if it is a result."""
    fraction = content.pop("progress", None)
    if isinstance(fraction, int | float) and math.isfinite(fraction):
        numbers = {name: value for name, value in content.items()
                   if name not in ("self", "fraction", "message", "seconds")}
        progress(fraction, str(content.get("message", "")), **numbers)
        return {}
    return content if "status" in content else {}


def _failure(name: str, child: Child, result: dict[str, Any], fix: str) -> LimberError:
    code = child.process.returncode
    kind = _ERRORS.get(code, WorkError)
    if result.get("error"):
        seen, why, fix = map(Text.from_json, result.get("parts") or ([result["error"]], [], []))
        return kind(Text(f"{name}: ", seen), why, fix)
    return kind(f"{name} ended with exit code {code} and no result.", child.tail(), fix)
