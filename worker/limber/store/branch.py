"""The branch folder ``NAME.branch/``: ordinary files and a manifest that vouches for them.

Every stage of the pipeline writes through :meth:`Branch.stage`::

    branch = Branch.create("apple.branch")
    with branch.stage("reconstruct", settings=settings, reads=["cloud.ply"]) as stage:
        write_mesh(stage.path("mesh.vtu"))
        stage.result["tet_count"] = 2500

Files are written beside the folder's own and enter it together when the block ends without an
error; otherwise the folder stays as it was (:mod:`limber.store.journal`). One program at a time
writes (:mod:`limber.store.lock`), any number read (:meth:`Branch.read`, which changes nothing).
What killed programs left behind is finished or swept by the next one that writes.
"""

import gc
import os
import shutil
import time
import traceback
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any

from pydantic import BaseModel

from limber.core.constants import GRAVITY
from limber.core.errors import BranchFolderError, InputError, WorkError
from limber.core.files.atomic import file_digest, flush_folder, write_atomically
from limber.core.files.safe_names import inside, refuse_links
from limber.core.files.temporary_names import is_owned_name, owned_name, sweep, sweep_beside
from limber.core.json_values import plain
from limber.core.machine_errors import machine_error
from limber.store import journal
from limber.store.growing_files import Stream
from limber.store.lock import COMMIT_LOCK, RUN_LOCK, commit_lock, run_lock, wait_for_commit
from limber.store.manifest import (
    MANIFEST,
    FileEntry,
    Manifest,
    StageEntry,
    checked_name,
    program_versions,
    read_manifest,
)
from limber.store.verify import Checker, Damage, damage_error

_STREAMS = ".streams"
RESULTS = "results"
"""Among a stage's programs: the version of its settings' results; see limber.core.settings."""
LEAST_FREE_BYTES = 200e6
"""A stage does not begin with less room on the disk: it would lose its work at the end."""


class Stage:
    """A stage in progress. ``path`` gives where to write; ``result`` goes to the manifest."""

    def __init__(self, folder: Path, manifest: Manifest, streams: Path):
        self._folder = folder
        self._streams = streams
        self.manifest = manifest
        self.result: dict[str, Any] = {}
        self.removes: set[str] = set()
        self.adopted: list[Path] = []

    def path(self, name: str) -> Path:
        """Return where to write file ``name`` (relative, ``/``) of the branch folder.

        Raises:
            WorkError: the branch folder is gone.
        """
        path = self._folder / checked_name(name)
        if not self._folder.is_dir():
            # Not made anew: below the empty place of a lost disk there is another disk.
            raise _gone(self._folder.parent)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def remove(self, name: str) -> None:
        """Drop file ``name`` of an earlier run when this stage ends well."""
        self.removes.add(checked_name(name))

    def adopt(self, name: str) -> None:
        """Take over what the closed stream ``name`` of the branch holds, as the file ``name``."""
        stream = self._streams / checked_name(name)
        shutil.copyfile(stream, self.path(name))
        self.adopted.append(stream)

    def written(self) -> list[str]:
        """Return the names written so far, sorted."""
        files = (p for p in self._folder.rglob("*") if p.is_file())
        return sorted(p.relative_to(self._folder).as_posix() for p in files)


class Branch:
    """An opened branch folder."""

    def __init__(self, folder: Path, manifest: Manifest, *, only_reads: bool = False):
        self.folder = Path(folder)
        self.manifest = manifest
        self._checker = Checker(self.folder)
        self._only_reads = only_reads

    @property
    def name(self) -> str:
        return self.manifest.name

    @property
    def uuid(self) -> str | None:
        """What names the branch wherever it goes; None for one of format 1, until written to."""
        return self.manifest.uuid

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Gravity [m/s^2] in the branch's frame: the upright turn of a scan turns it too."""
        for key in ("reconstruct", "mesh"):
            if key in self.manifest.stages:
                return tuple(self.manifest.stages[key].result.get("gravity_m_s2", GRAVITY))
        return GRAVITY

    @classmethod
    def create(cls, folder: str | os.PathLike) -> "Branch":
        """Open ``folder`` if it is a branch folder, make a new one if it is empty or missing.

        Raises:
            BranchFolderError: it holds other files, or cannot be made or written to.
        """
        folder = Path(folder)
        _refuse_links(folder)
        if (folder / MANIFEST).exists() or journal.is_pending(folder):
            return cls.open(folder)
        if folder.is_dir() and any(not _is_litter(p.name) for p in folder.iterdir()):
            raise BranchFolderError(
                f"{folder} exists and is not a branch folder.",
                f"It has files but no {MANIFEST}; writing there could overwrite them.",
                "Name a new folder with -o, for example NAME.branch.")
        name = folder.name.removesuffix(".branch") or folder.resolve().name.removesuffix(".branch")
        _begin(folder, Manifest(name=name))
        return cls.open(folder)

    @classmethod
    def open(cls, folder: str | os.PathLike, *, verify: bool = False) -> "Branch":
        """Open an existing branch folder to write to it; what a killed program left is finished.

        A file is compared with its checksum when it is used (:meth:`path`), so that a damaged
        one stops what needs it but not the stage that makes it anew; ``verify`` compares all.

        Raises:
            BranchFolderError: not a branch folder, damaged, of a newer format, or with links or
                names that lead out of it.
        """
        folder = Path(folder)
        with _in_words(folder):
            _require_folder(folder)
            _refuse_links(folder)
            _finish_pending(folder)
            branch = cls(folder, read_manifest(folder))
        if verify:
            branch.verify()
        return branch

    @classmethod
    def read(cls, folder: str | os.PathLike, *, unfinished: bool = False) -> "Branch":
        """Open an existing branch folder only to read it: nothing in it is changed.

        Where another program is entering results, it waits for the end of that.

        Args:
            unfinished: Take a folder with an interrupted commit as it will be when that is
                finished. Only :meth:`damages` finds the files that are not in place yet.

        Raises:
            BranchFolderError: as :meth:`open`; or a commit was interrupted, and ``unfinished`` is
                not set.
        """
        folder = Path(folder)
        with _in_words(folder):
            _require_folder(folder)
            _refuse_links(folder)
            _settle(folder, unfinished=unfinished)
            return cls(folder, journal.current_manifest(folder), only_reads=True)

    @property
    def is_unfinished(self) -> bool:
        """Whether an interrupted command left results that are not in place yet."""
        return journal.is_pending(self.folder)

    def path(self, name: str) -> Path:
        """Return the path of file or folder ``name``, whether it exists or not.

        Raises:
            BranchFolderError: the manifest has it, or files in it, and they are damaged.
        """
        name = checked_name(name)
        path = _inside(self.folder, name)
        self._check(n for n in self.manifest.files if n == name or n.startswith(name + "/"))
        return path

    def has(self, name: str) -> bool:
        return name in self.manifest.files and (self.folder / checked_name(name)).is_file()

    def require(self, name: str, made_by: str) -> Path:
        """Return the path of file ``name``; ``made_by`` is the command that would make it.

        Raises:
            BranchFolderError: the file is not there.
        """
        if not self.has(name):
            raise BranchFolderError(
                f"{self.folder} has no {name}.", "The stage that makes it has not been run.",
                f"Run `limber {made_by}` first.")
        return self.path(name)

    def names(self, folder: str) -> list[str]:
        """Return the names of the entries under ``folder`` (``pulls``, ``plans``), sorted."""
        prefix = folder.rstrip("/") + "/"
        inside = (name[len(prefix):] for name in self.manifest.files if name.startswith(prefix))
        return sorted({PurePosixPath(name).parts[0] for name in inside})

    def verify(self) -> None:
        """Compare every file with the manifest.

        Raises:
            BranchFolderError: a file is missing or its bytes have changed; names each.
        """
        self._check(self.manifest.files)

    def damages(self) -> list[Damage]:
        """Return what is wrong with the folder's files; empty where all is as it was written."""
        return self._checker.damages(self.manifest, sorted(self.manifest.files))

    def _check(self, names: Iterable[str]) -> None:
        damages = self._checker.damages(self.manifest, names)
        if not damages:
            return
        if self._only_reads:
            _settle(self.folder)
        else:
            _finish_pending(self.folder)
        now = read_manifest(self.folder).files
        renewed = [d.name for d in damages if now.get(d.name) != self.manifest.files[d.name]]
        if renewed:
            raise BranchFolderError(
                f"Another run made {', '.join(renewed[:4])} of {self.folder} anew, or removed it, "
                "while this one was reading.", "What has been read does not belong with it.",
                "Run this again.")
        raise damage_error(self.folder, damages)

    @contextmanager
    def writing(self, purpose: str) -> Iterator[None]:
        """Hold the right to write to this folder, and sweep what killed programs left in it.

        :meth:`stage` takes it by itself; a stage whose work begins long before asks for it first.

        Args:
            purpose: What another program's user reads that finds the folder taken.

        Raises:
            BranchFolderError: another program holds it; says who and since when.
            WorkError: the disk is full or nearly so, or the folder is lost, now or until the end.
        """
        _require_there(self.folder)
        with _in_words(self.folder), run_lock(self.folder, purpose) as is_first:
            if is_first:
                sweep(self.folder)
                _require_room(self.folder, purpose)
            yield

    def stream(self, name: str) -> Stream:
        """Open the stream ``name``, new or left by a program that ended; see :class:`Stream`.

        It stays beside the branch's files until a stage takes it over (:meth:`Stage.adopt`).
        """
        return Stream(self.folder / _STREAMS / checked_name(name))

    def growing(self, prefix: str) -> Path | None:
        """Return the folder of the streams below ``prefix``, which may grow; None without one."""
        folder = self.folder / _STREAMS / checked_name(prefix)
        return folder if folder.is_dir() and any(
            path.is_file() and not path.name.startswith(".") for path in folder.iterdir()) else None

    def streams(self) -> list[str]:
        """Return the names of the streams that no stage has taken over yet, sorted."""
        folder = self.folder / _STREAMS
        return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*")
                      if path.is_file() and not path.name.startswith("."))

    def digest(self, name: str) -> str:
        """Return the sha256 that the manifest has for file ``name``."""
        return self.manifest.files[name].sha256

    def is_current(self, key: str, settings: BaseModel | Mapping[str, Any] | None = None, *,
                   reads: Iterable[str] = (), digests: Mapping[str, str] | None = None) -> bool:
        """Whether stage ``key`` was run with these settings on these inputs, files intact."""
        entry = self.manifest.stages.get(key)
        if entry is None or any(name not in self.manifest.files for name in reads):
            return False
        wanted = self._read_digests(reads, digests)
        intact = all(name in self.manifest.files
                     and not self._checker.trouble(name, self.manifest.files[name])
                     for name in entry.writes if self._owner(name) == key)
        return (intact and entry.reads == wanted and entry.settings == plain(settings or {})
                and entry.programs.get(RESULTS, "1") == _results_version(settings))

    @contextmanager
    def stage(self, key: str, settings: BaseModel | Mapping[str, Any] | None = None, *,
              reads: Iterable[str] = (), digests: Mapping[str, str] | None = None,
              ) -> Iterator[Stage]:
        """Run stage ``key``; see the module's docstring.

        Args:
            key: The stage's name, with the entry's where there are several ("plan:to-light").
            settings: What the result depends on beside the inputs; stored as plain JSON.
            reads: Names of files of this folder that the stage reads.
            digests: Further inputs, label to digest (a file from outside, part of a file).
        """
        started = time.perf_counter()
        with self.writing(f"the stage {key}"):
            read = self._read_digests(reads, digests)
            work = self.folder / owned_name(f"stage-{_short(key)}")
            work.mkdir()
            try:
                stage = Stage(work, self.manifest.model_copy(deep=True), self.folder / _STREAMS)
                yield stage
                entry = StageEntry(
                    settings=plain(settings or {}), reads=read, writes=stage.written(),
                    result=plain(stage.result),
                    programs=program_versions() | _told_version(settings),
                    seconds=round(time.perf_counter() - started, 3),
                    finished=datetime.now(UTC).isoformat(timespec="seconds"))
                self._commit(key, entry, stage, work)
            finally:
                shutil.rmtree(work, ignore_errors=True)
            for path in stage.adopted:
                path.unlink(missing_ok=True)

    def _commit(self, key: str, entry: StageEntry, stage: Stage, work: Path) -> None:
        written = {name: FileEntry(sha256=file_digest(work / name),
                                   bytes=(work / name).stat().st_size, stage=key)
                   for name in entry.writes}
        _require_there(self.folder)
        with commit_lock(self.folder):
            # One that a killed program left comes first: its files count already.
            journal.roll_forward(self.folder)
            manifest = read_manifest(self.folder)
            manifest.alignment, manifest.source = stage.manifest.alignment, stage.manifest.source
            manifest.unit = stage.manifest.unit
            manifest.stages[key] = entry
            for name in stage.removes - set(entry.writes):
                manifest.files.pop(name, None)
            manifest.files |= written
            journal.commit(self.folder, work, manifest)
            self.manifest = manifest

    def _owner(self, name: str) -> str | None:
        entry = self.manifest.files.get(name)
        return entry.stage if entry else None

    def _read_digests(self, reads: Iterable[str], digests: Mapping[str, str] | None,
                      ) -> dict[str, str]:
        reads = list(reads)
        missing = [name for name in reads if name not in self.manifest.files]
        if missing:
            raise BranchFolderError(
                f"{self.folder} has no {', '.join(missing)}.",
                "The stage that makes it has not been run.", "Run the earlier stages first.")
        self._check(reads)
        return {name: self.digest(name) for name in reads} | dict(digests or {})


def _begin(folder: Path, manifest: Manifest) -> None:
    """Make the folder with its manifest: a new one appears whole, an empty one is filled."""
    unfinished = folder.with_name(owned_name(folder.name))
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        sweep_beside(folder)
        if folder.is_dir():
            with commit_lock(folder):
                sweep(folder)
                if not (folder / MANIFEST).exists():
                    write_atomically(folder / MANIFEST, manifest.text())
            return
        unfinished.mkdir()
        try:
            write_atomically(unfinished / MANIFEST, manifest.text())
            os.rename(unfinished, folder)
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
        flush_folder(folder.parent)
    except OSError as error:
        if (folder / MANIFEST).exists():
            # Another program made it in the same moment.
            return
        raise BranchFolderError(
            f"{folder} cannot be written to ({error.strerror}).",
            "Results go there.", "Choose another place with -o, or change its permissions.",
        ) from error


def settled_manifest(folder: Path) -> Manifest:
    """Return the manifest of a branch folder, once what a killed program left is finished.

    For those who carry a folder elsewhere and read nothing of it.

    Raises:
        BranchFolderError: as :func:`~limber.store.manifest.read_manifest`; or it has links.
    """
    _refuse_links(folder)
    _finish_pending(folder)
    return read_manifest(folder)


def _require_folder(folder: Path) -> None:
    if not folder.is_dir():
        raise BranchFolderError(
            f"There is no folder {folder}.", "A branch folder was expected.",
            "Make one with `limber reconstruct CLOUD -o NAME.branch`.")


def _refuse_links(folder: Path) -> None:
    try:
        refuse_links(folder)
    except InputError as error:
        raise BranchFolderError(error.seen, error.why, error.fix) from error


def _inside(folder: Path, name: str) -> Path:
    try:
        return inside(folder, name)
    except InputError as error:
        raise BranchFolderError(error.seen, error.why, error.fix) from error


def _settle(folder: Path, *, unfinished: bool = False) -> None:
    """Wait for a program that enters results; refuse what a killed one left, unless ``unfinished``.
    """
    if journal.is_pending(folder):
        wait_for_commit(folder)
        if journal.is_pending(folder) and not unfinished:
            raise journal.unfinished_error(folder)


def _finish_pending(folder: Path) -> None:
    if journal.is_pending(folder):
        with commit_lock(folder):
            journal.roll_forward(folder)


def _results_version(settings: BaseModel | Mapping[str, Any] | None) -> str:
    return str(getattr(type(settings), "results_version", 1))


def _told_version(settings: BaseModel | Mapping[str, Any] | None) -> dict[str, str]:
    version = _results_version(settings)
    return {} if version == "1" else {RESULTS: version}


@contextmanager
def _in_words(folder: Path) -> Iterator[None]:
    """Say what a full disk or a lost folder does to a stage as the user can read it."""
    try:
        yield
    except OSError as error:
        if _is_gone(folder):
            raise _gone(folder) from error
        told = machine_error(error, folder)
        if told is None:
            raise
        # A file that the failed writer still has open keeps its room, removed or not; the next
        # stage of this process would find the disk as full.
        traceback.clear_frames(error.__traceback__)
        gc.collect()
        raise told from error


def _require_there(folder: Path) -> None:
    """Refuse a folder that was there and is not any more: locks would make an empty one."""
    if _is_gone(folder):
        raise _gone(folder)


def _is_gone(folder: Path) -> bool:
    try:
        return not (folder / MANIFEST).is_file() and not journal.is_pending(folder)
    except OSError:
        # The place does not answer: another error says so better.
        return False


def _gone(folder: Path) -> WorkError:
    return WorkError(f"{folder} is not there any more.",
                     "It was moved or removed, or the disk or network folder that it is on was "
                     "lost.", "Bring it back, and run this again: what was stored before is kept.")


def _require_room(folder: Path, purpose: str) -> None:
    free = shutil.disk_usage(folder).free
    if free < LEAST_FREE_BYTES:
        raise WorkError(f"The disk of {folder} has {free / 1e6:.0f} MB left.",
                        f"For {purpose} {LEAST_FREE_BYTES / 1e6:.0f} MB are wanted: it would end "
                        "without its results.",
                        "Make room (`limber cache --clear` frees some), or move the folder.")


def _is_litter(name: str) -> bool:
    """Whether a file of this name may be in a folder that was killed while it was made."""
    return name in (COMMIT_LOCK, RUN_LOCK) or is_owned_name(name)


def _short(key: str) -> str:
    return "".join(c if c.isalnum() or c in "-_" else "-" for c in key)[:60]
