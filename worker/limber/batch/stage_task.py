"""One stage on one branch, in a process of the pool."""

import os
import threading
import time
from multiprocessing import current_process
from pathlib import Path
from typing import Any

from limber.core.errors import BranchBusyError, Cancelled, LimberError
from limber.core.json_values import plain
from limber.core.machine_errors import machine_error
from limber.core.processes import Limits, Pool
from limber.core.processes.process_limits import memory_mb
from limber.core.progress import Progress
from limber.stages.registry import stage_class
from limber.stages.stage import Stage
from limber.store.manifest import read_manifest
from limber.version import VERSION

_SAMPLE_SECONDS = 0.2


def run_task(task: Stage, folder: Path, progress: Progress) -> dict[str, Any]:
    """Run a stage; return its outcome, also if it failed: ``error`` or "", ``result``,
    ``warnings``, ``seconds``, ``memory_mb`` at its largest, ``content``, the digest of the branch
    shown by a stage that stores no results in it, ``is_kept``: the branch had the result from this
    input and settings. BranchBusyError if another program writes to the branch; Cancelled."""
    warnings: list[str] = []
    before = _finished(task, folder)
    started = time.perf_counter()
    outcome: dict[str, Any] = {"error": "", "result": {}}
    with _Memory() as memory:
        try:
            outcome["result"] = plain(task.run(progress.keeping(warnings)))
        except (BranchBusyError, Cancelled):
            raise
        except LimberError as error:
            outcome["error"] = str(error)
        except (OSError, MemoryError) as error:
            translated = machine_error(error, folder)
            if translated is None:
                raise
            outcome["error"] = str(translated)
    after = _finished(task, folder)
    return outcome | {
        "content": _content(task, folder), "warnings": warnings,
        "seconds": round(time.perf_counter() - started, 3),
        "memory_mb": round(memory.most_mb, 1), "is_kept": before is not None and before == after}


def is_shown(task: Stage, folder: Path, content: str) -> bool:
    """Whether a stage that stores no results in the branch, such as a scene, is up to date;
    ``content``: digest of the branch that it has shown, or ""."""
    outputs = _outputs(task)
    return bool(content and outputs) and content == _content(task, folder) and all(
        path.exists() for path in outputs)


def _content(task: Stage, folder: Path) -> str:
    """Digest of branch and Limber version for a stage that stores no results; else empty."""
    if task.about.key or not _outputs(task):
        return ""
    try:
        return f"{VERSION} {read_manifest(folder).content_digest()}"
    except (LimberError, OSError):
        return ""


def _outputs(task: Stage) -> list[Path]:
    """The files that a stage writes beside the branch; none if it reads any beside it."""
    paths = [name for name in task.parts()["inputs"] if isinstance(getattr(task, name), Path)
             and name != "branch_folder"]
    outputs = task.outputs()
    return outputs if len(outputs) == len(paths) else []


def _finished(task: Stage, folder: Path) -> str | None:
    """Return when the branch's entry of the task was made; None if there is none."""
    if not task.entry or not folder.is_dir():
        return None
    try:
        entry = read_manifest(folder).stages.get(task.entry)
    except (LimberError, OSError):
        # The stage reports what is wrong.
        return None
    return entry.finished + str(entry.seconds) if entry else None


class _Memory:
    """Monitors the memory of this process and of its children."""

    def __init__(self) -> None:
        self.most_mb = 0.0
        self._closing = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="memory watch", daemon=True)

    def __enter__(self) -> "_Memory":
        self._watcher.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._closing.set()
        self._watcher.join()

    def _watch(self) -> None:
        while True:
            self.most_mb = max(self.most_mb, memory_mb(os.getpid()))
            if self._closing.wait(_SAMPLE_SECONDS):
                return


# The work of a Dask worker for a batch: it runs stages in processes of its own pool.
#
# Crash, memory and time are then confined to the stage, and imported modules remain for the next
# one. A lost worker takes its processes with it.

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


def run_remotely(name: str, stated: dict[str, Any], directory: str, folder: str, limits: Limits,
                 version: str) -> dict[str, Any]:
    """Run a stage with values as of :meth:`limber.stages.stage.Stage.stated`, paths relative to
    ``directory``, in a process of this worker's pool, within limits on time and memory, for a batch
    of this version; return its outcome as :func:`limber.batch.stage_task.run_task`. Cancelled if
    the batch was."""
    reason = unfit(version)
    if reason:
        return _failed(f"The worker {os.getpid()} cannot run this stage: {reason}.", 0.0)
    started = time.perf_counter()
    try:
        return _workers_pool().submit(
            _run, name, stated, directory, folder, limits=limits).result()
    except Cancelled:
        raise
    except LimberError as error:
        return _failed(str(error), time.perf_counter() - started)


def stop_stages() -> None:
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


def _run(name: str, stated: dict[str, Any], directory: str, folder: str, progress: Progress,
         ) -> dict[str, Any]:
    # Paths are relative to the start folder of the batch, on every machine.
    os.chdir(directory)
    task = stage_class(name).checked(stated)
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
