"""Checks of a branch folder before it is read: it exists, is complete and has no links."""

import contextlib
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from limber.core.errors import BranchFolderError, Command, InputError
from limber.core.files import safe_names
from limber.core.files.atomic import (
    file_digest,
    flush_folder,
    is_owned_name,
    owned_name,
    sweep,
    sweep_beside,
    write_atomically,
)
from limber.store import journal
from limber.store.disk_errors import NAME_ROOM, in_words, require_short
from limber.store.lock import (
    COMMIT_LOCK,
    HOLDER,
    RUN_LOCK,
    commit_lock,
    run_lock,
    wait_for_commit,
)
from limber.store.manifest import MANIFEST, FileEntry, Manifest, read_manifest


def begin(folder: Path, manifest: Manifest) -> None:
    """Make the folder with its manifest: a new one appears complete, an empty one is filled."""
    require_short(folder, NAME_ROOM)
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
            # Another program made it at the same time.
            return
        raise BranchFolderError(
            f"{folder} cannot be written to ({error.strerror}).",
            "Results are written there.",
            "Choose another folder with -o, or change its permissions.",
        ) from error


def settled_manifest(folder: Path) -> Manifest:
    """Return a folder's manifest after finishing an interrupted commit, for callers that only copy
    it. BranchFolderError as for :func:`~limber.store.manifest.read_manifest`, or for links."""
    refuse_links(folder)
    finish_pending(folder)
    return read_manifest(folder)


@contextmanager
def opening(folder: Path, *, only_reads: bool = False) -> Iterator[None]:
    """Refuse a folder that is missing, has links, or is too deep for Windows; report a lost
    disk."""
    require_short(folder, 0 if only_reads else NAME_ROOM)
    with in_words(folder):
        if not folder.is_dir():
            raise BranchFolderError(
                f"There is no folder {folder}.", "A branch folder was expected.",
                "Make one with ", Command("reconstruct", "CLOUD -o NAME.branch"), ".")
        refuse_links(folder)
        yield


def refuse_links(folder: Path) -> None:
    """Refuse a folder that contains links: they may lead out of it."""
    try:
        safe_names.refuse_links(folder)
    except InputError as error:
        raise BranchFolderError(error.seen, error.why, error.fix) from error


def inside(folder: Path, name: str) -> Path:
    """Return the path of ``name`` in a folder; refuse one outside the folder."""
    try:
        return safe_names.inside(folder, name)
    except InputError as error:
        raise BranchFolderError(error.seen, error.why, error.fix) from error


def settle(folder: Path, *, unfinished: bool = False) -> None:
    """Wait for a committing program; refuse an interrupted commit, unless ``unfinished``.
    """
    if journal.is_pending(folder):
        wait_for_commit(folder)
        if journal.is_pending(folder) and not unfinished:
            raise journal.unfinished_error(folder)


def drop_empty(folder: Path) -> None:
    """Remove a folder with nothing but a manifest, unless another program writes to it."""
    own = (COMMIT_LOCK, RUN_LOCK, HOLDER)
    # A file that cannot be removed stays: the user must see the original failure.
    with (contextlib.suppress(OSError, BranchFolderError),
          run_lock(folder, "removing an empty branch"), commit_lock(folder)):
        manifest = read_manifest(folder)
        if manifest.stages or manifest.files or {path.name for path in folder.iterdir()} - {
                MANIFEST, *own}:
            return
        # The locks are held until the end, so that no program starts to write meanwhile.
        for name in (MANIFEST, *own):
            (folder / name).unlink(missing_ok=True)
        folder.rmdir()


def finish_pending(folder: Path) -> None:
    """Finish the commit of a program that was killed during it."""
    if journal.is_pending(folder):
        with commit_lock(folder):
            journal.roll_forward(folder)


def is_litter(name: str) -> bool:
    """Whether a file of this name may be in a folder whose creation was interrupted."""
    return name in (COMMIT_LOCK, RUN_LOCK) or is_owned_name(name)


# The damage of a branch folder's files, compared with the checksums in its manifest.


@dataclass(frozen=True)
class Damage:
    """One damaged file: its name, its damage, and the stage that made it."""

    name: str
    trouble: str
    stage: str


class Checker:
    """Compares files with checksums; a file that has not changed since is not read again."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._verified: dict[str, tuple[int, int, str]] = {}

    def trouble(self, name: str, entry: FileEntry) -> str:
        """Return the damage of a file, or ""."""
        path = journal.current_path(self._folder, name)
        if not path.is_file():
            return "missing"
        about = path.stat()
        if about.st_size != entry.bytes:
            return f"{about.st_size} bytes instead of {entry.bytes}"
        state = (about.st_mtime_ns, about.st_size, entry.sha256)
        if self._verified.get(name) != state:
            if file_digest(path) != entry.sha256:
                return "other content"
            self._verified[name] = state
        return ""

    def damages(self, manifest: Manifest, names: Iterable[str]) -> list[Damage]:
        """Return the damage of these files of the manifest."""
        found = ((name, self.trouble(name, manifest.files[name])) for name in names)
        return [Damage(name, trouble, manifest.files[name].stage)
                for name, trouble in found if trouble]


def damage_error(folder: Path, damages: list[Damage], shown_count: int = 4) -> BranchFolderError:
    """Return the error that names the damaged files, the first ``shown_count`` of them."""
    listed = ", ".join(f"{d.name} ({d.trouble})" for d in damages[:shown_count])
    more = f" and {len(damages) - shown_count} more" if len(damages) > shown_count else ""
    stages = sorted({d.stage for d in damages})
    return BranchFolderError(f"Damaged files in {folder}: {listed}{more}.", "They differ from the "
                             "checksums written when they were made.", "Restore them from a copy, "
                             f"or run again: {', '.join(stages)}.")


def unlisted(folder: Path, manifest: Manifest) -> list[str]:
    """Return names of files that no stage wrote, without the folder's own hidden ones, sorted."""
    if journal.is_pending(folder):
        # Files that are removed when the commit is finished were also listed.
        listed = set(manifest.files) | set(read_manifest(folder).files)
    else:
        listed = set(manifest.files)
    names = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return sorted(name.as_posix() for name in names
                  if not name.parts[0].startswith(".") and not is_owned_name(name.name)
                  and name.as_posix() not in listed and name.as_posix() != MANIFEST)
