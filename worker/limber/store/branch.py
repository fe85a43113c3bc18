"""The branch folder ``NAME.branch/``: ordinary files and a manifest with their checksums.

Every stage of the pipeline writes through :meth:`Branch.stage`::

    branch = Branch.create("apple.branch")
    with branch.stage("reconstruct", settings=settings, reads=["cloud.ply"]) as stage:
        write_mesh(stage.path("mesh.vtu"))
        stage.result["tet_count"] = 2500

Files are written to a work folder and enter the branch folder together when the block ends without
an error; otherwise the folder stays unchanged (:mod:`limber.store.journal`). One program at a time
writes (:mod:`limber.store.lock`), any number read (:meth:`Branch.read`, which changes nothing). The
next writer finishes or removes the leftovers of killed programs.
"""

import json
import os
import shutil
import time
import uuid
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any

from pydantic import BaseModel

from limber.core.constants import GRAVITY
from limber.core.errors import BranchFolderError, Command, Option
from limber.core.files.atomic import file_digest, owned_name, sweep
from limber.core.files.reading import checked_as
from limber.core.json_values import plain, stored
from limber.store import journal
from limber.store.disk_errors import gone, in_words, require_room, require_there
from limber.store.folder_state import (
    Checker,
    Damage,
    begin,
    damage_error,
    drop_empty,
    finish_pending,
    inside,
    is_litter,
    opening,
    refuse_links,
    settle,
)
from limber.store.journal import Stream
from limber.store.lock import commit_lock, run_lock
from limber.store.manifest import (
    MANIFEST,
    RESULTS,
    FileEntry,
    Manifest,
    StageEntry,
    checked_name,
    program_versions,
    read_manifest,
    results_version,
    version_entry,
)

_STREAMS = ".streams"


class OpenStage:
    """A stage in progress. ``path`` gives the path to write to; ``result`` goes to the manifest."""

    def __init__(self, folder: Path, manifest: Manifest, streams: Path):
        self._folder = folder
        self._streams = streams
        self.manifest = manifest
        self.result: dict[str, Any] = {}
        self.removes: set[str] = set()
        self.adopted: list[Path] = []

    def path(self, name: str) -> Path:
        """Return the path for writing file ``name`` (relative, ``/``) of the branch folder.

        Raises:
            WorkError: the branch folder no longer exists.
        """
        path = self._folder / checked_name(name)
        if not self._folder.is_dir():
            # Not created again: below the empty mount point of a lost disk is another disk.
            raise gone(self._folder.parent)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def write(self, name: str, content: Any, *, indent: int | None = 1) -> None:
        """Write a text, or anything else as rounded JSON (:func:`stored`), as file ``name``."""
        text = content if isinstance(content, str) else json.dumps(
            stored(plain(content)), indent=indent, allow_nan=False) + "\n"
        self.path(name).write_text(text, encoding="utf-8")

    def remove(self, name: str) -> None:
        """Drop file ``name`` of an earlier run when this stage succeeds."""
        self.removes.add(checked_name(name))

    def adopt(self, name: str) -> None:
        """Take over the content of the closed stream ``name`` as the file ``name``."""
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
    def uuid(self) -> str:
        """Identifier of the branch, independent of its folder."""
        return self.manifest.uuid

    @property
    def gravity(self) -> tuple[float, float, float]:
        """Gravity [m/s^2] in the branch's frame; the upright rotation of a scan rotates it too."""
        found = self.made.result.get("gravity_m_s2", GRAVITY) if self.made else GRAVITY
        return checked_as(self.folder / MANIFEST, tuple[float, float, float], found, "gravity")

    @property
    def made(self) -> StageEntry | None:
        """The entry of the stage that made the mesh; None before it."""
        return self.manifest.stages.get("reconstruct") or self.manifest.stages.get("mesh")

    @classmethod
    def create(cls, folder: str | os.PathLike) -> "Branch":
        """Open ``folder`` if it is a branch folder, make a new one if it is empty or missing.

        Raises:
            BranchFolderError: it holds other files, or cannot be made or written to.
        """
        folder = Path(folder)
        refuse_links(folder)
        if (folder / MANIFEST).exists() or journal.is_pending(folder):
            return cls.open(folder)
        if folder.is_dir() and any(not is_litter(p.name) for p in folder.iterdir()):
            raise BranchFolderError(
                f"{folder} exists and is not a branch folder.",
                f"It contains files but no {MANIFEST}. Writing there could overwrite them.",
                "Name a new folder with -o, for example NAME.branch.")
        name = folder.name.removesuffix(".branch") or folder.resolve().name.removesuffix(".branch")
        begin(folder, Manifest(uuid=str(uuid.uuid4()), name=name))
        return cls.open(folder)

    @classmethod
    def open(cls, folder: str | os.PathLike, *, verify: bool = False) -> "Branch":
        """Open an existing branch folder to write to it; an interrupted commit is finished.

        A file is compared with its checksum when it is used (:meth:`path`). A damaged file thus
        stops the stages that need it, but not the stage that makes it again; ``verify`` compares
        all.

        Raises:
            BranchFolderError: not a branch folder, damaged, of a newer format, or with links or
                names that lead out of it.
        """
        folder = Path(folder)
        with opening(folder):
            finish_pending(folder)
            branch = cls(folder, read_manifest(folder))
        if verify:
            branch.verify()
        return branch

    @classmethod
    def read(cls, folder: str | os.PathLike, *, unfinished: bool = False) -> "Branch":
        """Open an existing branch folder only to read it; it is not changed.

        If another program is committing results, it waits until that is finished.

        Args:
            unfinished: Read a folder with an interrupted commit as it will be when that is
                finished. Only :meth:`damages` finds the files that are not in place yet.

        Raises:
            BranchFolderError: as for :meth:`open`; or a commit was interrupted, and ``unfinished``
                is not set.
        """
        folder = Path(folder)
        with opening(folder, only_reads=True):
            settle(folder, unfinished=unfinished)
            return cls(folder, journal.current_manifest(folder), only_reads=True)

    @property
    def is_unfinished(self) -> bool:
        """Whether an interrupted command left results that are not in place yet."""
        return journal.is_pending(self.folder)

    def path(self, name: str) -> Path:
        """Return the path of file or folder ``name``, whether it exists or not.

        Raises:
            BranchFolderError: the manifest lists it, or files in it, and they are damaged.
        """
        name = checked_name(name)
        path = inside(self.folder, name)
        self._check(n for n in self.manifest.files if n == name or n.startswith(name + "/"))
        return path

    def has(self, name: str) -> bool:
        return name in self.manifest.files and (self.folder / checked_name(name)).is_file()

    def require(self, name: str, made_by: str, *options: Option) -> Path:
        """Return the path of file ``name``; ``made_by`` is the command that would make it.

        Raises:
            BranchFolderError: the file is not there.
        """
        if not self.has(name):
            raise BranchFolderError(f"{self.folder} has no {name}.", "The stage that writes it has "
                                    "not been run.", "Run ", Command(made_by, *options), " first.")
        return self.path(name)

    def names(self, folder: str) -> list[str]:
        """Return the names of the entries under ``folder`` (``pulls``, ``plans``), sorted."""
        prefix = folder.rstrip("/") + "/"
        below = (name[len(prefix):] for name in self.manifest.files if name.startswith(prefix))
        return sorted({PurePosixPath(name).parts[0] for name in below})

    def verify(self) -> None:
        """Compare every file with the manifest.

        Raises:
            BranchFolderError: a file is missing or its bytes have changed; names each.
        """
        self._check(self.manifest.files)

    def damages(self) -> list[Damage]:
        """Return the damage of the folder's files; empty if all are as written."""
        return self._checker.damages(self.manifest, sorted(self.manifest.files))

    def _check(self, names: Iterable[str]) -> None:
        damages = self._checker.damages(self.manifest, names)
        if not damages:
            return
        if self._only_reads:
            settle(self.folder)
        else:
            finish_pending(self.folder)
        now = read_manifest(self.folder).files
        renewed = [d.name for d in damages if now.get(d.name) != self.manifest.files[d.name]]
        if renewed:
            raise BranchFolderError(
                f"Another run replaced or removed {', '.join(renewed[:4])} of {self.folder} while "
                "this one was reading.", "The data that were read no longer belong "
                                               "together.",
                "Run this again.")
        raise damage_error(self.folder, damages)

    @contextmanager
    def writing(self, purpose: str) -> Iterator[None]:
        """Hold the right to write to this folder, and remove the leftovers of killed programs.

        :meth:`stage` acquires it itself; a stage that starts work long before acquires it first.

        Args:
            purpose: Text for the user of another program that finds the folder locked.

        Raises:
            BranchFolderError: another program has it locked; states which and since when.
            WorkError: the disk is full or nearly so, or the folder is lost, now or later.
        """
        require_there(self.folder)
        with in_words(self.folder), run_lock(self.folder, purpose) as is_first:
            if is_first:
                sweep(self.folder)
                require_room(self.folder, purpose)
            yield

    @contextmanager
    def dropped_if_empty(self) -> Iterator[None]:
        """Remove the folder if the block fails before it has any result, so that no half-made
        branch is left.
        """
        try:
            yield
        except BaseException:
            if not self.manifest.stages:
                drop_empty(self.folder)
            raise

    def stream(self, name: str) -> Stream:
        """Open the stream ``name``, new or left by a program that ended; see :class:`Stream`.

        It stays beside the branch's files until a stage takes it over (:meth:`OpenStage.adopt`).
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
        current = self._read_digests(reads, digests)
        intact = all(name in self.manifest.files
                     and not self._checker.trouble(name, self.manifest.files[name])
                     for name in entry.writes if self._owner(name) == key)
        return (intact and entry.reads == current and entry.settings == plain(settings or {})
                and entry.programs.get(RESULTS, "1") == results_version(settings))

    @contextmanager
    def stage(self, key: str, settings: BaseModel | Mapping[str, Any] | None = None, *,
              reads: Iterable[str] = (), digests: Mapping[str, str] | None = None,
              ) -> Iterator[OpenStage]:
        """Run stage ``key``; see the module's docstring.

        Args:
            key: The stage's name, with the entry's if there are several ("plan:to-light").
            settings: Values that determine the result in addition to the inputs; stored as plain
            JSON.
            reads: Names of files of this folder that the stage reads.
            digests: Further inputs, label to digest (an external file, part of a file).
        """
        started = time.perf_counter()
        with self.writing(f"the stage {key}"):
            read = self._read_digests(reads, digests)
            work = self.folder / owned_name(f"stage-{_short(key)}")
            work.mkdir()
            try:
                stage = OpenStage(work, self.manifest.model_copy(deep=True), self.folder / _STREAMS)
                yield stage
                entry = StageEntry(
                    settings=plain(settings or {}), reads=read, writes=stage.written(),
                    result=stored(plain(stage.result)),
                    programs=program_versions() | version_entry(settings),
                    seconds=round(time.perf_counter() - started, 3),
                    finished=datetime.now(UTC).isoformat(timespec="seconds"))
                self._commit(key, entry, stage, work)
            finally:
                shutil.rmtree(work, ignore_errors=True)
            for path in stage.adopted:
                path.unlink(missing_ok=True)

    def _commit(self, key: str, entry: StageEntry, stage: OpenStage, work: Path) -> None:
        written = {name: FileEntry(sha256=file_digest(work / name),
                                   bytes=(work / name).stat().st_size, stage=key)
                   for name in entry.writes}
        require_there(self.folder)
        with commit_lock(self.folder):
            # An entry left by a killed program comes first: its files already count.
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
                "The stage that writes it has not been run.", "Run the earlier stages first.")
        self._check(reads)
        return {name: self.digest(name) for name in reads} | dict(digests or {})


def _short(key: str) -> str:
    return "".join(c if c.isalnum() or c in "-_" else "-" for c in key)[:60]
