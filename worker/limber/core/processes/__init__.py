"""Processes: a pool for parallel computation, stages as separate processes, their termination.

It depends only on errors and progress, so that every package may use it.
"""

from limber.core.processes.pool import Pool, run_tasks
from limber.core.processes.process_limits import Limits, core_budget, worker_count

__all__ = ["Limits", "Pool", "core_budget", "run_tasks", "worker_count"]
