"""A Limber module as a process, for compiled code that may crash, hang or exhaust the memory."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from limber.core.processes.process_limits import Limits, LimitWatch
from limber.core.processes.process_tree import kill_tree

_TICK_SECONDS, _MEMORY_SECONDS = 0.05, 0.1


def run_module(module: str, arguments: list[str], name: str, limits: Limits, *,
               folder: Path | None = None,
               waiting: Callable[[float], None] = lambda _seconds: None) -> tuple[int, str]:
    """Run ``python -m MODULE ARGUMENTS PARENT``; PARENT is for :func:`~.ending.end_by_kernel`.

    Args:
        module: Its full name.
        arguments: Arguments before this process's id.
        name: Description of the task, for messages.
        limits: Limits of the process.
        folder: Its working directory, if not the current one.
        waiting: Called while it runs with the elapsed seconds; an exception from it ends the
        process.

    Returns:
        The exit code, and the last line on standard error (empty if there is none).

    Raises:
        WorkError: it exceeded its limits.
    """
    command = [sys.executable, "-m", module, *arguments, str(os.getpid())]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                          stderr=subprocess.PIPE, env=environment, cwd=folder,
                          text=True, encoding="utf-8", errors="replace") as process:
        watch = LimitWatch(name, limits, process.pid, _MEMORY_SECONDS)
        try:
            while True:
                try:
                    _, stderr = process.communicate(timeout=_TICK_SECONDS)
                    break
                except subprocess.TimeoutExpired:
                    waiting(watch.seconds)
                if error := watch.broken():
                    raise error
        finally:
            if process.poll() is None:
                kill_tree(process.pid)
    return process.returncode, (stderr.strip().splitlines() or [""])[-1]
