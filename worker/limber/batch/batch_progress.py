"""The progress of a batch: lines appended as it proceeds, so that they survive any end."""

import json
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Any

from limber.batch.job_file import BranchJob, JobFile, StageTask
from limber.core.files.atomic import is_alive
from limber.core.not_none import present
from limber.store.journal import Stream, stream_lines

_LEAST_LINES, _MOST_TIMES = 2000, 4
"""The file is shortened when it has this many lines, and this many times the valid ones."""
WAITING, RUNNING, DONE, KEPT, FAILED = "waiting", "running", "done", "up to date", "failed"


@dataclass(frozen=True)
class Record:
    """The state of a task: ``numbers`` are those of its result, ``memory_mb`` its largest.

    ``content`` is the digest of the branch shown by a stage that stores no results in it.
    """

    status: str = WAITING
    error: str = ""
    seconds: float | None = None
    memory_mb: float | None = None
    warnings: tuple[str, ...] = ()
    numbers: dict[str, float] = field(default_factory=dict)
    content: str = ""

    @property
    def has_succeeded(self) -> bool:
        return self.status in (DONE, KEPT)


class Records:
    """The records of a job file's tasks, by branch and fingerprint."""

    def __init__(self, jobs: JobFile):
        self.path = jobs.out / f"{jobs.path.stem}.jobs.jsonl"
        self._found: dict[tuple[str, str], Record] = {}
        self._stream: Stream | None = None
        for line in stream_lines(self.path) if self.path.is_file() else ():
            self._take(line)

    def of(self, branch: BranchJob, task: StageTask) -> Record:
        """Return the state of a task; one that ran when its batch was killed is waiting."""
        return self._found.get((branch.name, task.fingerprint), Record())

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Acquire the right to append; another batch of this job file is refused meanwhile."""
        with Stream(self.path, _last_of_each) as self._stream:
            yield
        self._stream = None

    def begin(self, branch: BranchJob, task: StageTask) -> None:
        import psutil

        self._append(branch, task, {"status": RUNNING, "process": [
            os.getpid(), round(psutil.Process().create_time())]})

    def end(self, branch: BranchJob, task: StageTask, record: Record) -> None:
        self._append(branch, task, {**vars(record)})

    def _append(self, branch: BranchJob, task: StageTask, record: dict[str, Any]) -> None:
        line = json.dumps({"branch": branch.name, "stage": task.label,
                           "task": task.fingerprint, **record})
        present(self._stream, "right to append to the records").append(line)
        self._take(line)

    def _take(self, line: str) -> None:
        try:
            entry = json.loads(line)
            key = (str(entry["branch"]), str(entry["task"]))
            status = str(entry["status"])
            if status == RUNNING:
                process, since = entry["process"]
                record = Record(RUNNING) if is_alive(int(process), int(since)) else Record()
            else:
                record = Record(status, str(entry["error"]), entry["seconds"], entry["memory_mb"],
                                tuple(entry["warnings"]), dict(entry["numbers"]),
                                str(entry.get("content", "")))
        except (ValueError, KeyError, TypeError, RecursionError):
            # A damaged line is ignored: its task runs again, and its result is kept if it is up to
            # date.
            return
        self._found[key] = record


def _last_of_each(lines: Iterator[str]) -> list[str] | None:
    """The last line of each task, if there are many more; a night's runs leave thousands."""
    last: dict[tuple[str, str], str] = {}
    count = 0
    for line in lines:
        count += 1
        try:
            entry = json.loads(line)
            last[str(entry["branch"]), str(entry["task"])] = line
        except (ValueError, KeyError, TypeError, RecursionError):
            # Damaged: ignored, as when it is read.
            continue
    return list(last.values()) if count > max(_LEAST_LINES, _MOST_TIMES * len(last)) else None


def numbers_of(result: dict[str, Any], longest: int = 12) -> dict[str, float]:
    """Return the numbers of a result, those of short lists one by one: ``young_pa_1``."""
    found: dict[str, float] = {}
    for key, value in result.items():
        items = value if isinstance(value, list) else [value]
        if len(items) > longest or not all(
                isinstance(one, int | float) and not isinstance(one, bool) for one in items):
            continue
        names = [key] if items is not value else [f"{key}_{n}" for n in range(1, len(items) + 1)]
        found |= dict(zip(names, items, strict=True))
    return found


def path_of_table(jobs: JobFile) -> Path:
    """Return the path of the table of results."""
    return jobs.out / f"{jobs.path.stem}.csv"


def path_of_page(jobs: JobFile) -> Path:
    """Return the path of the summary."""
    return jobs.out / f"{jobs.path.stem}.html"


# The log of a batch: a text file of limited size.

MOST_BYTES = 1_000_000
LOGS_KEPT = 3
"""Older files that are kept besides the newest: ``JOBS.log.1`` ..."""


def path_of_log(jobs: JobFile) -> Path:
    """Return the path of the newest lines."""
    return jobs.out / f"{jobs.path.stem}.log"


class BatchLog:
    """Appends lines with their time to a batch's log; use it in a ``with``.

    A line that cannot be written, on a full disk, is printed on standard error instead.
    """

    def __init__(self, jobs: JobFile):
        self._handler = RotatingFileHandler(path_of_log(jobs), maxBytes=MOST_BYTES,
                                            backupCount=LOGS_KEPT, encoding="utf-8", delay=True)
        self._handler.setFormatter(logging.Formatter("%(asctime)s %(message)s"))

    def tell(self, *parts: str) -> None:
        """Append a line made of these parts."""
        text = " ".join(" ".join(filter(None, parts)).split())
        self._handler.handle(logging.makeLogRecord({"msg": "%s", "args": (text,)}))

    def __enter__(self) -> "BatchLog":
        return self

    def __exit__(self, *_error: object) -> None:
        self._handler.close()
