"""Processes end with their parent, however that ended.

On every system a pipe to the parent closes when the parent ends, and a thread waits for that. On
Linux the kernel also ends the process, even while native code blocks that thread.
"""

import _thread
import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable

PARENT_PIPE = "LIMBER_PARENT_PIPE"
"""Set to ``stdin`` by a parent that keeps the child's standard input open as long as it lives."""
_PR_SET_PDEATHSIG = 1


def end_by_kernel(parent_id: int) -> None:
    """On Linux: have the kernel kill this process when the thread that started it ends."""
    if sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent_id:
        # The parent ended before the request.
        os._exit(1)


def end_with_parent_pipe(grace_seconds: float = 10.0) -> None:
    """If the parent holds this standard input open: when it closes, the main thread gets a
    KeyboardInterrupt to clean up, and after ``grace_seconds`` the process exits in any case."""
    if os.environ.pop(PARENT_PIPE, None) != "stdin":
        return

    # No other code may wait for input there or hold it open.
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
            # A broken pipe counts as closed.
            pass
        then()

    threading.Thread(target=watch, name="parent watch", daemon=True).start()
