"""Files that Limber keeps outside branch folders to save time; any may be removed."""

import contextlib
import os
from dataclasses import dataclass
from pathlib import Path

import platformdirs

TETRAHEDRA_BYTES = 1 << 30
"""Size limit of fTetWild's cached meshes."""


@dataclass(frozen=True)
class Cache:
    """One folder of the cache: content, number of files, number of empty files, bytes."""

    name: str
    folder: Path
    file_count: int
    byte_count: int
    empty_count: int = 0


def cache_folder() -> Path:
    """Return the folder of all caches of this user."""
    return Path(platformdirs.user_cache_dir("limber"))


def known_caches() -> list[Cache]:
    """Return the existing caches by name."""
    return [Cache(path.name, path, len(sizes), sum(sizes), sizes.count(0))
            for path in sorted(cache_folder().glob("*")) if path.is_dir()
            for sizes in [[size for _, size, _ in _files(path)]]]


def trim(folder: Path, most_bytes: float) -> int:
    """Remove the least recently used files until those of ``folder`` take ``most_bytes`` or less;
    return the bytes freed. Files that another program holds open or removes are skipped."""
    files = _files(folder)
    total, freed = sum(size for _, size, _ in files), 0
    for _, size, path in sorted(files):
        if total - freed <= most_bytes:
            break
        with contextlib.suppress(OSError):
            path.unlink()
            freed += size
    return freed


def clear(folder: Path) -> int:
    """Remove every file below ``folder``, and subfolders then empty; return the bytes freed. Files
    that another program holds open are skipped."""
    freed = trim(folder, -1)
    for parent, _folders, _names in os.walk(folder, topdown=False):
        # The folder of each cache is kept: a running program may be about to write to it.
        if len(Path(parent).relative_to(folder).parts) > 1:
            with contextlib.suppress(OSError):
                os.rmdir(parent)
    return freed


def _files(folder: Path) -> list[tuple[float, int, Path]]:
    """Time of last use, size and path of each file; locks, which are empty, are skipped."""
    found = []
    for parent, _folders, names in os.walk(folder):
        for name in names:
            path = Path(parent, name)
            with contextlib.suppress(OSError):
                about = path.lstat()
                if path.suffix != ".lock":
                    found.append((max(about.st_mtime, about.st_atime), about.st_size, path))
    return found
