"""The right to write to a branch folder: one program at a time, one result after another.

Both locks are the operating system's, so the end of a program always releases them.
"""

import errno
import getpass
import json
import os
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from filelock import BaseFileLock, FileLock, Timeout

from limber.core.errors import BranchBusyError, BranchFolderError
from limber.core.files.atomic import write_atomically

COMMIT_LOCK = ".lock"
RUN_LOCK = ".run.lock"
HOLDER = ".run.json"
_COMMIT_WAIT_SECONDS = 60.0
_NO_LOCKS = frozenset((errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK))


@contextmanager
def run_lock(folder: Path, purpose: str) -> Iterator[bool]:
    """Hold the right to write to ``folder`` for a whole stage; yield whether this program did not
    hold it yet. Readers need none. ``purpose`` is text for another program's user. BranchBusyError
    states which program has it locked, and since when."""
    # One lock object per folder in this program, for any number of requests.
    lock = FileLock((folder / RUN_LOCK).resolve(), is_singleton=True, thread_local=False)
    try:
        _acquire(lock, folder, 0.0)
    except Timeout as error:
        if _lacks_locks(folder / RUN_LOCK):
            raise _no_locks(folder, RUN_LOCK) from error
        raise BranchBusyError(
            f"Another Limber is writing to {folder}: {_holder(folder)}.",
            "Two writers would corrupt each other's results. Reading is still possible.",
            "Wait for it to end, or stop it.") from error
    is_first = lock.lock_counter == 1
    try:
        if is_first:
            write_atomically(folder / HOLDER, json.dumps({
                "purpose": purpose, "user": _user(), "host": socket.gethostname(),
                "process": os.getpid(), "since": datetime.now(UTC).isoformat(timespec="seconds"),
            }) + "\n")
        yield is_first
    finally:
        try:
            if lock.lock_counter == 1:
                (folder / HOLDER).unlink(missing_ok=True)
        finally:
            lock.release()


@contextmanager
def commit_lock(folder: Path) -> Iterator[None]:
    """Hold the right to move results into ``folder``, for a moment; others wait. BranchFolderError
    if it was not available within a minute, or the folder cannot be written to."""
    lock = FileLock(folder / COMMIT_LOCK)
    try:
        _acquire(lock, folder, _COMMIT_WAIT_SECONDS)
    except Timeout as error:
        if _lacks_locks(folder / COMMIT_LOCK):
            raise _no_locks(folder, COMMIT_LOCK) from error
        raise BranchFolderError(
            f"{folder} has been locked by another Limber for a minute.",
            "Two stages must not enter results at once.", "Wait for it to end, or stop it.",
        ) from error
    try:
        yield
    finally:
        lock.release()


def wait_for_commit(folder: Path) -> None:
    """Wait, a minute at most, while another program moves results into ``folder``. For readers: the
    lock is requested on a read-only handle; without a lock file there is no such program."""
    until = time.monotonic() + _COMMIT_WAIT_SECONDS
    while _is_held(folder / COMMIT_LOCK) and time.monotonic() < until:
        time.sleep(0.02)


def _is_held(path: Path) -> bool:
    """Whether a program has the lock of a file."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except OSError:
        return False
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
            msvcrt.locking(handle, msvcrt.LK_UNLCK, 1)
        else:
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return False
    except OSError as error:
        # Any other error means that this file system has no locks.
        return error.errno in (errno.EACCES, errno.EAGAIN, errno.EDEADLK)
    finally:
        os.close(handle)


def _lacks_locks(path: Path) -> bool:
    """Whether the file system has no locks: files stand for them, and outlive a killed program."""
    if sys.platform == "win32":
        return False
    import fcntl

    try:
        handle = os.open(path, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return False
    except OSError as error:
        return error.errno in _NO_LOCKS
    finally:
        os.close(handle)


def _no_locks(folder: Path, name: str) -> BranchFolderError:
    return BranchFolderError(
        f"The disk of {folder} has no file locks.",
        "Two programs that write there cannot be kept apart; or one that was killed has left its "
        f"{name}.", f"Work on a copy on a local disk. If no other Limber is running, removing "
        f"{folder / name} may help.")


def _acquire(lock: BaseFileLock, folder: Path, wait_seconds: float) -> None:
    try:
        lock.acquire(timeout=wait_seconds)
    except OSError as error:
        if isinstance(error, Timeout):
            raise
        if error.errno in _NO_LOCKS:
            raise _no_locks(folder, Path(lock.lock_file).name) from error
        raise BranchFolderError(
            f"{folder} cannot be written to ({error.strerror or error}).",
            "Results are written there.",
            "Change its permissions, or work on a copy.") from error


def _holder(folder: Path) -> str:
    """The holder of the run lock, as text."""
    for _ in range(5):
        try:
            found = json.loads((folder / HOLDER).read_text(encoding="utf-8"))
            since = datetime.fromisoformat(found["since"])
            minutes = (datetime.now(UTC) - since).total_seconds() / 60
            return (f"{found['purpose']}, process {found['process']} of {found['user']} on "
                    f"{found['host']}, since {since:%Y-%m-%d %H:%M:%S} UTC ({minutes:.0f} min)")
        except (OSError, ValueError, KeyError, TypeError):
            # It has just started, or just ended.
            time.sleep(0.05)
    return "an unknown process"


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        # A user without a name, as in some containers.
        return f"user {os.getuid()}" if hasattr(os, "getuid") else "an unnamed user"
