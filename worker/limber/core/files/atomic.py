"""Files: atomic writing, comparison by content, and a clear error for a missing file."""

import hashlib
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from limber.core.errors import InputError
from limber.core.files.temporary_names import owned_name


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file so that a reader sees the old or the new content, never a part.

    The content is on the disk, and so is its name, when this returns.
    """
    with replacing(path) as stream:
        stream.write(content.encode("utf-8") if isinstance(content, str) else content)


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """Open a stream whose content becomes a file when the block ends well, as a whole.

    Otherwise nothing changes.

    Raises:
        InputError: a device or a pipe is there; it would be replaced by a file.
    """
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
    """Write a text file whose lines end alike on every system."""
    Path(path).write_text("".join(f"{line}\n" for line in lines), encoding="utf-8", newline="\n")


def flush_folder(folder: Path) -> None:
    """Bring the names in ``folder`` to the disk; Windows does that by itself."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def flush_tree(folder: Path) -> None:
    """Bring all files below ``folder``, and their names, to the disk."""
    for place, _folders, files in os.walk(folder):
        for name in files:
            # Windows flushes only what is open for writing.
            with open(Path(place, name), "rb+" if os.name == "nt" else "rb") as stream:
                os.fsync(stream.fileno())
        flush_folder(Path(place))


def file_digest(path: str | os.PathLike) -> str:
    """Return the sha256 of a file's bytes, in hexadecimal.

    Raises:
        InputError: it is a pipe or a device.
    """
    require_no_pipe(path)
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def require_no_pipe(path: str | os.PathLike) -> None:
    """Refuse a pipe, a socket or a device. A path without anything passes.

    Raises:
        InputError: it is one. It may never end, and it cannot be read twice.
    """
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        # Whoever opens it says so in terms of what was expected there.
        return
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise InputError(f"{path} is a pipe or a device, not a file.",
                         "Files are read more than once and replaced as a whole; a pipe may never "
                         "end.", "Give the path of a file.")


def require_file(path: Path, what: str) -> Path:
    """Return ``path`` if it is a file.

    Raises:
        InputError: it is not.
    """
    require_no_pipe(path)
    if not Path(path).is_file():
        raise InputError(f"There is no file {path}.", f"{what} was expected.", "Check the path.")
    return Path(path)
