"""The waiting commands, between the thread that reads the client and the one that solves.

Commands keep their order, but a ``move`` replaces the one before it of the same grasp: of poses
that arrive while one is being solved, the newest wins. The number of waiting commands is limited.
"""

import os
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from limber.session.protocol import LINE_LIMIT, Close, Lines, Move, NotUnderstood, parse_command

_WAITING_LIMIT = 1000
_PIECE_BYTES = 1 << 16


@dataclass(frozen=True)
class Received:
    """A command, or a message from the trainer, and its arrival time [s, monotonic]."""

    content: Any
    at: float


class Inbox:
    """A queue of commands; ``closed`` once the client has closed or disconnected."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: deque[Received] = deque()
        self.closed = False
        self.last_at = 0.0

    def put(self, content: Any) -> bool:
        """Add an item; return False if too many are waiting already."""
        new = Received(content, time.monotonic())
        with self._changed:
            if not (isinstance(content, Move) and self._replaces(new)):
                if len(self._waiting) >= _WAITING_LIMIT:
                    return False
                self._waiting.append(new)
            self.last_at = new.at
            self._changed.notify_all()
        return True

    def close(self) -> None:
        """Report the end of the input."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def take(self, seconds: float) -> list[Received]:
        """Return all waiting messages; if there are none, wait for one up to the given time."""
        with self._changed:
            if not self._waiting and not self.closed and seconds > 0:
                self._changed.wait(seconds)
            found = list(self._waiting)
            self._waiting.clear()
            return found

    def _replaces(self, new: Received) -> bool:
        for number in range(len(self._waiting) - 1, -1, -1):
            before = self._waiting[number].content
            if not isinstance(before, Move):
                return False
            if before.grasp == new.content.grasp:
                self._waiting[number] = new
                return True
        return False


def read_commands(source: int, inbox: Inbox, refuse: Callable[[int, str], None]) -> None:
    """Put the commands of a file descriptor into an inbox until it ends; then close that.

    Args:
        refuse: Called for an invalid command with its id (0 if it has none) and the reason.
    """
    lines = Lines()
    try:
        while not inbox.closed and (piece := os.read(source, _PIECE_BYTES)):
            for line in lines.feed(piece):
                _take(line, inbox, refuse)
    except OSError:
        pass  # the pipe is closed: end of input
    finally:
        # However this thread ends, a session without input must not run on.
        inbox.close()


def _take(line: bytes | None, inbox: Inbox, refuse: Callable[[int, str], None]) -> None:
    if line is None:
        refuse(0, f"Not understood: a line of more than {LINE_LIMIT} bytes; it was dropped.")
        return
    if not line.strip():
        return
    try:
        command = parse_command(line)
    except NotUnderstood as error:
        refuse(error.reply_id, str(error))
        return
    if isinstance(command, Close):
        inbox.close()
    elif not inbox.put(command):
        refuse(command.id, f"{_WAITING_LIMIT} commands are waiting, which is the limit. Send "
                           "fewer commands, or wait for replies.")
