"""A process pool for all parallel computation.

Python's own pool breaks as a whole when one process is killed. In other pools the processes share a
pipe, and a process killed in the middle of a message corrupts it for all. Here each process has its
own pipe for tasks, progress, cancelling and results. A process may be killed at any moment, because
of time, memory or a crash, and only its task fails.
"""

import atexit
import inspect
import os
import queue
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, wait
from dataclasses import dataclass, field
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for_any
from threading import Event, Lock, Thread
from typing import Any

from limber.core.errors import Cancelled, LimberError, WorkError
from limber.core.not_none import present
from limber.core.processes.end_with_parent import end_by_kernel
from limber.core.processes.process_limits import (
    CORES,
    UNLIMITED,
    Limits,
    LimitWatch,
    core_budget,
    kill_tree,
    worker_count,
)
from limber.core.progress import SILENT, Progress

# Main loop of a pool process: it takes tasks from its pipe until the pipe closes.

_REPORT_SECONDS = 0.05


@dataclass(frozen=True)
class Task:
    """A function and its arguments."""

    function: Callable
    arguments: tuple

    def run(self, progress: Progress) -> Any:
        """Call it; a function that takes ``progress`` gets this one."""
        if "progress" in inspect.signature(self.function).parameters:
            return self.function(*self.arguments, progress=progress)
        return self.function(*self.arguments)


@dataclass(frozen=True)
class Began:
    """The process is ready for tasks."""


@dataclass(frozen=True)
class Reported:
    """Progress of a task, or a warning."""

    fraction: float
    message: str
    numbers: dict[str, Any] = field(default_factory=dict)
    warning: bool = False


@dataclass(frozen=True)
class Returned:
    """A task's result."""

    value: Any


@dataclass(frozen=True)
class Failed:
    """A task's error; before any task, the error of the pool's ``begin``."""

    error: BaseException


def serve(pipe: Connection, begin: tuple[Callable | None, tuple], cores: int) -> None:
    """Execute the tasks that come over ``pipe`` (None cancels the current one), and send progress
    and results; ends when it closes, with parent or pool. ``begin``: a function to call first, and
    its arguments; ``cores``: this process's part of the budget."""
    # Ctrl-C reaches the whole process group; the parent ends this process in order.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ[CORES] = str(cores)
    parent = parent_process()
    if parent is not None and parent.pid is not None:
        end_by_kernel(parent.pid)
    tasks: queue.SimpleQueue[Task] = queue.SimpleQueue()
    voice = _Voice(pipe)
    threading.Thread(target=_receive, args=(pipe, tasks, voice), daemon=True).start()
    try:
        if begin[0] is not None:
            begin[0](*begin[1])
    except BaseException as error:
        voice.say(Failed(_sendable(error)))
        return
    voice.say(Began())
    while True:
        task = tasks.get()
        try:
            voice.say(Returned(task.run(voice.progress)))
        except BaseException as error:
            voice.say(Failed(_sendable(error)))


class _Voice:
    """Sends over the pipe; progress of a task goes through it, and it can cancel the task."""

    def __init__(self, pipe: Connection):
        self._pipe = pipe
        self._guard = threading.Lock()
        self._reported_at = 0.0
        self.fresh()

    def fresh(self) -> None:
        """Make a progress for the next task, not cancelled."""
        self.progress = Progress(self._report, self._warn)

    def say(self, message: object) -> None:
        try:
            with self._guard:
                self._pipe.send(message)
        except OSError:
            # There is no receiver any more.
            os._exit(1)

    def _report(self, fraction: float, message: str, numbers: dict[str, Any]) -> None:
        now = time.monotonic()
        if now - self._reported_at >= _REPORT_SECONDS or fraction >= 1.0:
            self._reported_at = now
            self.say(Reported(fraction, message, numbers))

    def _warn(self, message: str) -> None:
        self.say(Reported(0.0, message, warning=True))


def _receive(pipe: Connection, tasks: "queue.SimpleQueue[Task]", voice: _Voice) -> None:
    while True:
        try:
            message = pipe.recv()
        except (EOFError, OSError):
            # The parent ended or closed the pool: no work here needs to be finished.
            os._exit(0)
        except Exception as error:
            # A task that cannot be unpickled here.
            voice.say(Failed(_sendable(error)))
            continue
        if message is None:
            voice.progress.cancel()
        else:
            voice.fresh()
            tasks.put(message)


def _sendable(error: BaseException) -> BaseException:
    """Return the error in a form that can be sent; a bug has its traceback as a note."""
    import pickle

    if not isinstance(error, LimberError):
        error.add_note("In a process of the pool:\n" + "".join(traceback.format_exception(error)))
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301 (bytes of this very process)
    except Exception:
        return WorkError(f"A process of the pool failed: {error!r}.",
                         "".join(traceback.format_exception(error)))
    return error if isinstance(error, Exception) else WorkError(f"A process was ended: {error!r}.")


# A process of the pool as seen by the pool, and the pending tasks.


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


_TICK_SECONDS = 0.1
_GRACE_SECONDS = 3.0
"""Time until a cancelled task must make its next report before its process is killed."""


class Pool:
    """Processes that compute tasks, by default one for each core of the budget, which they share;
    close it, or use it in a ``with``. ``begin`` is called in each before its first task; ``name``
    is for messages."""

    def __init__(self, workers: int | None = None, *, begin: Callable[..., None] | None = None,
                 begin_arguments: tuple = (), name: str = "the computation"):
        self.worker_count = workers or core_budget()
        self.name = name
        self._begin = (begin, begin_arguments)
        self._cores_each = max(core_budget() // self.worker_count, 1)
        self._context = get_context("spawn")
        self._guard = Lock()
        self._waiting: deque[Job] = deque()
        self._workers: list[Worker] = []
        self._broken: BaseException | None = None
        self._closing = Event()
        self._bell, self._bell_button = self._context.Pipe(duplex=False)
        self._manager = Thread(target=self._manage, name="pool", daemon=True)
        self._manager.start()
        atexit.register(self.close)

    def submit(self, function: Callable, *arguments: Any, limits: Limits = UNLIMITED,
               progress: Progress = SILENT) -> Future:
        """Submit ``function(*arguments)``, both picklable; return its future at once. If it takes
        ``progress``, its reports are passed to the one given here, from another thread."""
        job = Job(Task(function, arguments), limits, progress)
        with self._guard:
            if self._closing.is_set():
                raise WorkError(f"The pool of {self.name} is closed.")
            self._waiting.append(job)
        self._ring()
        return job.future

    def map(self, function: Callable, tasks: Sequence[tuple], *, limits: Limits = UNLIMITED,
            progress: Progress = SILENT, message: str = "") -> list:
        """Return ``[function(*task) for task in tasks]``, in this order, in parallel within limits
        for each; it may take ``progress``. The progress given here gets the mean fraction, the
        number of finished calls and ``remaining_s`` once known; cancelled, it stops all. WorkError
        if a process crashed or exceeded its limits; else the first error of a call, which stops the
        others."""
        course = _Course(len(tasks), progress, message)
        futures = [self.submit(function, *task, limits=limits, progress=course.part(number))
                   for number, task in enumerate(tasks)]
        try:
            while True:
                done, waiting = wait(futures, _TICK_SECONDS, FIRST_EXCEPTION)
                for future in futures:
                    if future in done and (error := future.exception()) is not None:
                        raise error
                course.report(len(done))
                if not waiting:
                    return [future.result() for future in futures]
        except BaseException:
            self.cancel(wait_for_end=True)
            raise

    def cancel(self, *, wait_for_end: bool = False) -> None:
        """Stop all tasks; those that do not stop at their next report are killed."""
        with self._guard:
            jobs = [*self._waiting, *(w.job for w in self._workers if w.job is not None)]
            self._waiting.clear()
        for job in jobs:
            job.cancel()
        self._ring()
        if wait_for_end:
            wait([job.future for job in jobs], _GRACE_SECONDS + 5)

    def close(self) -> None:
        """End the processes at once; unfinished tasks are cancelled."""
        atexit.unregister(self.close)
        self._closing.set()
        self._ring()
        self._manager.join()

    def __enter__(self) -> "Pool":
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def _ring(self) -> None:
        try:
            self._bell_button.send_bytes(b"!")
        except OSError:
            # The pool is closed: there is no receiver any more.
            return

    def _manage(self) -> None:
        reason: BaseException = Cancelled()
        try:
            while not self._closing.is_set():
                self._fill()
                self._listen()
                self._enforce()
        except Exception as error:
            # For example no process could be started: no caller may wait for ever.
            reason = error
        finally:
            self._closing.set()
            for worker in list(self._workers):
                self._end(worker, reason)
            with self._guard:
                waiting, self._waiting = list(self._waiting), deque()
            for job in waiting:
                job.fail(reason)
            self._bell.close()
            self._bell_button.close()

    def _fill(self) -> None:
        """Assign waiting tasks to idle processes; start processes as needed."""
        with self._guard:
            if self._broken is not None:
                waiting, self._waiting = list(self._waiting), deque()
                for job in waiting:
                    job.fail(self._broken)
            needed = min(self.worker_count, len(self._waiting)
                         + sum(w.job is not None for w in self._workers))
            missing = needed - len(self._workers)
        for _ in range(missing):
            self._workers.append(Worker(self._context, self._begin, self._cores_each, self.name))
        for worker in self._workers:
            with self._guard:
                while worker.is_idle and self._waiting:
                    job = self._waiting.popleft()
                    if job.future.set_running_or_notify_cancel():
                        worker.give(job)

    def _listen(self) -> None:
        by_handle: dict[Any, Worker] = {}
        for worker in self._workers:
            by_handle |= {worker.pipe: worker, worker.process.sentinel: worker}
        ready = wait_for_any([self._bell, *by_handle], _TICK_SECONDS)
        if self._bell in ready:
            self._bell.recv_bytes()
        for worker in {id(w): w for h, w in by_handle.items() if h in ready}.values():
            self._hear(worker)

    def _hear(self, worker: Worker) -> None:
        """Receive all messages of a process; it may have ended after sending them."""
        try:
            while worker.pipe.poll():
                self._take(worker, worker.pipe.recv())
            has_ended = not worker.process.is_alive()
        except (EOFError, OSError):
            worker.process.join(_GRACE_SECONDS)
            has_ended = True
        except Exception as error:
            # The message cannot be unpickled here.
            self._end(worker, WorkError(f"The result of {self.name} could not be read: {error!r}."))
            return
        if has_ended:
            self._end(worker, WorkError(
                f"A process of {self.name} ended with exit code {worker.process.exitcode}.",
                "It crashed, or the system ended it because it ran out of memory.",
                "Use a coarser mesh or fewer processes (LIMBER_CORES)."))

    def _take(self, worker: Worker, message: Any) -> None:
        if isinstance(message, Began):
            worker.has_begun = True
        elif isinstance(message, Reported) and worker.job is not None:
            worker.job.report(message)
        elif isinstance(message, Returned) and worker.job is not None:
            worker.take_job().future.set_result(message.value)
        elif isinstance(message, Failed):
            if worker.job is not None:
                worker.take_job().fail(message.error)
            else:
                self._broken = message.error

    def _enforce(self) -> None:
        """Stop tasks that were cancelled or have exceeded their limits."""
        now = time.monotonic()
        for worker in list(self._workers):
            job = worker.job
            if job is None:
                continue
            if job.cancelled_at is not None:
                worker.cancel_once()
                if now - job.cancelled_at > _GRACE_SECONDS:
                    self._end(worker, Cancelled())
                continue
            if error := worker.broken():
                self._end(worker, error)

    def _end(self, worker: Worker, error: BaseException) -> None:
        self._workers.remove(worker)
        worker.kill()
        if worker.job is not None:
            worker.take_job().fail(error)
        elif not worker.has_begun and not self._closing.is_set():
            # The next process would fail in the same way.
            self._broken = self._broken or error


class _Course:
    """Overall progress of several calls."""

    def __init__(self, count: int, progress: Progress, message: str):
        self._fractions = [0.0] * count
        self._progress, self._message = progress, message
        self._started = time.monotonic()

    def part(self, number: int, *, is_here: bool = False) -> Progress:
        """Progress of a call; passed on at once in this process, so that it can be cancelled."""
        def hear(fraction: float, _message: str, _numbers: dict[str, Any]) -> None:
            self._fractions[number] = fraction
            if is_here:
                self.report(number)
        return Progress(hear, self._progress.warn)

    def report(self, done_count: int) -> None:
        count = len(self._fractions)
        fraction = sum(self._fractions) / count if count else 1.0
        fraction = max(fraction, done_count / count if count else 1.0)
        numbers = {"done": done_count}
        seconds = time.monotonic() - self._started
        if 0.02 < fraction < 1.0 and seconds > 1.0:
            numbers["remaining_s"] = round(seconds * (1.0 / fraction - 1.0))
        self._progress(fraction, self._message, **numbers)


def run_tasks(function: Callable, tasks: Sequence[tuple], *, workers: int | None = None,
              progress: Progress = SILENT, message: str = "") -> list:
    """Return ``[function(*task) for task in tasks]`` as :meth:`Pool.map` if cores allow, else, or
    of a single task, in this process with the same results; ``workers``: most processes."""
    count = worker_count(len(tasks), requested=workers)
    if count > 1:
        with Pool(count, name=message or "the computation") as pool:
            return pool.map(function, tasks, progress=progress, message=message)
    course = _Course(len(tasks), progress, message)
    results = []
    for number, task in enumerate(tasks):
        results.append(Task(function, task).run(course.part(number, is_here=True)))
        course.report(number + 1)
    return results
