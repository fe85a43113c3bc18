"""Files: atomic writing, comparison by content, and a clear error for a missing file."""

import functools
import glob
import hashlib
import os
import re
import secrets
import shutil
import socket
import stat
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from limber.core.errors import InputError

# Names of temporary files. They identify their process, so that orphans are removed.
#
# A name contains host, process id and the second in which the process started, since the system
# reuses process ids.

_OWNED = re.compile(r"^\..+\.([0-9a-f]{6})-([0-9]+)-([0-9]+)-[0-9a-f]{8}$")
_CLOCK_SECONDS = 2.0
"""Largest difference of two readings of a process's start: the clock may be set in between."""
_FOREIGN_DAYS = 7.0
"""Age without a change after which files of another machine's process are removed, since that
process cannot be looked up.
"""


def owned_name(name: str) -> str:
    """Return a new hidden name of this process for an unfinished ``name``."""
    return f".{name}.{_host()}-{os.getpid()}-{_start_second(os.getpid())}-{secrets.token_hex(4)}"


def sweep(folder: Path) -> list[str]:
    """Remove unfinished files and folders of ended processes below ``folder``; return their names
    relative to it, sorted."""
    removed = []
    for path in _abandoned(folder):
        _remove(path)
        removed.append(path.relative_to(folder).as_posix())
    return sorted(removed)


def sweep_beside(path: Path) -> None:
    """Remove unfinished versions of ``path`` left behind by ended processes."""
    for unfinished in path.parent.glob(f".{glob.escape(path.name)}.*"):
        if is_owned_name(unfinished.name) and _is_abandoned(unfinished):
            _remove(unfinished)


def is_owned_name(name: str) -> bool:
    """Whether :func:`owned_name` made ``name``, on this machine or another."""
    return _OWNED.match(name) is not None


def is_alive(process_id: int, start_second: int) -> bool:
    """Whether the process on this machine with that start time is running."""
    import psutil

    try:
        process = psutil.Process(process_id)
        return (abs(process.create_time() - start_second) <= _CLOCK_SECONDS
                and process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False
    except psutil.AccessDenied:
        return True


def _abandoned(folder: Path) -> Iterator[Path]:
    for parent, folders, files in os.walk(folder):
        owned = [name for name in folders + files if is_owned_name(name)]
        # Unfinished folders belong to their owners and are not searched.
        folders[:] = [name for name in folders if name not in owned]
        for name in owned:
            path = Path(parent, name)
            if _is_abandoned(path):
                yield path


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _is_abandoned(path: Path) -> bool:
    owned = _OWNED.match(path.name)
    if owned is None:
        return False
    host, process_id, start = owned.groups()
    if host == _host():
        return not is_alive(int(process_id), int(start))
    try:
        return time.time() - path.lstat().st_mtime > _FOREIGN_DAYS * 86400
    except FileNotFoundError:
        return False


@functools.cache
def _host() -> str:
    return hashlib.sha256(socket.gethostname().encode()).hexdigest()[:6]


@functools.cache
def _start_second(process_id: int) -> int:
    import psutil

    return round(psutil.Process(process_id).create_time())


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file so that a reader sees the old or the new content, never a partial one; when this
    returns, content and name are on the disk."""
    with replacing(path) as stream:
        stream.write(content.encode("utf-8") if isinstance(content, str) else content)


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """Open a stream whose content replaces a file as a whole if the block succeeds; else it is
    unchanged. InputError if it is a device or a pipe, which a file would replace."""
    require_no_pipe(path)
    path = Path(path)
    temporary = path.with_name(owned_name(path.name))
    try:
        with open(temporary, "xb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    flush_folder(path.parent)


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """Write a text file with the same line ends on every system."""
    Path(path).write_text("".join(f"{line}\n" for line in lines), encoding="utf-8", newline="\n")


def flush_folder(folder: Path) -> None:
    """Flush the names in ``folder`` to the disk; Windows does this automatically."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def flush_tree(folder: Path) -> None:
    """Flush all files below ``folder``, and their names, to the disk."""
    for parent, _folders, files in os.walk(folder):
        for name in files:
            # Windows flushes only files that are open for writing.
            with open(Path(parent, name), "rb+" if os.name == "nt" else "rb") as stream:
                os.fsync(stream.fileno())
        flush_folder(Path(parent))


def file_digest(path: str | os.PathLike) -> str:
    """Return the sha256 of a file's bytes, in hexadecimal; InputError if it is a pipe or a
    device."""
    require_no_pipe(path)
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def require_no_pipe(path: str | os.PathLike) -> None:
    """Refuse a pipe, a socket or a device with an InputError: it may never end, and cannot be read
    twice. A path that does not exist passes."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        # The caller that opens it reports this and names what it expected.
        return
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise InputError(f"{path} is a pipe or a device, not a file.",
                         "Files are read more than once and replaced as a whole; a pipe may never "
                         "end.", "Give the path of a file.")


def require_file(path: Path, what: str) -> Path:
    """Return ``path`` if it is a file, else InputError."""
    require_no_pipe(path)
    if not Path(path).is_file():
        raise InputError(f"There is no file {path}.", f"{what} was expected.", "Check the path.")
    return Path(path)
