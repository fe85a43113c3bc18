"""The work of a Dask worker for a batch: it runs command lines in processes of its own pool.

Crash, memory and time are then confined to the stage, and imported modules remain for the next one.
A lost worker takes its processes with it.
"""

import os
import threading
import time
from multiprocessing import current_process
from pathlib import Path
from typing import Any

from limber.batch.scheduler_scripts import task_of_line
from limber.batch.stage_task import run_task
from limber.core.errors import BranchBusyError, Cancelled, LimberError
from limber.core.processes import Limits, Pool
from limber.core.progress import Progress
from limber.version import VERSION

_BUSY_SECONDS = 600.0
"""Time that a stage waits for a branch: a worker that was taken for lost may still finish it."""
_TICK_SECONDS = 1.0

_guard = threading.Lock()
_pool: Pool | None = None


def unfit(version: str) -> str:
    """Return why this process cannot be a worker of a batch of this version; empty if it can."""
    if version != VERSION:
        return (f"it has Limber {VERSION}, but the batch has {version}; install the same version "
                "on all machines")
    if current_process().daemon:
        return ("it is not allowed to start processes; start Dask workers with --no-nanny, or "
                "with DASK_DISTRIBUTED__WORKER__DAEMON=False in their environment")
    return ""


def run_line(line: list[str], directory: str, folder: str, limits: Limits, version: str,
             ) -> dict[str, Any]:
    """Run a stage's command line in a process of this worker's pool; return its outcome.

    Args:
        line: The stage and its arguments, as typed after ``limber``.
        directory: The folder to which the paths in it are relative.
        folder: The branch folder.
        limits: Its limits on time and memory.
        version: Version of the batch.

    Returns:
        As for :func:`limber.batch.stage_task.run_task`.

    Raises:
        Cancelled: the batch was cancelled.
    """
    reason = unfit(version)
    if reason:
        return _failed(f"The worker {os.getpid()} cannot run this stage: {reason}.", 0.0)
    started = time.perf_counter()
    try:
        return _workers_pool().submit(_run, line, directory, folder, limits=limits).result()
    except Cancelled:
        raise
    except LimberError as error:
        return _failed(str(error), time.perf_counter() - started)


def stop_lines() -> None:
    """End the running stages of this worker; the folders stay as they were before them."""
    global _pool
    with _guard:
        pool, _pool = _pool, None
    if pool is not None:
        pool.close()


def _workers_pool() -> Pool:
    global _pool  # noqa: PLW0603
    from distributed import get_worker

    with _guard:
        if _pool is None:
            # Dask makes its workers return memory at once. Stages would then allocate it again all
            # the time, which took a sixth of their time.
            os.environ.pop("MALLOC_TRIM_THRESHOLD_", None)
            _pool = Pool(get_worker().state.nthreads, name="a stage of the batch")
        return _pool


def _run(line: list[str], directory: str, folder: str, progress: Progress) -> dict[str, Any]:
    # Paths of the command line are relative to the start folder of the batch, on every machine.
    os.chdir(directory)
    task = task_of_line(line)
    end = time.monotonic() + _BUSY_SECONDS
    while True:
        try:
            return run_task(task, Path(folder), progress)
        except BranchBusyError as error:
            if time.monotonic() > end:
                return _failed(str(error), _BUSY_SECONDS)
        progress(0.0, "waiting for the branch")
        time.sleep(_TICK_SECONDS)


def _failed(error: str, seconds: float) -> dict[str, Any]:
    return {"error": error, "result": {}, "warnings": [], "seconds": round(seconds, 3),
            "memory_mb": None, "is_kept": False}
