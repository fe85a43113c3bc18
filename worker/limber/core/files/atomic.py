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
    """Write a file so that a reader sees the old or the new content, never a partial one.

    When this returns, content and name are on the disk.
    """
    with replacing(path) as stream:
        stream.write(content.encode("utf-8") if isinstance(content, str) else content)


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """Open a stream whose content replaces a file as a whole if the block succeeds.

    Otherwise the file is unchanged.

    Raises:
        InputError: the path is a device or a pipe, which a file would replace.
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
    """Return the sha256 of a file's bytes, in hexadecimal.

    Raises:
        InputError: it is a pipe or a device.
    """
    require_no_pipe(path)
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def require_no_pipe(path: str | os.PathLike) -> None:
    """Refuse a pipe, a socket or a device. A path that does not exist passes.

    Raises:
        InputError: it is one of these. It may never end, and cannot be read twice.
    """
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
    """Return ``path`` if it is a file.

    Raises:
        InputError: it is not.
    """
    require_no_pipe(path)
    if not Path(path).is_file():
        raise InputError(f"There is no file {path}.", f"{what} was expected.", "Check the path.")
    return Path(path)
