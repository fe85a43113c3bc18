"""The worker as a process: started without a console window, ended with its child processes.

Threads only read its output into a queue, which its owner empties from Blender's main thread.
On POSIX it leads a process group. On Windows it belongs to a job object, which also ends with
Blender, however that ends. No bpy here.
"""

import ctypes
import json
import os
import queue
import signal
import subprocess
import threading
from collections.abc import Iterator
from typing import Any

from .worker import worker_environment

_POSIX = os.name == "posix"
_CREATE_NO_WINDOW = 0x08000000
_KILL_ON_JOB_CLOSE = 0x2000
_EXTENDED_LIMITS = 9
"""JobObjectExtendedLimitInformation of the Windows interface."""


class _BasicLimits(ctypes.Structure):
    _fields_ = (("process_time", ctypes.c_int64), ("job_time", ctypes.c_int64),
                ("flags", ctypes.c_uint32), ("least_memory", ctypes.c_size_t),
                ("most_memory", ctypes.c_size_t), ("process_count", ctypes.c_uint32),
                ("affinity", ctypes.c_size_t), ("priority", ctypes.c_uint32),
                ("scheduling", ctypes.c_uint32))


class _Limits(ctypes.Structure):
    _fields_ = (("basic", _BasicLimits), ("transfers", ctypes.c_uint64 * 6),
                ("process_memory", ctypes.c_size_t), ("job_memory", ctypes.c_size_t),
                ("peak_process_memory", ctypes.c_size_t), ("peak_job_memory", ctypes.c_size_t))


class WorkerProcess(subprocess.Popen):
    """A process of the worker with pipes for text; OSError if the program cannot be started.

    Its input closes when Blender ends for any reason; with ``LIMBER_PARENT_PIPE`` in ``extra`` the
    worker ends then too.
    """

    def __init__(self, command: list[str], **extra: str):
        super().__init__(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, encoding="utf-8", errors="replace", env=worker_environment() | extra,
            start_new_session=_POSIX, creationflags=0 if _POSIX else _CREATE_NO_WINDOW)
        self._job = None if _POSIX else _job_object(_kernel(), self._handle)
        self._lines: queue.SimpleQueue[tuple[str, str]] = queue.SimpleQueue()
        self._readers = [threading.Thread(target=self._read, args=given, daemon=True)
                         for given in (("out", self.stdout), ("err", self.stderr))]
        for reader in self._readers:
            reader.start()

    def told(self) -> Iterator[dict[str, Any] | str]:
        """Yield what it has written since the last call: JSON objects, and other lines as text."""
        if self.poll() is not None:
            for reader in self._readers:
                # A grandchild may keep the pipe open; the relevant lines have been read by then.
                reader.join(timeout=2.0)
        while not self._lines.empty():
            name, line = self._lines.get()
            yield (_object_in(line) if name == "out" else None) or line

    def _read(self, name: str, stream) -> None:
        # Closed at its end, whichever process still has it open.
        with stream:
            for line in stream:
                self._lines.put((name, line.rstrip("\n")))

    def ask_to_end(self) -> None:
        """Let it cancel its work and end; safe to call after it has ended."""
        if _POSIX:
            self._signal_group(signal.SIGTERM)
            return
        try:
            # Windows has no gentle signal. The worker cancels when its input closes.
            self.stdin.close()
        except OSError:
            # It has ended already.
            return

    def end_now(self) -> None:
        """End it and its child processes; safe to call after it has ended."""
        if _POSIX:
            self._signal_group(signal.SIGKILL)
        elif self._job is None or not _kernel().TerminateJobObject(self._job, 1):
            self.kill()

    def _signal_group(self, number: int) -> None:
        # The whole group: the worker may be running a mesher or a process pool.
        try:
            os.killpg(self.pid, number)
        except ProcessLookupError:
            return


def _object_in(line: str) -> dict[str, Any] | None:
    try:
        content = json.loads(line)
    except (ValueError, RecursionError):
        # Native libraries print lines of their own among the worker's.
        return None
    return content if isinstance(content, dict) else None


def _kernel() -> Any:
    """Return the Windows interface, its handles as wide as pointers."""
    kernel = ctypes.WinDLL("kernel32", use_last_error=True)
    kernel.CreateJobObjectW.restype = ctypes.c_void_p
    kernel.CreateJobObjectW.argtypes = (ctypes.c_void_p, ctypes.c_wchar_p)
    kernel.SetInformationJobObject.argtypes = (ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p,
                                               ctypes.c_uint32)
    kernel.AssignProcessToJobObject.argtypes = (ctypes.c_void_p, ctypes.c_void_p)
    kernel.TerminateJobObject.argtypes = (ctypes.c_void_p, ctypes.c_uint32)
    return kernel


def _job_object(kernel: Any, process: int) -> int | None:
    """Return a job object of a process and its later children; None if Windows refuses. It ends
    with its last handle: with Blender.
    """
    job = kernel.CreateJobObjectW(None, None)
    if not job:
        return None
    limits = _Limits()
    limits.basic.flags = _KILL_ON_JOB_CLOSE
    if not (kernel.SetInformationJobObject(job, _EXTENDED_LIMITS, ctypes.byref(limits),
                                           ctypes.sizeof(limits))
            and kernel.AssignProcessToJobObject(job, int(process))):
        return None
    return job
