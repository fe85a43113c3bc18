"""The events that a driver reports to its parent, without ever waiting for it."""

import json
import queue
import threading
from typing import Any, TextIO

from limber.robot.driver.real_time import claim_real_time


class Words:
    """The events of the driver, written by a separate thread.

    If the parent is slow to read, the pipe fills within a third of a second. A loop that waited for
    it would starve the controller's watchdog.

    Args:
        out: Destination of events, one JSON object a line.
    """

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
