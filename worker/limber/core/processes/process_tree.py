"""A process and all its descendants: memory, time, termination."""

import contextlib
from collections.abc import Callable
from typing import Any


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
