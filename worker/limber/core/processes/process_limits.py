"""Limits of a process, and their check."""

import time
from dataclasses import dataclass

from limber.core.errors import WorkError
from limber.core.processes.process_tree import computed_seconds, is_ready, memory_mb


@dataclass(frozen=True)
class Limits:
    """Limits of a task; its process is killed when it exceeds them.

    Attributes:
        seconds: From its start, or None.
        memory_mb: Memory of its process and all descendants, or None.
        computed_seconds: Processor time of its process and all descendants, or None. Other load on
            the machine does not count.
        idle_seconds: Longest time without any processor time, or None; detects a process that waits
        in vain.
    """

    seconds: float | None = None
    memory_mb: float | None = None
    computed_seconds: float | None = None
    idle_seconds: float | None = None


UNLIMITED = Limits()


class LimitWatch:
    """Checks a process against limits, from now on.

    Args:
        name: Description of the task, for messages.
        limits: Limits of the process.
        process_id: Process whose memory counts, including its descendants.
        memory_interval: Time between two checks of memory and processor time [s].
    """

    def __init__(self, name: str, limits: Limits, process_id: int, memory_interval: float = 0.5):
        self._name, self._limits, self._process_id = name, limits, process_id
        self._interval = memory_interval
        self._began = self._next_look = self._last_busy = time.monotonic()
        self._computed = 0.0

    @property
    def seconds(self) -> float:
        """Time since the start of the checks."""
        return time.monotonic() - self._began

    def broken(self) -> WorkError | None:
        """Return which limit the process has exceeded; None if none."""
        seconds, memory_limit = self.seconds, self._limits.memory_mb
        if self._limits.seconds is not None and seconds > self._limits.seconds:
            return WorkError(f"{self._name} was stopped after {seconds:.0f} s.",
                             "It exceeded its time limit.",
                             "Allow it more time, or make the task smaller.")
        if time.monotonic() < self._next_look:
            return None
        self._next_look = time.monotonic() + self._interval
        if error := self._broken_time():
            return error
        if memory_limit is None:
            return None
        used = memory_mb(self._process_id)
        return None if used <= memory_limit else WorkError(
            f"{self._name} was stopped at {used:.0f} MB of memory.",
            f"Its limit is {memory_limit:.0f} MB.",
            "Allow it more memory, or make the task smaller.")

    def _broken_time(self) -> WorkError | None:
        limits, now = self._limits, time.monotonic()
        if limits.computed_seconds is None and limits.idle_seconds is None:
            return None
        computed = computed_seconds(self._process_id)
        if limits.computed_seconds is not None and computed > limits.computed_seconds:
            return WorkError(f"{self._name} was stopped after {computed:.0f} s of processor time.",
                             "It exceeded its time limit.",
                             "Allow it more time, or make the task smaller.")
        if computed > self._computed or is_ready(self._process_id):
            self._computed, self._last_busy = computed, now
        idle = now - self._last_busy
        if limits.idle_seconds is not None and idle > limits.idle_seconds:
            return WorkError(f"{self._name} was stopped after it did nothing for {idle:.0f} s.",
                             "It waits for something that does not come.",
                             "Check the disk or the connection that it reads from.")
        return None
