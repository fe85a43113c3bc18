"""Frames received per second, over the last second. No bpy."""

import time
from collections import deque

_SPAN_SECONDS = 1.0


class FrameRate:
    """Counts frames as they arrive."""

    def __init__(self):
        self._at: deque[float] = deque()

    def tick(self, now: float | None = None) -> None:
        """Note that a frame has arrived, at ``now`` of the monotonic clock [s]."""
        self._at.append(time.monotonic() if now is None else now)

    def per_second(self, now: float | None = None) -> int:
        """Return the number of frames in the last second."""
        now = time.monotonic() if now is None else now
        while self._at and self._at[0] <= now - _SPAN_SECONDS:
            self._at.popleft()
        return len(self._at)
