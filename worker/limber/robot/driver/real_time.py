"""Real-time priority for the loops that talk to a robot, where the system grants it."""

import ctypes
import gc
import os
import struct
import sys
from pathlib import Path

VIRTUAL_ROBOT_PRIORITY = 25
"""Before the driver it is driven by: a real controller has a computer of its own."""

_WAKING = Path("/dev/cpu_dma_latency")
_ALL_PRESENT = 1  # MCL_CURRENT: not what comes later, which could then be refused


def claim_real_time(priority: int = 20) -> bool:
    """Ask for round-robin real-time scheduling; returns whether it was granted.

    Linux grants it to root and to users with a real-time limit. Without it other programs can
    hold the loop up for tens of milliseconds, which ends in a stop. It is not asked for where this
    process may use a single processor: the loop would take it from the program that gives orders.
    """
    if not hasattr(os, "sched_setscheduler") or not may_use_two_processors():
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(priority))
    except OSError:
        return False
    return True


def may_use_two_processors() -> bool:
    """Whether the system lets this process use more than one processor."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0)) > 1
    return (os.cpu_count() or 1) > 1


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


def keep_awake() -> bool:
    """Keep the computer's processors from sleeping while they idle, until this process ends.

    One that sleeps wakes late: by a fraction of a millisecond, and that of a virtual machine when
    its host gives it back, which was 5 to 50 ms and made a loop that wakes every 2 ms too late
    several times a second. Linux' own way to say so (``Documentation/power/pm_qos_interface``).

    Returns:
        Whether it was granted: to root, and to who may write to the device.
    """
    try:
        # Left open on purpose: the request stands as long as the file is.
        device = os.open(_WAKING, os.O_WRONLY)
        os.write(device, struct.pack("i", 0))
    except OSError:
        return False
    return True
