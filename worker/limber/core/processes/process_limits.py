"""What a process may take, and whether it has taken more."""

import time
from dataclasses import dataclass

from limber.core.errors import WorkError
from limber.core.processes.process_tree import memory_mb


@dataclass(frozen=True)
class Limits:
    """Limits of a task; its process is killed when it exceeds them.

    Attributes:
        seconds: From its beginning, or None.
        memory_mb: Of its process and all that it started, or None.
    """

    seconds: float | None = None
    memory_mb: float | None = None


UNLIMITED = Limits()


class LimitWatch:
    """Holds a process against limits, from now on.

    Args:
        name: What it does, for messages.
        limits: What it may take.
        process_id: Whose memory counts, with that of all that it started.
        memory_interval: Between two looks at the memory [s].
    """

    def __init__(self, name: str, limits: Limits, process_id: int, memory_interval: float = 0.5):
        self._name, self._limits, self._process_id = name, limits, process_id
        self._interval = memory_interval
        self._began = self._next_look = time.monotonic()

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
        if memory_limit is None or time.monotonic() < self._next_look:
            return None
        self._next_look = time.monotonic() + self._interval
        used = memory_mb(self._process_id)
        return None if used <= memory_limit else WorkError(
            f"{self._name} was stopped at {used:.0f} MB of memory.",
            f"Its limit is {memory_limit:.0f} MB.",
            "Allow it more memory, or make the task smaller.")
