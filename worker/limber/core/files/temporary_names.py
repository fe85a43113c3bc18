"""Names of temporary files. They identify their process, so that orphans are removed.

A name contains host, process id and the second in which the process started, since the system
reuses process ids.
"""

import functools
import glob
import hashlib
import os
import re
import secrets
import shutil
import socket
import time
from collections.abc import Iterator
from pathlib import Path

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
    """Remove unfinished files and folders of ended processes below ``folder``.

    Returns:
        The names of the removed files and folders, relative to ``folder``, sorted.
    """
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
