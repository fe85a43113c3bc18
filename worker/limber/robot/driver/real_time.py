"""What the loops that talk to a robot need of the system: priority, a deadline, unhurried words."""

import ctypes
import faulthandler
import gc
import json
import os
import queue
import signal
import struct
import sys
import threading
import time
from pathlib import Path
from typing import Any, TextIO

VIRTUAL_ROBOT_PRIORITY = 25
"""Before the driver that controls it: a real controller has a computer of its own."""

_WAKING = Path("/dev/cpu_dma_latency")
_ALL_PRESENT = 1  # MCL_CURRENT: not future memory, which could then be refused


def claim_real_time(priority: int = 20) -> bool:
    """Ask for round-robin real-time scheduling; return whether it was granted: to root, and to
    users with a real-time limit. Without it other programs delay the loop by tens of milliseconds,
    which causes a stop. With one processor it is not requested: the loop would take it from the
    program that gives orders."""
    if not hasattr(os, "sched_setscheduler") or not may_use_two_processors():
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(priority))
    except OSError:
        return False
    return True


def may_use_two_processors() -> bool:
    """Whether the system lets this process use more than one processor."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0)) > 1
    return (os.cpu_count() or 1) > 1


def spare_what_is_loaded() -> bool:
    """Exclude the present objects from later garbage collections: a full one takes 20 to 70 ms in a
    loop that must not pause for 50. Keep their pages in memory, as those unused for a minute, such
    as a motion's while the arm rests, would wait for the disk; returns whether they stay (root, and
    users who may lock that much)."""
    gc.collect()
    gc.freeze()
    return sys.platform == "linux" and ctypes.CDLL(None).mlockall(_ALL_PRESENT) == 0


def keep_awake() -> bool:
    """Keep the processors from sleeping while they idle, until this process ends
    (``Documentation/power/pm_qos_interface``); return whether that was granted. One wakes late, a
    virtual machine's when its host returns it: 5 to 50 ms delayed a loop of 2 ms several times a
    second."""
    try:
        # Left open on purpose: the request holds as long as the file is open.
        device = os.open(_WAKING, os.O_WRONLY)
        os.write(device, struct.pack("i", 0))
    except OSError:
        return False
    return True


# A time limit on calls into ur-rtde, kept by the system: it ends this process.
#
# ur-rtde waits in C++, for minutes and with the interpreter's lock, for an answer that never comes
# if a connection works in one direction only. No Python thread can act then. The controller's own
# watchdog ends its program a tenth of a second after the last message of this process.

CALL_SECONDS = 1.5
"""Longer than any call that the controller answers, and shorter than a person waits."""
CONNECT_SECONDS = 12.0
"""ur-rtde uploads its program and waits up to 5 s until it runs."""

_RENEWED_SECONDS = 0.2


def set_deadline(seconds: float = CALL_SECONDS) -> None:
    """End this process in ``seconds`` unless a new deadline is set by then."""
    if hasattr(signal, "setitimer"):
        # The alarm has no handler, so that the kernel ends the process.
        signal.setitimer(signal.ITIMER_REAL, seconds)
    else:
        faulthandler.dump_traceback_later(seconds, exit=True)


def clear_deadline() -> None:
    """Cancel the deadline."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    else:
        faulthandler.cancel_dump_traceback_later()


def ended_by_deadline(exit_code: int | None) -> bool:
    """Whether an exit code of a process is that of its deadline."""
    if hasattr(signal, "setitimer"):
        return exit_code == -signal.SIGALRM
    return exit_code == 1


class RenewedDeadline:
    """The deadline of a loop, renewed some times a second rather than in each cycle."""

    def __init__(self) -> None:
        self._set_at = -float("inf")

    def renew(self) -> None:
        """Give the loop :data:`CALL_SECONDS` from now on, or from a fifth of a second ago."""
        now = time.monotonic()
        if now - self._set_at > _RENEWED_SECONDS:
            self._set_at = now
            set_deadline()


class Words:
    """The driver's events, one JSON object a line, written by a separate thread: a slow parent
    fills the pipe in a third of a second, and a loop that waited would starve the controller's
    watchdog."""

    def __init__(self, out: TextIO):
        self._out = out
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write, name="words", daemon=True)
        self._thread.start()

    def tell(self, **content: Any) -> None:
        """Send an event; returns immediately."""
        self._lines.put(json.dumps(content))

    def close(self, seconds: float = 2.0) -> None:
        """Wait until all events are sent, at most this long."""
        self._lines.put(None)
        self._thread.join(seconds)

    def _write(self) -> None:
        # It shares the interpreter's lock with the loop, which must not wait for its turn.
        claim_real_time()
        while (line := self._lines.get()) is not None:
            try:
                self._out.write(line + "\n")
                self._out.flush()
            except OSError:
                # The parent does not listen; the end of the orders shows that it has ended.
                return


if __name__ == "__main__":
    print(json.dumps({"real_time": claim_real_time(), "kept_in_memory": spare_what_is_loaded(),
                      "kept_awake": keep_awake()}))
