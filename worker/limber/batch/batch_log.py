"""The log of a batch: a text file of limited size."""

import logging
from logging.handlers import RotatingFileHandler
from pathlib import Path

from limber.batch.jobs.branch_jobs import JobFile

MOST_BYTES = 1_000_000
KEPT = 3
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
                                            backupCount=KEPT, encoding="utf-8", delay=True)
        self._handler.setFormatter(logging.Formatter("%(asctime)s %(message)s"))

    def tell(self, *parts: str) -> None:
        """Append a line made of these parts."""
        text = " ".join(" ".join(filter(None, parts)).split())
        self._handler.handle(logging.makeLogRecord({"msg": "%s", "args": (text,)}))

    def __enter__(self) -> "BatchLog":
        return self

    def __exit__(self, *_error: object) -> None:
        self._handler.close()
