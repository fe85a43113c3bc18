"""Main loop of a pool process: it takes tasks from its pipe until the pipe closes."""

import inspect
import os
import queue
import signal
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing import parent_process
from multiprocessing.connection import Connection
from typing import Any

from limber.core.errors import LimberError, WorkError
from limber.core.processes.end_with_parent import end_by_kernel
from limber.core.processes.process_limits import CORES
from limber.core.progress import Progress, report_damage_to

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
class CacheDamaged:
    """A warning about a damaged cache, from any code in the process."""

    message: str


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
    with report_damage_to(lambda message: voice.say(CacheDamaged(message))):
        _work(tasks, voice, begin)


def _work(tasks: "queue.SimpleQueue[Task]", voice: "_Voice",
          begin: tuple[Callable | None, tuple]) -> None:
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
