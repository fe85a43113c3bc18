"""Limits of a process, and their check."""

import contextlib
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from limber.core.errors import InputError, WorkError

# A process and all its descendants: memory, time, termination.


def memory_mb(process_id: int) -> float:
    """Return the memory [MB] of a process and all its descendants."""
    return sum(_of_each(process_id, lambda each: each.memory_info().rss)) / 1e6


def computed_seconds(process_id: int) -> float:
    """Return the processor time [s] of a process and all its descendants."""
    # Including ended children that their parent has waited for.
    kinds = ("user", "system", "children_user", "children_system")
    return sum(getattr(times, kind, 0.0)
               for times in _of_each(process_id, lambda each: each.cpu_times()) for kind in kinds)


def is_ready(process_id: int) -> bool:
    """Return whether a process, or one of its descendants, computes or waits for a processor."""
    return "running" in _of_each(process_id, lambda each: each.status())


def kill_tree(process_id: int) -> None:
    """Kill a process and all its descendants."""
    _of_each(process_id, lambda each: each.kill())


def _of_each(process_id: int, do: Callable[[Any], Any]) -> list[Any]:
    """Return ``do`` of each process, except those that have ended or belong to another user."""
    import psutil

    found = []
    with contextlib.suppress(psutil.NoSuchProcess):
        process = psutil.Process(process_id)
        for each in (*process.children(recursive=True), process):
            with contextlib.suppress(psutil.NoSuchProcess, psutil.AccessDenied):
                found.append(do(each))
    return found


@dataclass(frozen=True)
class Limits:
    """Limits of a task, whose process is killed beyond them: seconds from its start; memory [MB]
    and processor time [s] of it and all descendants, without other load of the machine; and the
    longest time without processor time [s], as of one that waits in vain. None: no limit."""

    seconds: float | None = None
    memory_mb: float | None = None
    computed_seconds: float | None = None
    idle_seconds: float | None = None


UNLIMITED = Limits()


class LimitWatch:
    """Checks a process with its descendants against limits, from now on; ``name`` is for messages,
    ``memory_interval`` the time between checks of memory and processor time [s]."""

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


# Number of parallel processes: cores and memory, divided among child processes.
#
# A process that starts others passes each a part of its own cores in the environment variable
# ``LIMBER_CORES``. A child process divides no more than that among its own children. A user may set
# the variable to reserve cores for other programs.

CORES = "LIMBER_CORES"
_SPARED_MEMORY = 0.15
"""Fraction of the free memory that is left unused: estimates of a task's need are rough."""


def core_budget() -> int:
    """Return how many cores this process may use; InputError if ``LIMBER_CORES`` is no positive
    whole number."""
    text = os.environ.get(CORES)
    if text is None:
        return _machine_cores()
    try:
        count = int(text)
    except ValueError:
        count = 0
    if count < 1:
        raise InputError(f"{CORES} is {text!r}.",
                         "It sets the number of cores that Limber may use.",
                         "Set it to a whole number of at least 1, or unset it.")
    return count


def worker_count(task_count: int, *, requested: int | None = None,
                 memory_mb_each: float = 0.0) -> int:
    """Return how many processes to start for ``task_count`` tasks, at least 1: within the budget,
    even if the user requested more, and with memory for each [MB] free."""
    count = min(core_budget(), max(task_count, 1), requested or task_count or 1)
    if memory_mb_each > 0:
        room = (1 - _SPARED_MEMORY) * free_memory_mb() / memory_mb_each
        count = min(count, int(room))
    return max(count, 1)


def free_memory_mb() -> float:
    """Return the memory [MB] still available, also within a container's limit."""
    import psutil

    free = psutil.virtual_memory().available
    limit, used = (_number(Path("/sys/fs/cgroup", name))
                   for name in ("memory.max", "memory.current"))
    if limit is not None and used is not None:
        free = min(free, max(limit - used, 0))
    return free / 1e6


def _machine_cores() -> int:
    """Cores that the system allows this process: affinity, and a container's quota."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (
        os.cpu_count() or 1)
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text(encoding="ascii").split()
        if quota != "max":
            cores = min(cores, max(int(int(quota) / int(period)), 1))
    except (OSError, ValueError):
        # No container, or one of another kind.
        return cores or 1
    return cores or 1


def _number(path: Path) -> int | None:
    try:
        return int(path.read_text(encoding="ascii"))
    except (OSError, ValueError):
        # Missing, or "max".
        return None
