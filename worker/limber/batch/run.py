"""Runs a job file: branches side by side, the stages of each one after the other, in processes of
this computer or on machines that Dask reaches."""

import ipaddress
import logging
import os
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from functools import partial
from multiprocessing import current_process
from pathlib import Path
from threading import Event
from typing import Any

from limber.batch.batch_progress import (
    DONE,
    FAILED,
    KEPT,
    RUNNING,
    Record,
    Records,
    log_of,
    numbers_of,
    tell,
)
from limber.batch.job_file import BranchJob, JobFile
from limber.batch.staging import AT_ONCE, bring_in, put_out
from limber.core.errors import (
    BranchBusyError,
    Cancelled,
    Command,
    InputError,
    LimberError,
    Option,
    WorkError,
)
from limber.core.json_values import plain, stored
from limber.core.machine_errors import machine_error
from limber.core.not_none import present
from limber.core.optional import require_extra
from limber.core.processes import Limits, Pool, worker_count
from limber.core.processes.process_limits import CORES, core_budget, memory_mb
from limber.core.progress import SILENT, Progress
from limber.stages.registry import stage_class
from limber.stages.stage import Stage
from limber.store.manifest import read_manifest
from limber.version import VERSION

# Where the tasks of a batch run: a process of a pool, or machines that Dask reaches.
#
# A Dask cluster is started here, by a queue, or already running. Stages are sent out as JSON,
# their records are returned; branch folders are where all machines see them. Messages are
# encrypted and both ends are authenticated (TLS); only a scheduler that another user has started
# on this computer may do without.

_SAMPLE_SECONDS = 0.2


def run_task(task: Stage, folder: Path, progress: Progress) -> Record:
    """Run a stage; return its record, also if it failed: KEPT if the branch had the result from
    this input and settings. BranchBusyError if another program writes to the branch; Cancelled."""
    warnings: list[str] = []
    before, started = _finished(task, folder), time.perf_counter()
    error, result = "", {}
    with _most_memory() as most_mb:
        try:
            result = stored(plain(task.run(progress.keeping(warnings))))
        except (BranchBusyError, Cancelled):
            raise
        except LimberError as failure:
            error = str(failure)
        except (OSError, MemoryError) as failure:
            translated = machine_error(failure, folder)
            if translated is None:
                raise
            error = str(translated)
    is_kept = before is not None and before == _finished(task, folder)
    return Record(FAILED if error else KEPT if is_kept else DONE, error,
                  round(time.perf_counter() - started, 3), round(most_mb[0], 1), tuple(warnings),
                  numbers_of(result), _content(task, folder))


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


@contextmanager
def _most_memory() -> Iterator[list[float]]:
    """Keep the largest memory [MB] of this process and its children meanwhile."""
    most, closing = [0.0], threading.Event()

    def watch() -> None:
        while True:
            most[0] = max(most[0], memory_mb(os.getpid()))
            if closing.wait(_SAMPLE_SECONDS):
                return
    watcher = threading.Thread(target=watch, name="memory watch", daemon=True)
    watcher.start()
    try:
        yield most
    finally:
        closing.set()
        watcher.join()


# The work of a Dask worker for a batch: it runs stages in processes of its own pool.
#
# Crash, memory and time are then confined to the stage, and imported modules remain for the next
# one. A lost worker takes its processes with it.

_BUSY_SECONDS = 600.0
"""Time that a stage waits for a branch: a worker that was taken for lost may still finish it."""
_BUSY_TICK_SECONDS = 1.0

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


def run_remotely(function: Callable[..., Record], name: str, stated: dict[str, Any],
                 directory: str, folder: str, limits: Limits, version: str) -> Record:
    """Run a stage with values as of :meth:`limber.stages.stage.Stage.stated`, paths relative to
    ``directory``, by :func:`run_task` in a process of this worker's pool, within limits on time and
    memory, for a batch of this version. WorkError if it crashed or exceeded them, or the worker
    cannot run it; Cancelled if the batch was."""
    if reason := unfit(version):
        raise WorkError(f"The worker {os.getpid()} cannot run this stage: {reason}.")
    return _workers_pool().submit(_run, function, name, stated, directory, folder,
                                  limits=limits).result()


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


def _run(function: Callable[..., Record], name: str, stated: dict[str, Any], directory: str,
         folder: str, progress: Progress) -> Record:
    # Paths are relative to the start folder of the batch, on every machine.
    os.chdir(directory)
    task = stage_class(name).checked(stated)
    end = time.monotonic() + _BUSY_SECONDS
    while True:
        try:
            return function(task, Path(folder), progress)
        except BranchBusyError:
            if time.monotonic() > end:
                raise
        progress(0.0, "waiting for the branch")
        time.sleep(_BUSY_TICK_SECONDS)


# The cluster, as the batch sees it.

_QUEUES = {"slurm": "SLURMCluster", "pbs": "PBSCluster", "lsf": "LSFCluster", "sge": "SGECluster",
          "oar": "OARCluster", "moab": "MoabCluster", "htcondor": "HTCondorCluster"}
"""Queues and the names of their clusters in dask-jobqueue."""
_LOOPBACK = "127.0.0.1"
_NO_DAEMON = {"distributed.worker.daemon": False}
"""A worker starts processes of its own, which Dask's workers are not allowed otherwise."""
_UNSERVED: dict[str, list[str]] = {
    "distributed.scheduler.http.routes": [], "distributed.worker.http.routes": []}
"""Dask's pages are not needed."""
_NOT_OBSERVED = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "2s",
}
"""Nor is the profiling of Dask's own processes, which takes some of the stages' time."""
_WAIT_SECONDS = 0.5
_MEMORY_MB = 4000.0
"""The memory requested for a job if neither the job file nor Dask's settings state it."""


class ClusterLostError(WorkError):
    """The scheduler no longer responds; completed results are kept."""


class Cluster:
    """Runs tasks of a job file as a pool does, on a Dask cluster, in a ``with``:
    one of :data:`~limber.batch.job_file.CLUSTERS` with that many workers or queued jobs, or a
    scheduler's ``tls://HOST:PORT``, or ``tcp://`` on loopback; ``progress`` reports the wait for
    the first worker. InputError for an unsafe address, or no number of jobs; MissingDependencyError
    without Dask; WorkError if it does not start, or a worker cannot run the tasks; Cancelled before
    one came."""

    def __init__(self, jobs: JobFile, kind: str | None = None, *, address: str | None = None,
                 workers: int | None = None, progress: Progress):
        packages = ("distributed", "cryptography", *(["dask_jobqueue"] if kind in _QUEUES else []))
        require_extra("cluster", packages, "A batch on a cluster")
        self._directory = str(Path.cwd())
        self._requested, self._is_cancelled = workers, False
        with ExitStack() as stack:
            self._client = stack.enter_context(self._connected(stack, jobs, kind, address))
            self._wait(kind or present(address, "kind of cluster"), progress)
            self._closing = stack.pop_all()

    @property
    def worker_count(self) -> int:
        """Number of tasks to run at a time."""
        return self._requested or max(sum(self._client.nthreads().values()), 1)

    def submit(self, function: Callable[..., Record], task: Stage, folder: Path, *,
               limits: Limits) -> Future:
        """Submit ``function(task, folder)``, as to a pool. If a worker is lost, another runs it
        again."""
        from distributed.utils import TimeoutError as NoAnswer

        future: Future = Future()
        future.set_running_or_notify_cancel()
        try:
            remote = self._client.submit(
                run_remotely, function, task.about.name, task.stated(), self._directory,
                str(folder), limits, VERSION, pure=False)
        except (OSError, NoAnswer) as error:
            raise _lost(error) from error
        remote.add_done_callback(partial(self._pass_on, future))
        return future

    def cancel(self, **_waiting: bool) -> None:
        """Stop all tasks and their child processes."""
        self._is_cancelled = True
        self._client.cancel(list(self._client.futures.values()), force=True)
        self._client.run(stop_stages, on_error="ignore")

    def __enter__(self) -> "Cluster":
        return self

    def __exit__(self, *_error: object) -> None:
        self._closing.close()

    def _pass_on(self, future: Future, remote: Any) -> None:
        from distributed import KilledWorker

        if remote.cancelled():
            future.set_exception(Cancelled() if self._is_cancelled else _lost(None))
            return
        error = remote.exception()
        if isinstance(error, KilledWorker):
            error = WorkError(
                "Every worker that ran this stage was lost.",
                "The stage or another program on those machines exceeded their memory "
                "or time, or the machines failed.",
                "See the queue's logs, and request more memory or time in Dask's settings.")
        if error is not None:
            future.set_exception(error)
        else:
            future.set_result(remote.result())

    def _connected(self, stack: ExitStack, jobs: JobFile, kind: str | None,
                   address: str | None) -> Any:
        """Return a client of the cluster, which is closed with ``stack``."""
        import dask
        from distributed import Client

        if address is not None:
            _check_address(address)
            try:
                return Client(address, timeout="20s", set_as_default=False)
            except (OSError, ValueError, TypeError) as error:
                raise WorkError(f"No Dask scheduler responds at {address} ({error}).", "",
                                "Start `dask scheduler` and `dask worker --no-nanny`, with the "
                                "same certificates in Dask's settings on all machines.") from error
        # As long as the cluster exists: it may restart a lost worker.
        stack.enter_context(dask.config.set(_NO_DAEMON | _UNSERVED | _NOT_OBSERVED))
        cluster = stack.enter_context(
            self._local(jobs) if kind == "local"
            else self._queue(present(kind, "kind of cluster"), jobs))
        return Client(cluster, security=cluster.security, set_as_default=False)

    def _local(self, jobs: JobFile) -> Any:
        from distributed import LocalCluster
        from distributed.security import Security

        self._requested = worker_count(len(jobs.branches), requested=self._requested
                                       or jobs.workers)
        cores = max(core_budget() // self._requested, 1)
        return LocalCluster(
            n_workers=self._requested, threads_per_worker=1, processes=True, memory_limit=0,
            host=_LOOPBACK, protocol="tls://", security=Security.temporary(),
            dashboard_address=f"{_LOOPBACK}:0", worker_dashboard_address=f"{_LOOPBACK}:0",
            scheduler_kwargs={"dashboard": False}, env={CORES: str(cores)}, silence_logs="CRITICAL")

    def _queue(self, kind: str, jobs: JobFile) -> Any:
        import dask
        import dask_jobqueue

        self._requested = self._requested or jobs.workers
        if self._requested is None:
            raise InputError(f"The number of jobs to request from {kind} is not given.",
                             "Each job waits in the queue and uses its allocation.",
                             "Give ", Option("workers"), " N, or `workers = N` in the job file.")
        made = getattr(dask_jobqueue, _QUEUES[kind])
        submitter = made.job_cls.submit_command
        if shutil.which(submitter) is None:
            raise InputError(f"The program {submitter} is not on this computer.", "It is needed to "
                             f"submit jobs to {kind}.", "Run the batch on a login node of the "
                             "cluster, or with ", Option("emit"), ".")
        own = dask.config.get(f"jobqueue.{kind}", {})
        cores = int(own.get("cores") or 1)
        prologue = [*(own.get("job-script-prologue") or ()),
                    "export DASK_DISTRIBUTED__WORKER__DAEMON=False", f"export {CORES}={cores}"]
        memory = own.get("memory") or f"{cores * (jobs.limits.memory_mb or _MEMORY_MB):.0f}MB"
        try:
            # One worker per job, with one thread per stage that it may run at a time.
            cluster = made(
                cores=cores, processes=1, memory=memory, security=True, protocol="tls://",
                shared_temp_directory=str(jobs.out.resolve()), job_script_prologue=prologue,
                worker_extra_args=[*(own.get("worker-extra-args") or ()),
                                   "--dashboard-address", f"{_LOOPBACK}:0"],
                scheduler_options={"dashboard_address": f"{_LOOPBACK}:0", "dashboard": False})
        except (OSError, RuntimeError, ValueError) as error:
            raise WorkError(f"The cluster of {kind} could not be started: {error}", "",
                            f"Its settings are Dask's own (jobqueue.{kind}).") from error
        # An expired allocation is requested again.
        cluster.adapt(minimum_jobs=self._requested, maximum_jobs=self._requested)
        self._requested *= cores
        return cluster

    def _wait(self, name: str, progress: Progress) -> None:
        """Wait for a worker, and check the version of those that are connected."""
        while not self._client.nthreads():
            progress(0.0, f"waiting for the first worker of {name}")
            try:
                self._client.wait_for_workers(1, timeout=_WAIT_SECONDS)
            except TimeoutError:
                continue
        for worker, reason in self._client.run(unfit, VERSION).items():
            if reason:
                raise WorkError(f"The worker {worker} cannot run this batch: {reason}.", "", "")


def _lost(error: Exception | None) -> ClusterLostError:
    cause = f" ({error})" if error is not None else ""
    return ClusterLostError(f"The Dask scheduler no longer responds{cause}.",
                            "Completed results are kept. A branch that was in work has its state "
                            "before or after the running stage.",
                            "Run the batch again. It continues from there.")


def _check_address(address: str) -> None:
    """Only encrypted data leaves this computer: whoever reaches a worker can run programs."""
    protocol, _, rest = address.partition("://")
    host = rest.rpartition(":")[0].strip("[]")
    if protocol not in ("tls", "tcp") or not host:
        raise InputError(f"{address!r} is not the address of a Dask scheduler.", "",
                         "Write tls://HOST:PORT, as `dask scheduler` prints it.")
    if protocol == "tls" or host == "localhost":
        return
    try:
        is_here = ipaddress.ip_address(host).is_loopback
    except ValueError:
        is_here = False
    if not is_here:
        raise InputError(f"{address} is not encrypted.",
                         "Whoever can write to a Dask worker can run programs on it.",
                         "Give scheduler, workers and this computer certificates "
                         "(distributed.comm.tls in Dask's settings), and write tls://.")


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
