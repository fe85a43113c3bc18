"""``blender -b --command limber STAGE ...``: the worker's command line inside Blender's."""

import signal
import subprocess
import sys

import bpy

from . import compat, preferences
from .jobs.worker import WorkerNotFound, worker_environment

_handles = []


def run_command(arguments: list[str]) -> int:
    """Run ``limber ARGUMENTS`` on the worker's Python and pass on its output and exit code."""
    try:
        command = [*preferences.worker_command(), *arguments]
    except WorkerNotFound as error:
        print(f"error: {error}", file=sys.stderr)
        return 3
    # The worker's last line must stay the last one: readers of --json rely on it.
    sys.stdout.flush()
    compat.flush_native_output()
    process = subprocess.Popen(command, env=worker_environment())
    previous = signal.signal(signal.SIGTERM, lambda *_: process.terminate())
    try:
        return _exit_code(process)
    finally:
        signal.signal(signal.SIGTERM, previous)


def _exit_code(process: subprocess.Popen) -> int:
    while True:
        try:
            code = process.wait()
        except KeyboardInterrupt:
            # Ctrl-C reaches the worker too; it ends in good order without help.
            continue
        return code if code >= 0 else 128 - code


def register() -> None:
    _handles.append(bpy.utils.register_cli_command("limber", run_command))


def unregister() -> None:
    while _handles:
        bpy.utils.unregister_cli_command(_handles.pop())
