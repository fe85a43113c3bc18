"""Processes end with the one that started them, however that one ended.

Everywhere a pipe to the parent closes when it ends, and a thread waits for that. On Linux the
kernel ends the process too, also while native code keeps that thread from running.
"""

import _thread
import ctypes
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable

PARENT_PIPE = "LIMBER_PARENT_PIPE"
"""Set to ``stdin`` by a parent that keeps our standard input open as long as it lives."""
_PR_SET_PDEATHSIG = 1


def end_by_kernel(parent_id: int) -> None:
    """On Linux: let the kernel kill this process when the thread that started it ends."""
    if sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent_id:
        # It ended before we asked.
        os._exit(1)


def end_with_parent_pipe(grace_seconds: float = 10.0) -> None:
    """If the parent holds our standard input open: when that closes, cancel, and then end.

    The main thread gets a KeyboardInterrupt, so that work in progress is cleared away; after
    ``grace_seconds`` the process ends whatever it does.
    """
    if os.environ.pop(PARENT_PIPE, None) != "stdin":
        return

    # Nobody else shall wait for input there, nor hold it open.
    handle = os.dup(0)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)

    def closed() -> None:
        _thread.interrupt_main(signal.SIGTERM)
        timer = threading.Timer(grace_seconds, os._exit, (1,))
        timer.daemon = True
        timer.start()

    _when_closed(handle, closed)


def _when_closed(handle: int, then: Callable[[], None]) -> None:
    def watch() -> None:
        try:
            while os.read(handle, 1024):
                continue
        except OSError:
            # A pipe that broke has closed too.
            pass
        then()

    threading.Thread(target=watch, name="parent watch", daemon=True).start()


def end_by_closing(process: subprocess.Popen, seconds: float = 5.0) -> None:
    """Close a child's standard input, which makes it end; kill it if it does not end in time."""
    if process.stdin is not None and not process.stdin.closed:
        try:
            process.stdin.close()
        except OSError:
            # It ended with a line on the way.
            process.kill()
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
