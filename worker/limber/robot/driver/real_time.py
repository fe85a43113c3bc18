"""Real-time priority for the loops that talk to a robot, if the system grants it."""

import ctypes
import gc
import os
import struct
import sys
from pathlib import Path

VIRTUAL_ROBOT_PRIORITY = 25
"""Before the driver that controls it: a real controller has a computer of its own."""

_WAKING = Path("/dev/cpu_dma_latency")
_ALL_PRESENT = 1  # MCL_CURRENT: not future memory, which could then be refused


def claim_real_time(priority: int = 20) -> bool:
    """Ask for round-robin real-time scheduling; returns whether it was granted.

    Linux grants it to root and to users with a real-time limit. Without it other programs can delay
    the loop by tens of milliseconds, which causes a stop. It is not requested if this process may
    use only one processor: the loop would take it from the program that gives orders.
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
    """Exclude the present objects from every later garbage collection, and keep them in memory.

    A full collection visits everything that the libraries loaded: 20 to 70 ms in a loop that must
    not pause for 50. After this it visits only newer objects, which are few. The system may also
    evict code pages unused for a minute, such as those of a motion while the arm is at rest.
    Their first use would then wait for the disk.

    Returns:
        Whether the pages stay; Linux grants it to root and to users who may lock that much memory.
    """
    gc.collect()
    gc.freeze()
    return sys.platform == "linux" and ctypes.CDLL(None).mlockall(_ALL_PRESENT) == 0


def keep_awake() -> bool:
    """Keep the computer's processors from sleeping while they idle, until this process ends.

    A sleeping processor wakes late: by a fraction of a millisecond, and that of a virtual machine
    when its host returns it. That took 5 to 50 ms and delayed a loop with a cycle of 2 ms several
    times a second. This is Linux's own interface for it (``Documentation/power/pm_qos_interface``).

    Returns:
        Whether it was granted: to root, and to users who may write to the device.
    """
    try:
        # Left open on purpose: the request holds as long as the file is open.
        device = os.open(_WAKING, os.O_WRONLY)
        os.write(device, struct.pack("i", 0))
    except OSError:
        return False
    return True
