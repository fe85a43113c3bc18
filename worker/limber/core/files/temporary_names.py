"""Names of temporary files. They identify their process, so that those of a dead one are removed.

A name carries host, process id and the second in which that process started: the system
reuses a process id.
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
"""By how much two readings of one process's start may differ: the clock is set meanwhile."""
_FOREIGN_DAYS = 7.0
"""A process on another machine cannot be looked up: its files go when they have not changed for
so long."""


def owned_name(name: str) -> str:
    """Return a new hidden name for an unfinished ``name`` of this process."""
    return f".{name}.{_host()}-{os.getpid()}-{_start_second(os.getpid())}-{secrets.token_hex(4)}"


def sweep(folder: Path) -> list[str]:
    """Remove unfinished files and folders of dead processes below ``folder``.

    Returns:
        The names of what was removed, relative to ``folder``, sorted.
    """
    removed = []
    for path in _abandoned(folder):
        _remove(path)
        removed.append(path.relative_to(folder).as_posix())
    return sorted(removed)


def sweep_beside(path: Path) -> None:
    """Remove unfinished versions of ``path`` that dead processes left beside it."""
    for unfinished in path.parent.glob(f".{glob.escape(path.name)}.*"):
        if is_owned_name(unfinished.name) and _is_abandoned(unfinished):
            _remove(unfinished)


def is_owned_name(name: str) -> bool:
    """Whether ``name`` is one that :func:`owned_name` made, here or elsewhere."""
    return _OWNED.match(name) is not None


def is_alive(process_id: int, start_second: int) -> bool:
    """Whether the process of this machine that started then is running."""
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
    for place, folders, files in os.walk(folder):
        owned = [name for name in folders + files if is_owned_name(name)]
        # What is being written there is its owner's alone.
        folders[:] = [name for name in folders if name not in owned]
        for name in owned:
            path = Path(place, name)
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
