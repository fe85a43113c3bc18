"""Machines beyond this process, by Dask: a cluster started here, by a queue, or already running.

Stages are sent out as JSON, outcomes are returned; branch folders are where all machines see them.
Messages are encrypted and both ends are authenticated (TLS); only a scheduler that another user has
started on this computer may do without.
"""

import ipaddress
import shutil
from concurrent.futures import Future
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from limber.batch.job_file import JobFile
from limber.batch.stage_task import run_remotely, stop_stages, unfit
from limber.core.errors import Cancelled, InputError, Option, WorkError
from limber.core.not_none import present
from limber.core.optional import require_extra
from limber.core.processes import worker_count
from limber.core.processes.process_limits import CORES, core_budget
from limber.core.progress import Progress
from limber.stages.stage import Stage
from limber.version import VERSION

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
    """Runs tasks of a job file, within its limits for each stage, on a Dask cluster, in a ``with``:
    one of :data:`~limber.batch.job_file.CLUSTERS` with that many workers or queued jobs, or a
    scheduler's ``tls://HOST:PORT``, or ``tcp://`` on loopback; ``progress`` reports the wait for
    the first worker. InputError for an unsafe address, or no number of jobs; MissingDependencyError
    without Dask; WorkError if it does not start, or a worker cannot run the tasks; Cancelled before
    one came."""

    def __init__(self, jobs: JobFile, kind: str | None = None, *, address: str | None = None,
                 workers: int | None = None, progress: Progress):
        packages = ("distributed", "cryptography", *(["dask_jobqueue"] if kind in _QUEUES else []))
        require_extra("cluster", packages, "A batch on a cluster")
        self._limits, self._directory = jobs.limits, str(Path.cwd())
        self._requested = workers
        self._is_cancelled = False
        with ExitStack() as stack:
            self._client = stack.enter_context(self._connected(stack, jobs, kind, address))
            self._wait(kind or present(address, "kind of cluster"), progress)
            self._closing = stack.pop_all()

    @property
    def count(self) -> int:
        """Number of tasks to run at a time."""
        return self._requested or max(sum(self._client.nthreads().values()), 1)

    def submit(self, task: Stage, folder: Path) -> Future:
        """Submit a task; its future holds the result of :func:`~limber.batch.stage_task.run_task`.
        If a worker is lost, another runs this stage again."""
        from distributed.utils import TimeoutError as NoAnswer

        future: Future = Future()
        future.set_running_or_notify_cancel()
        try:
            remote = self._client.submit(
                run_remotely, task.about.name, task.stated(), self._directory, str(folder),
                self._limits, VERSION, pure=False)
        except (OSError, NoAnswer) as error:
            raise _lost(error) from error
        remote.add_done_callback(partial(self._pass_on, future))
        return future

    def cancel(self) -> None:
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
        for worker, reason in self._client.run(_unfit_here, VERSION).items():
            if reason:
                raise WorkError(f"The worker {worker} cannot run this batch: {reason}.", "", "")


def _unfit_here(version: str) -> str:
    return unfit(version)


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
