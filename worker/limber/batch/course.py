"""Runs a job file: branches side by side, the stages of each one after the other."""

import time
from collections import deque
from concurrent.futures import FIRST_COMPLETED, Future, wait
from pathlib import Path
from typing import Any, Protocol

from limber.batch.cluster import Cluster, ClusterLostError
from limber.batch.job_file import BranchJob, JobFile, StageTask
from limber.batch.records import DONE, FAILED, KEPT, RUNNING, Record, Records, numbers_of
from limber.batch.task import run_task
from limber.errors import Cancelled, LimberError
from limber.jobs import Pool, worker_count
from limber.progress import SILENT, Progress

_TICK_SECONDS = 0.2
_MEMORY_MB_EACH = 1000.0
"""What a stage may need; the pool starts no more processes than memory has room for."""


def run_jobs(jobs: JobFile, records: Records, *, retry_failed: bool = False,
             workers: int | None = None, cluster: str | None = None,
             scheduler: str | None = None, progress: Progress = SILENT) -> None:
    """Run what is not up to date; a failure ends its own branch alone.

    What has failed before, with the same settings, is run again only with ``retry_failed``. Each
    stage looks for itself whether the branch has its result already.

    Args:
        jobs: The checked job file.
        records: Take in how each task ends, as it happens.
        retry_failed: Try again what has failed.
        workers: At most so many branches side by side; by default the file's, or the core budget.
            On a queue's cluster: how many jobs to ask for.
        cluster: Where, as one of :data:`limber.batch.job_file.CLUSTERS`; by default the file's, or
            this process's own pool.
        scheduler: Address of a Dask scheduler to use instead.
        progress: Cancelling it stops all; what was done stays.

    Raises:
        Cancelled: it was cancelled.
        WorkError: the cluster could not be had, or was lost.
    """
    jobs.out.mkdir(parents=True, exist_ok=True)
    kind = None if scheduler else cluster or jobs.cluster
    with records.writing(), (
            Cluster(jobs, kind, address=scheduler, workers=workers, progress=progress)
            if kind or scheduler else _ThisProcess(jobs, workers)) as machines:
        _Course(jobs, records, machines, progress, retry_failed=retry_failed).run()


class Machines(Protocol):
    """Where tasks are run: so many at a time, stopped all at once."""

    @property
    def count(self) -> int: ...

    def submit(self, task: StageTask, folder: Path) -> Future: ...

    def cancel(self) -> None: ...


class _ThisProcess:
    """The pool of this process."""

    def __init__(self, jobs: JobFile, workers: int | None):
        self.count = worker_count(len(jobs.branches), wanted=workers or jobs.workers,
                                  memory_mb_each=_MEMORY_MB_EACH)
        self._limits = jobs.limits
        self._pool = Pool(self.count, name="a stage of the batch")

    def submit(self, task: StageTask, folder: Path) -> Future:
        return self._pool.submit(run_task, task, folder, limits=self._limits)

    def cancel(self) -> None:
        self._pool.cancel(wait_for_end=True)

    def __enter__(self) -> "_ThisProcess":
        return self

    def __exit__(self, *_error: object) -> None:
        self._pool.close()


class _Course:
    def __init__(self, jobs: JobFile, records: Records, machines: Machines, progress: Progress, *,
                 retry_failed: bool):
        self.jobs, self.records, self.machines, self.progress = jobs, records, machines, progress
        self.retry_failed = retry_failed
        self.waiting = deque(jobs.branches)
        self.running: dict[Future, tuple[BranchJob, int, float]] = {}
        self.ended = 0

    def run(self) -> None:
        total = max(len(self.jobs.branches), 1)
        started = time.monotonic()
        try:
            while self.waiting or self.running:
                # A branch is brought to its end before another is begun: results come early.
                while self.waiting and len(self.running) < self.machines.count:
                    self.submit(self.waiting.popleft(), 0)
                done, _ = wait(self.running, _TICK_SECONDS, FIRST_COMPLETED)
                for future in done:
                    self.take(future)
                self.report(total, time.monotonic() - started)
        except BaseException:
            self.machines.cancel()
            raise

    def report(self, total: int, seconds: float) -> None:
        numbers: dict[str, Any] = {"branches_done": self.ended}
        if self.ended and seconds > 1:
            numbers["remaining_s"] = round(seconds * (total - self.ended) / self.ended)
        at = ", ".join(f"{branch.name} {branch.tasks[number].label}"
                       for branch, number, _ in list(self.running.values())[:3])
        self.progress(self.ended / total, at, **numbers)

    def submit(self, branch: BranchJob, number: int) -> None:
        """Have the branch's task of this number run, or end the branch."""
        if number == len(branch.tasks):
            self.ended += 1
            return
        task = branch.tasks[number]
        before = self.records.of(branch, task)
        if before.status == FAILED and not self.retry_failed:
            self.ended += 1
            return
        self.records.begin(branch, task)
        future = self.machines.submit(task, branch.folder)
        self.running[future] = branch, number, time.monotonic()

    def take(self, future: Future) -> None:
        branch, number, since = self.running.pop(future)
        task = branch.tasks[number]
        record = self.outcome(future, time.monotonic() - since)
        self.records.end(branch, task, record)
        for warning in record.warnings:
            self.progress.warn(f"{branch.name} {task.label}: {warning}")
        if record.has_succeeded:
            self.submit(branch, number + 1)
        else:
            self.progress.warn(f"{branch.name} {task.label} failed: {record.error}")
            self.ended += 1

    def outcome(self, future: Future, seconds: float) -> Record:
        try:
            told = future.result()
        except (Cancelled, ClusterLostError):
            raise
        except LimberError as error:
            # It crashed, or went over its limits: the pool says so.
            return Record(FAILED, str(error), round(seconds, 3))
        except Exception as error:
            # A bug of ours in a stage: it costs this branch, not the night's work.
            notes = " ".join(getattr(error, "__notes__", ()))
            return Record(FAILED, f"internal error: {error!r}; please report it. {notes}",
                          round(seconds, 3))
        status = FAILED if told["error"] else KEPT if told["is_kept"] else DONE
        return Record(status, told["error"], told["seconds"], told["memory_mb"],
                      tuple(told["warnings"]), numbers_of(told["result"]))


def plan_of(jobs: JobFile, records: Records, *, retry_failed: bool = False,
            ) -> list[tuple[BranchJob, StageTask, str]]:
    """Return what a run would do: each branch's tasks, in order, and what comes of them."""
    found = []
    for branch in jobs.branches:
        stopped = ""
        for task in branch.tasks:
            record = records.of(branch, task)
            if stopped:
                told = stopped
            elif record.status == FAILED and not retry_failed:
                told, stopped = "not again: it failed (--retry-failed)", "not reached"
            elif record.status == RUNNING:
                told = "running"
            elif record.has_succeeded:
                told = "done before; runs again if its input has changed"
            else:
                told = "to run" if record.status != FAILED else "to try again"
            found.append((branch, task, told))
    return found
