"""One stage as a process: its progress relayed, its result returned, cancelled with its parent."""

import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from typing import Any, TextIO

from limber.errors import Cancelled, InputError, LimberError, SafetyStop, WorkError
from limber.progress import SILENT, Progress

_ERRORS: dict[int, type[LimberError]] = {2: InputError, 4: SafetyStop, 130: Cancelled}
_GRACE_SECONDS = 10.0


def run_stage(arguments: Sequence[str], progress: Progress = SILENT) -> dict[str, Any]:
    """Run ``limber ARGUMENTS`` in a process of its own and return its JSON result.

    Memory and native crashes stay in that process. A cancel of ``progress``, or Ctrl-C, ends it.

    Raises:
        LimberError: the stage's own error, by its exit code; :class:`WorkError` if it crashed.
    """
    command = [sys.executable, "-m", "limber", *map(str, arguments),
               "--json", "--progress", "json"]
    return run_json_process(arguments[0], command, progress,
                            fix=f"Run it alone to see more: limber {' '.join(map(str, arguments))}")


def run_json_process(name: str, command: Sequence[str], progress: Progress = SILENT, *,
                     fix: str = "") -> dict[str, Any]:
    """Run a program that writes progress and result as stages do; returns its result.

    Args:
        name: What it is called in an error.
        command: The program and its arguments.
        progress: Gets what it reports.
        fix: What to do when it ends without a word.

    Raises:
        LimberError: as :func:`run_stage`.
    """
    with tempfile.TemporaryFile("w+", encoding="utf-8") as errors:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True,
                                   encoding="utf-8", errors="replace")
        try:
            result = _read_lines(process, progress)
            process.wait()
        except BaseException:
            _stop(process)
            raise
        if process.returncode != 0:
            raise _failure(name, process.returncode, result, errors, fix)
    return result


def end_with_parent() -> None:
    """Called in a pool's process: end it when the process that made the pool is killed.

    Python's pool processes wait for work for ever when their parent dies without a word.
    """
    from multiprocessing import parent_process

    parent = parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, name="parent watch", daemon=True).start()


def _read_lines(process: subprocess.Popen, progress: Progress) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for line in process.stdout or ():
        try:
            content = json.loads(line)
        except json.JSONDecodeError:
            # Native libraries (fTetWild, Blender) print lines of their own.
            continue
        if not isinstance(content, dict):
            continue
        if "progress" in content:
            fraction = content.pop("progress")
            message = content.pop("message", "")
            content.pop("seconds", None)
            progress(fraction, message, **content)
        elif "status" in content:
            result = content
    return result


def _stop(process: subprocess.Popen) -> None:
    process.terminate()
    try:
        process.wait(_GRACE_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _failure(name: str, code: int, result: dict[str, Any], errors: TextIO,
             fix: str) -> LimberError:
    kind = _ERRORS.get(code, WorkError)
    if result.get("error"):
        return kind(f"{name}: {result['error']}")
    errors.seek(0)
    tail = " | ".join(errors.read().strip().splitlines()[-4:])
    return kind(f"{name} ended with exit code {code} and no result.", tail, fix)
