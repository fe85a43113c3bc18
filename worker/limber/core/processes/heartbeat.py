"""A heartbeat beside the progress: it distinguishes a hanging worker from a busy one.

Work may be silent for long (one factorisation, a meshing process). Every few seconds a thread
writes ``{"alive": seconds, "cpu_s": seconds}``: the running time of the command, and the processor
time of its processes. If the second number is constant, nothing is computed. If no line comes, the
process is stopped, or native code blocks all its threads.
"""

import os
import threading
import time
from collections.abc import Callable
from typing import Any

from limber.core.processes.process_limits import computed_seconds

INTERVAL_SECONDS = 2.0


class Heartbeat:
    """Reports this process's numbers to ``say``, from another thread, every ``interval_seconds`` of
    a block."""

    def __init__(self, say: Callable[[dict[str, Any]], None],
                 interval_seconds: float = INTERVAL_SECONDS):
        self._say = say
        self._interval = interval_seconds
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)

    def __enter__(self) -> "Heartbeat":
        self._thread.start()
        return self

    def __exit__(self, *_exception: object) -> None:
        self._ended.set()
        # The last line of the stream is the result.
        self._thread.join()

    def _beat(self) -> None:
        start = time.perf_counter()
        while not self._ended.wait(self._interval):
            self._say({"alive": round(time.perf_counter() - start, 1),
                       "cpu_s": round(computed_seconds(os.getpid()), 2)})
