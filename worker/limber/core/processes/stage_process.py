"""One stage as a process: its progress is relayed, its result returned; it ends with its parent."""

import math
import os
import queue
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from typing import Any, TextIO

from limber.core.errors import Cancelled, InputError, LimberError, SafetyStop, WorkError
from limber.core.json_lines import json_object
from limber.core.processes.budget import CORES
from limber.core.processes.end_with_parent import PARENT_PIPE
from limber.core.processes.process_limits import UNLIMITED, Limits, LimitWatch
from limber.core.processes.process_tree import kill_tree
from limber.core.progress import SILENT, Progress

_ERRORS: dict[int, type[LimberError]] = {2: InputError, 4: SafetyStop, 130: Cancelled}
_GRACE_SECONDS = 10.0
_TICK_SECONDS = 0.1


def run_stage(arguments: Sequence[str], progress: Progress = SILENT) -> dict[str, Any]:
    """Run ``limber ARGUMENTS`` in a separate process and return its JSON result.

    Memory and native crashes are confined to that process. Cancelling ``progress``, or Ctrl-C, ends
    it.

    Args:
        arguments: The stage and its options.
        progress: Gets the reports of the stage.

    Raises:
        LimberError: the stage's own error, by its exit code; :class:`WorkError` if it crashed or
            exceeded its limits.
    """
    command = [sys.executable, "-m", "limber", *map(str, arguments),
               "--json", "--progress", "json"]
    return run_json_process(arguments[0], command, progress,
                            fix=f"Run it alone to see more: limber {' '.join(map(str, arguments))}")


def run_json_process(name: str, command: Sequence[str], progress: Progress = SILENT, *,
                     limits: Limits = UNLIMITED, cores: int | None = None,
                     fix: str = "") -> dict[str, Any]:
    """Run a program that writes progress and result as stages do; returns its result.

    Args:
        name: Its name in error messages.
        command: The program and its arguments. Its standard input closes when this process ends;
            ``LIMBER_PARENT_PIPE=stdin`` informs it of that.
        progress: Gets the reports of the stage.
        limits: Limits of the process.
        cores: Number of our cores it may use; all by default.
        fix: What to do if it ends without a result.

    Raises:
        LimberError: as :func:`run_stage`.
    """
    environment = os.environ | {PARENT_PIPE: "stdin"}
    if cores is not None:
        environment[CORES] = str(cores)
    with tempfile.TemporaryFile("w+", encoding="utf-8") as errors:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                                   stderr=errors, text=True, encoding="utf-8", errors="replace",
                                   env=environment)
        try:
            result = _followed(name, process, progress, limits)
        except BaseException:
            _stop(process)
            raise
        finally:
            if process.stdin is not None:
                process.stdin.close()
        if process.returncode != 0:
            raise _failure(name, process.returncode, result, errors, fix)
    return result


def _followed(name: str, process: subprocess.Popen, progress: Progress,
              limits: Limits) -> dict[str, Any]:
    """Relay the reports of the process until it has ended; return its result."""
    lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    reader = threading.Thread(target=_read, args=(process.stdout, lines), daemon=True)
    reader.start()
    watch = LimitWatch(name, limits, process.pid)
    result: dict[str, Any] = {}
    while True:
        try:
            line = lines.get(timeout=_TICK_SECONDS)
        except queue.Empty:
            line = ""
        if line is None or (not line and process.poll() is not None):
            # A grandchild may keep the pipe open; the relevant lines have been read by then.
            process.wait()
            return result
        result = _taken(line, progress) or result
        if progress.cancelled:
            raise Cancelled
        if error := watch.broken():
            raise error


def _read(stream: TextIO, lines: "queue.SimpleQueue[str | None]") -> None:
    with stream:
        for line in stream:
            lines.put(line)
    lines.put(None)


def _taken(line: str, progress: Progress) -> dict[str, Any]:
    """Pass a line of progress on; return its content if it is a result."""
    content = json_object(line)
    if content is None:
        return {}
    fraction = content.pop("progress", None)
    if isinstance(fraction, int | float) and math.isfinite(fraction):
        numbers = {name: value for name, value in content.items()
                   if name not in ("self", "fraction", "message", "seconds")}
        progress(fraction, str(content.get("message", "")), **numbers)
        return {}
    return content if "status" in content else {}


def _stop(process: subprocess.Popen) -> None:
    process.terminate()
    try:
        process.wait(_GRACE_SECONDS)
    except subprocess.TimeoutExpired:
        kill_tree(process.pid)
        process.wait()


def _failure(name: str, code: int, result: dict[str, Any], errors: TextIO,
             fix: str) -> LimberError:
    kind = _ERRORS.get(code, WorkError)
    if result.get("error"):
        # The fix is kept separate: a command that runs others has other options.
        advice = str(result.get("fix") or "")
        return kind(f"{name}: {str(result['error']).removesuffix(advice).rstrip()}", "", advice)
    errors.seek(0)
    tail = " | ".join(errors.read().strip().splitlines()[-4:])
    return kind(f"{name} ended with exit code {code} and no result.", tail, fix)
