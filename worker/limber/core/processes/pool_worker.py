"""A process of the pool as seen by the pool, and the pending tasks."""

import time
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

from limber.core.errors import Cancelled, WorkError
from limber.core.not_none import present
from limber.core.processes.pool_process import Reported, Task, serve
from limber.core.processes.process_limits import Limits, LimitWatch
from limber.core.processes.process_tree import kill_tree
from limber.core.progress import Progress


@dataclass
class Job:
    """A task, its limits, and its future."""

    task: Task
    limits: Limits
    progress: Progress
    future: Future = field(default_factory=Future)
    cancelled_at: float | None = None

    def report(self, message: Reported) -> None:
        try:
            if message.warning:
                self.progress.warn(message.message)
            else:
                self.progress(message.fraction, message.message, **message.numbers)
        except Cancelled:
            self._end_soon()

    def cancel(self) -> None:
        if self.future.cancel():
            # No other code will notify the callers.
            self.future.set_running_or_notify_cancel()
        else:
            self._end_soon()

    def _end_soon(self) -> None:
        if self.cancelled_at is None:
            self.cancelled_at = time.monotonic()

    def fail(self, error: BaseException) -> None:
        if not self.future.done():
            self.future.set_exception(error)


class Worker:
    """One process, its pipe and its task."""

    def __init__(self, context: Any, begin: tuple, cores: int, name: str):
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=serve, args=(theirs, begin, cores),
                                       name="limber pool")
        self.process.start()
        self.process_id = self.process.pid
        # From now on the pipe closes when either side ends.
        theirs.close()
        self.job: Job | None = None
        self.has_begun = False
        self._name = name
        self._watch: LimitWatch | None = None
        self._is_cancel_sent = False

    @property
    def is_idle(self) -> bool:
        return self.has_begun and self.job is None

    def give(self, job: Job) -> None:
        self.job, self._is_cancel_sent = job, False
        self._watch = LimitWatch(self._name, job.limits, self.process_id)
        try:
            self.pipe.send(job.task)
        except OSError:
            # It has just died; the next round notices this and fails the task.
            return
        except Exception as error:
            self.take_job().fail(error)

    def take_job(self) -> Job:
        job, self.job = present(self.job, "task"), None
        return job

    def broken(self) -> WorkError | None:
        """Return which limit the task has exceeded; None if none."""
        return self._watch.broken() if self._watch else None

    def cancel_once(self) -> None:
        if not self._is_cancel_sent:
            self._is_cancel_sent = True
            try:
                self.pipe.send(None)
            except OSError:
                return

    def kill(self) -> None:
        kill_tree(self.process_id)
        self.process.join()
        self.pipe.close()
        self.process.close()
