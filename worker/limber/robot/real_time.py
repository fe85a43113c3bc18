"""Real-time priority for the loops that talk to a robot, where the system grants it."""

import gc
import os

VIRTUAL_ROBOT_PRIORITY = 25
"""Before the driver it is driven by: a real controller has a computer of its own."""


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


def spare_what_is_loaded() -> None:
    """Leave what this process holds by now out of every later search for garbage.

    A whole search goes through all that the libraries loaded: 20 to 70 ms in a loop that must
    not pause for 50. After this it goes through what came since, which is little.
    """
    gc.collect()
    gc.freeze()
