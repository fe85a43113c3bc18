"""Where the tasks of a batch run: a process of a pool, or machines that Dask reaches.

A Dask cluster is started here, by a queue, or already running. Stages are sent out as JSON, their
records are returned; branch folders are where all machines see them. Messages are encrypted and
both ends are authenticated (TLS); only a scheduler that another user has started on this computer
may do without.
"""

import ipaddress
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing import current_process
from pathlib import Path
from typing import Any

from limber.batch.batch_progress import DONE, FAILED, KEPT, Record, numbers_of
from limber.batch.job_file import JobFile
from limber.core.errors import (
    BranchBusyError,
    Cancelled,
    InputError,
    LimberError,
    Option,
    WorkError,
)
from limber.core.json_values import plain
from limber.core.machine_errors import machine_error
from limber.core.not_none import present
from limber.core.optional import require_extra
from limber.core.processes import Limits, Pool, worker_count
from limber.core.processes.process_limits import CORES, core_budget, memory_mb
from limber.core.progress import Progress
from limber.stages.registry import stage_class
from limber.stages.stage import Stage
from limber.store.manifest import read_manifest
from limber.version import VERSION

_SAMPLE_SECONDS = 0.2


def run_task(task: Stage, folder: Path, progress: Progress) -> Record:
    """Run a stage; return its record, also if it failed: KEPT if the branch had the result from
    this input and settings. BranchBusyError if another program writes to the branch; Cancelled."""
    warnings: list[str] = []
    before, started = _finished(task, folder), time.perf_counter()
    error, result = "", {}
    with _most_memory() as most_mb:
        try:
            result = plain(task.run(progress.keeping(warnings)))
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
        time.sleep(_TICK_SECONDS)


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
