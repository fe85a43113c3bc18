"""Runs a job file: branches side by side, the stages of each one after the other."""

import logging
import time
from collections import deque
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

from limber.batch.batch_progress import FAILED, KEPT, RUNNING, Record, Records, log_of, tell
from limber.batch.job_file import BranchJob, JobFile
from limber.batch.machines import Cluster, ClusterLostError, is_shown, run_task
from limber.batch.staging import AT_ONCE, bring_in, put_out
from limber.core.errors import Cancelled, Command, LimberError, WorkError
from limber.core.processes import Pool, worker_count
from limber.core.progress import SILENT, Progress
from limber.stages.stage import Stage
from limber.version import VERSION

_TICK_SECONDS = 0.2
_FETCH = -1
"""Before a branch's first task its inputs are fetched from their addresses."""
_MEMORY_MB_EACH = 1000.0
"""Memory of a stage; the pool starts no more processes than memory allows."""


def run_jobs(jobs: JobFile, records: Records, *, retry_failed: bool = False,
             workers: int | None = None, cluster: str | None = None,
             scheduler: str | None = None, progress: Progress = SILENT) -> None:
    """Run the tasks that are not up to date; a failure ends only its own branch, and is tried again
    only with ``retry_failed``. ``records`` gets each outcome; ``workers``: most parallel branches,
    or jobs of a queue, by default the file's or the core budget; ``cluster``: one of
    :data:`limber.batch.job_file.CLUSTERS`, by default the file's, or this process's own pool, or a
    Dask ``scheduler``. Cancelled if ``progress`` was, finished results stay; WorkError if the
    cluster was not available, or lost."""
    jobs.out.mkdir(parents=True, exist_ok=True)
    kind = None if scheduler else cluster or jobs.cluster
    with records.writing(), (
            Cluster(jobs, kind, address=scheduler, workers=workers, progress=progress)
            if kind or scheduler else Pool(
                worker_count(len(jobs.branches), requested=workers or jobs.workers,
                             memory_mb_each=_MEMORY_MB_EACH),
                name="a stage of the batch")) as machines, closing(log_of(jobs)) as log:
        _Course(jobs, records, machines, log, progress, retry_failed=retry_failed).run()


class _Course:
    """Runs the tasks of all branches; each branch may be fetched before and uploaded after, in
    threads."""

    def __init__(self, jobs: JobFile, records: Records, machines: Cluster | Pool,
                 log: logging.Handler, progress: Progress, *, retry_failed: bool):
        self.jobs, self.records, self.machines, self.progress = jobs, records, machines, progress
        self.log, self.retry_failed = log, retry_failed
        self.transfers, self.closing = ThreadPoolExecutor(AT_ONCE, "staging"), Event()
        self.waiting = deque(jobs.branches)
        self.running: dict[Future, tuple[BranchJob, int, float]] = {}
        self.earlier: dict[Future, Record] = {}
        self.ended = 0
        self.identity = _identity(jobs.out)
        # Some are transferred while others are computed.
        self.ahead = AT_ONCE if any(branch.is_moved for branch in jobs.branches) else 0

    def run(self) -> None:
        total = max(len(self.jobs.branches), 1)
        started = time.monotonic()
        self.tell(f"{self.jobs.path.name}: {len(self.jobs.branches)} branches, Limber {VERSION}")
        try:
            while self.waiting or self.running:
                # A branch is completed before another is started, so results come early.
                while self.waiting and len(self.running) < self.machines.worker_count + self.ahead:
                    self.begin(self.waiting.popleft())
                done, _ = wait(self.running, _TICK_SECONDS, FIRST_COMPLETED)
                for future in done:
                    self.take(future)
                self.report(total, time.monotonic() - started)
        except BaseException as error:
            self.machines.cancel(wait_for_end=True)
            self.tell(f"stopped: {error!r}")
            raise
        finally:
            self.closing.set()
            self.transfers.shutdown(cancel_futures=True)
        self.tell(f"{self.ended} branches ended in {time.monotonic() - started:.0f} s")

    def report(self, total: int, seconds: float) -> None:
        numbers: dict[str, Any] = {"branches_done": self.ended}
        if self.ended and seconds > 1:
            numbers["remaining_s"] = round(seconds * (total - self.ended) / self.ended)
        at = ", ".join(f"{branch.name} {_step(branch, number)}"
                       for branch, number, _ in list(self.running.values())[:3])
        self.progress(self.ended / total, at, **numbers)

    def begin(self, branch: BranchJob) -> None:
        """Fetch a branch, or run its first task."""
        if not branch.is_moved or self.is_given_up(branch, 0):
            self.submit(branch, 0)
        else:
            future = self.transfers.submit(bring_in, branch, self.stop_transfer)
            self.running[future] = branch, _FETCH, time.monotonic()

    def stop_transfer(self) -> None:
        if self.closing.is_set():
            raise Cancelled

    def is_given_up(self, branch: BranchJob, number: int) -> bool:
        """Whether a task has failed before and is not to be tried again."""
        failed = self.records.of(branch, branch.tasks[number]).status == FAILED
        return failed and not self.retry_failed

    def submit(self, branch: BranchJob, number: int) -> None:
        """Run the branch's task of this number, or end the branch."""
        if number == len(branch.tasks):
            self.end(branch)
            return
        if self.is_given_up(branch, number):
            self.ended += 1
            return
        self.require_same_folder()
        task = branch.tasks[number]
        record = self.records.of(branch, task)
        if record.has_succeeded and is_shown(task, branch.folder, record.content):
            self.records.end(branch, task, replace(record, status=KEPT))
            self.submit(branch, number + 1)
            return
        self.records.begin(branch, task)
        future = self.machines.submit(run_task, task, branch.folder, limits=self.jobs.limits)
        self.earlier[future] = record
        self.running[future] = branch, number, time.monotonic()

    def require_same_folder(self) -> None:
        """Stop if the folder of results was lost: a new one would hide its content."""
        try:
            is_there = _identity(self.jobs.out) == self.identity
        except OSError:
            is_there = False
        if not is_there:
            raise WorkError(f"{self.jobs.out} no longer exists.",
                            "Results and records are written there. It was moved, or its disk or "
                            "network folder was lost.",
                            "Restore it and run this again. Stored results are kept.")

    def end(self, branch: BranchJob) -> None:
        """Upload the results of a branch, or count it as ended."""
        if branch.home or self.jobs.home:
            future = self.transfers.submit(put_out, self.jobs, branch)
            self.running[future] = branch, len(branch.tasks), time.monotonic()
        else:
            self.ended += 1

    def take(self, future: Future) -> None:
        branch, number, since = self.running.pop(future)
        if number in (_FETCH, len(branch.tasks)):
            self.moved(future, branch, number, time.monotonic() - since)
            return
        task = branch.tasks[number]
        record, earlier = (self.outcome(future, branch, time.monotonic() - since),
                           self.earlier.pop(future))
        is_kept = record.status == KEPT and earlier.has_succeeded
        # Warnings and cost are those of the run that made it.
        self.records.end(branch, task, replace(earlier, status=KEPT, numbers=record.numbers)
                         if is_kept else record)
        self.tell(branch.name, task.label, f"{record.status} after {record.seconds or 0:.1f} s",
                      f"with {record.memory_mb:.0f} MB" if record.memory_mb else "")
        for warning in record.warnings:
            self.warn(f"{branch.name} {task.label}: {warning}")
        if record.has_succeeded:
            self.submit(branch, number + 1)
        else:
            self.warn(f"{branch.name} {task.label} failed: {record.error}")
            self.end(branch)

    def warn(self, message: str) -> None:
        self.progress.warn(message)
        self.tell(message)

    def tell(self, *parts: str) -> None:
        tell(self.log, *parts)

    def moved(self, future: Future, branch: BranchJob, number: int, seconds: float) -> None:
        """Continue after a branch was fetched, or end with it; a failure counts for the next task,
        or the last."""
        try:
            future.result()
        except LimberError as error:
            if isinstance(error, Cancelled):
                raise
            task = branch.tasks[0 if number == _FETCH else -1]
            reason = f"{_step(branch, number)}: {error}"
            self.warn(f"{branch.name} {reason}")
            if self.records.of(branch, task).status != FAILED:
                self.records.end(branch, task, Record(FAILED, reason, round(seconds, 3)))
            self.ended += 1
            return
        if number == _FETCH:
            self.submit(branch, 0)
        else:
            self.ended += 1

    def outcome(self, future: Future, branch: BranchJob, seconds: float) -> Record:
        try:
            return future.result()
        except (Cancelled, ClusterLostError):
            raise
        except LimberError as error:
            # It crashed, or exceeded its limits: the pool states it.
            return Record(FAILED, str(error), round(seconds, 3))
        except Exception as error:
            # A bug in a stage of Limber: it costs this branch, not the whole batch.
            notes = " ".join(getattr(error, "__notes__", ()))
            report = Command("bug-report", str(branch.folder))
            return Record(FAILED, f"internal error: {error!r}; please report it ({report}). "
                          f"{notes}", round(seconds, 3))


def _identity(folder: Path) -> tuple[int, int]:
    about = folder.stat()
    return about.st_dev, about.st_ino


def _step(branch: BranchJob, number: int) -> str:
    if number == _FETCH:
        return "fetching"
    return branch.tasks[number].label if number < len(branch.tasks) else "putting"


def plan_of(jobs: JobFile, records: Records, *, retry_failed: bool = False,
            ) -> list[tuple[BranchJob, Stage, str]]:
    """Return what a run would do: each branch's tasks, in order, and their status."""
    found = []
    for branch in jobs.branches:
        stopped = ""
        for task in branch.tasks:
            record = records.of(branch, task)
            if stopped:
                state = stopped
            elif record.status == FAILED and not retry_failed:
                state, stopped = "not repeated: it failed (--retry-failed)", "not reached"
            elif record.status == RUNNING:
                state = "running"
            elif record.has_succeeded:
                state = "done earlier; runs again if its input has changed"
            else:
                state = "to run" if record.status != FAILED else "to try again"
            found.append((branch, task, state))
    return found
