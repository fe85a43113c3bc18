"""What a process may take, and whether it has taken more."""

import time
from dataclasses import dataclass

from limber.core.errors import WorkError
from limber.core.processes.process_tree import computed_seconds, is_ready, memory_mb


@dataclass(frozen=True)
class Limits:
    """Limits of a task; its process is killed when it exceeds them.

    Attributes:
        seconds: From its beginning, or None.
        memory_mb: Of its process and all that it started, or None.
        computed_seconds: Processor time of its process and all that it started, or None. A machine
            that is busy with other work does not use it up.
        idle_seconds: In a row without any processor time, or None: it waits for what never comes.
    """

    seconds: float | None = None
    memory_mb: float | None = None
    computed_seconds: float | None = None
    idle_seconds: float | None = None


UNLIMITED = Limits()


class LimitWatch:
    """Holds a process against limits, from now on.

    Args:
        name: What it does, for messages.
        limits: What it may take.
        process_id: Whose memory counts, with that of all that it started.
        memory_interval: Between two looks at the memory and the processor time [s].
    """

    def __init__(self, name: str, limits: Limits, process_id: int, memory_interval: float = 0.5):
        self._name, self._limits, self._process_id = name, limits, process_id
        self._interval = memory_interval
        self._began = self._next_look = self._last_busy = time.monotonic()
        self._computed = 0.0

    @property
    def seconds(self) -> float:
        """How long it has been watched."""
        return time.monotonic() - self._began

    def broken(self) -> WorkError | None:
        """Return which limit the process has broken; None as long as it keeps them."""
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
