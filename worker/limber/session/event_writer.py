"""Writes a session's events in a thread: a client that does not read does not stop the frames."""

import json
import os
import queue
import sys
import threading
from collections.abc import Callable
from typing import Any

from limber.core.json_values import plain

_WAITING_LIMIT = 1000


class Events:
    """JSON lines on standard output; unread lines are dropped.

    Args:
        gone: Called once when the reader has closed.
    """

    def __init__(self, gone: Callable[[], None] = lambda: None):
        self._gone = gone
        self._lines: queue.Queue[str | None] = queue.Queue(maxsize=_WAITING_LIMIT)
        self._thread = threading.Thread(target=self._write, daemon=True)
        self._thread.start()

    def say(self, **line: Any) -> None:
        """Write one event."""
        try:
            self._lines.put_nowait(json.dumps(plain(line), default=str))
        except queue.Full:
            return  # nobody reads it

    def close(self) -> None:
        """Report the end of the session, and write waiting events for at most a second."""
        self.say(event="closed")
        try:
            self._lines.put(None, timeout=1.0)
        except queue.Full:
            return
        self._thread.join(1.0)

    def _write(self) -> None:
        while (line := self._lines.get()) is not None:
            try:
                print(line, flush=True)
            except (OSError, ValueError):
                # Data that Python still buffers would fail again at exit.
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
                self._gone()
                return
