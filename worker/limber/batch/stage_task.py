"""One stage on one branch, in a process of the pool."""

import os
import threading
import time
from pathlib import Path
from typing import Any

from limber.batch.job_file import StageTask
from limber.core.errors import BranchBusyError, Cancelled, LimberError
from limber.core.json_values import plain
from limber.core.machine_errors import machine_error
from limber.core.processes.process_limits import memory_mb
from limber.core.progress import Progress
from limber.stages.registry import stage_description
from limber.store.manifest import read_manifest
from limber.version import VERSION

_SAMPLE_SECONDS = 0.2


def run_task(task: StageTask, folder: Path, progress: Progress) -> dict[str, Any]:
    """Run a stage; return its outcome, also if it failed.

    Returns:
        ``error`` (empty if it succeeded), ``result``, ``warnings``, ``seconds``, ``memory_mb`` at
        its largest, ``content``, the digest of the branch shown by a stage that stores no results
        in it, and ``is_kept``: the branch already had the result, from this input with these
        settings.

    Raises:
        BranchBusyError: another program is writing to the branch.
        Cancelled: the stage was cancelled.
    """
    warnings: list[str] = []
    before = _finished(task, folder)
    started = time.perf_counter()
    outcome: dict[str, Any] = {"error": "", "result": {}}
    with _Memory() as memory:
        try:
            outcome["result"] = plain(stage_description(task.stage).run(
                task.inputs, task.settings, task.options, progress.keeping(warnings)))
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


def is_shown(task: StageTask, folder: Path, content: str) -> bool:
    """Whether a stage that stores no results in the branch, such as a scene, is up to date.

    Args:
        content: Digest of the branch that it has shown; empty if it has shown none.
    """
    outputs = _outputs(task)
    return bool(content and outputs) and content == _content(task, folder) and all(
        path.exists() for path in outputs)


def _content(task: StageTask, folder: Path) -> str:
    """Digest of branch and Limber version for a stage that stores no results; else empty."""
    if stage_description(task.stage).key or not _outputs(task):
        return ""
    try:
        return f"{VERSION} {read_manifest(folder).content_digest()}"
    except (LimberError, OSError):
        return ""


def _outputs(task: StageTask) -> list[Path]:
    """The files that a stage writes beside the branch; none if it reads any beside it."""
    kind = type(task.inputs)
    paths = {name: value for name, value in task.inputs if isinstance(value, Path)
             and name != "branch_folder"}
    outputs = [value for name, value in paths.items() if kind.group_of(name) == "output"]
    return outputs if len(outputs) == len(paths) else []


def _finished(task: StageTask, folder: Path) -> str | None:
    """Return when the branch's entry of the task was made; None if there is none."""
    key = stage_description(task.stage).entry(task.inputs, task.settings)
    if not key or not folder.is_dir():
        return None
    try:
        entry = read_manifest(folder).stages.get(key)
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
