"""Number of parallel processes: cores and memory, divided among child processes.

A process that starts others passes each a part of its own cores in the environment variable
``LIMBER_CORES``. A child process divides no more than that among its own children. A user may set
the variable to reserve cores for other programs.
"""

import os
from pathlib import Path

from limber.core.errors import InputError

CORES = "LIMBER_CORES"
_SPARED_MEMORY = 0.15
"""Fraction of the free memory that is left unused: estimates of a task's need are rough."""


def core_budget() -> int:
    """Return how many cores this process may use.

    Raises:
        InputError: ``LIMBER_CORES`` is not a positive whole number.
    """
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
    """Return how many processes to start for ``task_count`` tasks, at least 1.

    Args:
        task_count: Number of tasks; more processes would idle.
        requested: Number requested by the user; the budget still applies.
        memory_mb_each: Estimated memory per task; only as many processes run as fit into the free
        memory.
    """
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
