"""Processes that are waited for until they have ended."""

import time
from collections.abc import Iterable

import psutil


def left_alive(processes: Iterable[psutil.Process], seconds: float) -> list[psutil.Process]:
    """Wait until all have ended, at most so long; return those that have not.

    A zombie has ended: whoever adopted it has not asked for its exit code yet, and takes seconds
    over that on some systems.
    """
    end = time.monotonic() + seconds
    left = list(processes)
    while (left := [each for each in left if _runs(each)]) and time.monotonic() < end:
        time.sleep(0.01)
    return left


def _runs(process: psutil.Process) -> bool:
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
