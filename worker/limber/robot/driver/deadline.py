"""A time limit on calls into ur-rtde, kept by the system: it ends this process.

ur-rtde waits in C++, for minutes and with the interpreter's lock, for an answer that never comes if
a connection works in one direction only. No Python thread can act then. The controller's own
watchdog ends its program a tenth of a second after the last message of this process.
"""

import faulthandler
import signal
import time

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
