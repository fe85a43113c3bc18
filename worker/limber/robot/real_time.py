"""Real-time priority for the loops that talk to a robot, where the system grants it."""

import ctypes
import gc
import os
import sys

VIRTUAL_ROBOT_PRIORITY = 25
"""Before the driver it is driven by: a real controller has a computer of its own."""

_ALL_PRESENT = 1  # MCL_CURRENT: not what comes later, which could then be refused


def claim_real_time(priority: int = 20) -> bool:
    """Ask for round-robin real-time scheduling; returns whether it was granted.

    Linux grants it to root and to users with a real-time limit. Without it other programs can
    hold the loop up for tens of milliseconds, which ends in a stop.
    """
    if not hasattr(os, "sched_setscheduler"):
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(priority))
    except OSError:
        return False
    return True


def spare_what_is_loaded() -> bool:
    """Leave what this process holds by now out of every later search for garbage, and in memory.

    A whole search goes through all that the libraries loaded: 20 to 70 ms in a loop that must
    not pause for 50. After this it goes through what came since, which is little. And a system
    may take back the pages of code that was not used for a minute, as that for a motion while the
    arm stands: the first who needs it waits for the disk.

    Returns:
        Whether the pages stay; Linux grants it to root and to users who may lock so much memory.
    """
    gc.collect()
    gc.freeze()
    return sys.platform == "linux" and ctypes.CDLL(None).mlockall(_ALL_PRESENT) == 0
