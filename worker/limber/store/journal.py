"""Commits a stage's files to a branch folder: all or none, even if the program is killed.

The work folder, with the new manifest in it, is renamed to ``.commit``. From that moment on, the
stage counts. Then its files are moved into position, the manifest last. Any program that finds a
``.commit`` finishes it first.
"""

import os
import shlex
import shutil
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from limber.core.errors import BranchFolderError, Command, InputError, Option, WorkError
from limber.core.files.atomic import flush_folder, flush_tree, write_atomically
from limber.core.files.safe_names import has_other_names, inside
from limber.core.machine_errors import machine_error
from limber.store.manifest import MANIFEST, Manifest, read_manifest

_COMMIT = ".commit"


def is_pending(folder: Path) -> bool:
    """Whether a killed program left a commit to finish, or a running one is in the middle of it."""
    return (folder / _COMMIT).is_dir()


def current_manifest(folder: Path) -> Manifest:
    """Return the valid manifest, that of a pending commit if any; change no files.
    BranchFolderError as for :func:`~limber.store.manifest.read_manifest`."""
    pending = folder / _COMMIT
    return read_manifest(pending if (pending / MANIFEST).exists() else folder)


def current_path(folder: Path, name: str) -> Path:
    """Return the path of file ``name`` of :func:`current_manifest`, in place or pending. A missing
    one takes no walk along its path: a damaged manifest may list any number."""
    held = [part for part in (f"{_COMMIT}/{name}", name) if os.path.isfile(f"{folder}/{part}")]
    return inside(folder, held[0]) if held else folder / name


def unfinished_error(folder: Path) -> BranchFolderError:
    """Return the error of a read-only command that finds an interrupted commit."""
    return BranchFolderError(
        f"{folder} has results of an interrupted command that are not in place yet "
        f"({_COMMIT}).", "This command only reads, and changes nothing in the folder.",
        "Run ", Command("verify", shlex.quote(str(folder)), Option("finish", True)), ", or any "
        "stage that writes to the folder. It puts the results in place. Then run this again.")


def commit(folder: Path, work: Path, manifest: Manifest) -> None:
    """Commit the files in ``work``, a folder in the branch folder, under their names, and the
    manifest; under the commit lock, without a pending commit. BranchFolderError if an entry that is
    no branch's file is in the way: nothing was committed."""
    _require_targets(folder, (path.relative_to(work).as_posix() for path in work.rglob("*")
                              if path.is_file()))
    (work / MANIFEST).write_text(manifest.text(), encoding="utf-8")
    flush_tree(work)
    os.replace(work, folder / _COMMIT)
    flush_folder(folder)
    roll_forward(folder)


def roll_forward(folder: Path) -> None:
    """Finish a pending commit, if any, under the commit lock; safe to repeat from any point.
    BranchFolderError if a file cannot be replaced, or another entry is in its place."""
    pending = folder / _COMMIT
    if not pending.is_dir():
        return
    try:
        if (pending / MANIFEST).exists():
            _install(folder, pending)
        # Without its manifest, all files have already been moved.
        shutil.rmtree(pending)
        flush_folder(folder)
    except PermissionError as error:
        raise BranchFolderError(
            f"{error.filename2 or error.filename} cannot be replaced ({error.strerror}).",
            "Another program has it open, or the folder is read-only. The new results are in "
            f"{pending}.", "Close that program, or change the permissions, and run any command "
            "on the folder again.") from error


def _install(folder: Path, pending: Path) -> None:
    new = read_manifest(pending)
    old = read_manifest(folder) if (folder / MANIFEST).exists() else None
    touched = {folder}
    _require_targets(folder, (name for name in new.files if inside(pending, name).is_file()))
    for name in sorted(new.files):
        path = inside(pending, name)
        if not path.is_file():
            # From an earlier stage, or already moved.
            continue
        target = inside(folder, name)
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(path, target)
        touched |= {parent for parent in target.parents if parent.is_relative_to(folder)}
    for name in set(old.files if old else ()) - set(new.files):
        if (gone := inside(folder, name)).is_file():
            gone.unlink(missing_ok=True)
    for parent in touched:
        flush_folder(parent)
    os.replace(pending / MANIFEST, folder / MANIFEST)
    flush_folder(folder)


def _require_targets(folder: Path, names: Iterable[str]) -> None:
    """Refuse to commit files if a folder, or a pipe or file in place of a folder, is in the way:
    before the first of them is moved, as a commit that stops halfway would never end."""
    for name in names:
        path = inside(folder, name)
        above = [parent for parent in path.parents if parent.is_relative_to(folder)]
        folder_above = path if path.is_dir() else next(
            (parent for parent in above if parent.exists() and not parent.is_dir()), None)
        if folder_above is not None:
            raise BranchFolderError(
                f"{folder_above} is in the way of the file {name}.",
                "A branch folder has a file in the place of a folder there, or the reverse.",
                "Remove it, or get the folder from its source again. Then run this again.")


# Streams: files that grow during an operation, such as a recording or a log.
#
# A stream holds lines. Appended lines are passed to the system within a quarter of a second and
# written to the disk within one second: a killed program loses at most that, and so does a power
# failure. An incomplete line is removed when the stream is taken over.

_WRITE_SECONDS = 0.25
_FLUSH_SECONDS = 0.75
_TAIL_BYTES = 1 << 16

Shorten = Callable[[Iterator[str]], list[str] | None]


class Stream:
    """Appends lines to a file; a thread writes them, so that the caller never waits for a disk.

    Use it in a ``with``, or close it. An existing file is continued.

    Args:
        path: The file; its folder is created.
        shorten: Called while no other program appends; returns the existing lines to keep, None for
            all.

    Raises:
        BranchFolderError: another program appends to it, or it cannot be written.
    """

    def __init__(self, path: Path, shorten: Shorten | None = None):
        self.path = Path(path)
        self._lock = FileLock(self.path.with_name(f".{self.path.name}.lock"), timeout=0,
                              thread_local=False)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._lock.acquire()
            if self.path.exists() and has_other_names(self.path):
                # An archive can create a second name of a file elsewhere: that file must not grow.
                write_atomically(self.path, self.path.read_bytes())
            self.cut_bytes = _cut_torn_line(self.path)
            kept = shorten(stream_lines(self.path)) if shorten and self.path.exists() else None
            if kept is not None:
                write_atomically(self.path, "".join(f"{line}\n" for line in kept))
            self._file = open(self.path, "ab", buffering=0)
            flush_folder(self.path.parent)
        except Timeout as error:
            raise BranchFolderError(
                f"Another program is appending to {self.path}.", "Its lines would mix with ours.",
                "Wait for it to end, or stop it.") from error
        except OSError as error:
            self._lock.release()
            raise BranchFolderError(f"{self.path} cannot be written ({error.strerror}).",
                                    "The recording is written "
                                    "there.", "Choose another location.") from error
        self._waiting: list[bytes] = []
        self._guard = threading.Lock()
        self._closing = threading.Event()
        self._error: OSError | None = None
        self._writer = threading.Thread(target=self._write, name="stream", daemon=True)
        self._writer.start()

    def append(self, line: str) -> None:
        """Append one line, given without its end; does not wait.

        Raises:
            InputError: the text contains a line end.
            WorkError: an earlier line could not be written, as on a full disk.
        """
        if "\n" in line or "\r" in line:
            raise InputError("A line of a stream contains a line break.", "It would become two "
                                                                         "lines.",
                             "Append the lines one by one.")
        self._raise_error()
        with self._guard:
            self._waiting.append(line.encode("utf-8") + b"\n")

    def close(self) -> None:
        """Write all appended lines to the disk.

        Raises:
            WorkError: they could not be written.
        """
        self._closing.set()
        self._writer.join()
        self._file.close()
        self._lock.release()
        self._raise_error()

    def __enter__(self) -> "Stream":
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def _write(self) -> None:
        unflushed = 0.0
        closing = False
        while not closing:
            closing = self._closing.wait(_WRITE_SECONDS)
            with self._guard:
                lines, self._waiting = self._waiting, []
            unflushed = unflushed + _WRITE_SECONDS if lines or unflushed else 0.0
            try:
                data = memoryview(b"".join(lines))
                while data:
                    data = data[self._file.write(data):]
                if unflushed >= _FLUSH_SECONDS or closing:
                    os.fsync(self._file.fileno())
                    unflushed = 0.0
            except OSError as error:
                self._error = error
                return

    def _raise_error(self) -> None:
        if self._error is not None:
            cause = machine_error(self._error, self.path)
            raise WorkError(f"{self.path} could not be written ({self._error.strerror}).",
                            f"{cause.why if cause else ''} The last lines are lost.".strip(),
                            cause.fix if cause else "Make room on the disk.") from self._error


def stream_lines(path: Path) -> Iterator[str]:
    """Read a stream's complete lines, also while it grows; an incomplete last line is omitted."""
    with open(path, "rb") as stream:
        for line in stream:
            if not line.endswith(b"\n"):
                return
            yield line[:-1].decode("utf-8", errors="replace")


def _cut_torn_line(path: Path) -> int:
    """Remove everything after the last line end; return the number of bytes removed."""
    if not path.exists():
        return 0
    with open(path, "rb+") as stream:
        size = end = stream.seek(0, os.SEEK_END)
        while end > 0:
            start = max(end - _TAIL_BYTES, 0)
            stream.seek(start)
            newline = stream.read(end - start).rfind(b"\n")
            if newline >= 0:
                end = start + newline + 1
                break
            end = start
        if end < size:
            stream.truncate(end)
            os.fsync(stream.fileno())
        return size - end
