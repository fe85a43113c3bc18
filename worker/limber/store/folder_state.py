"""Checks of a branch folder before it is read: it exists, is complete and has no links."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from limber.core.errors import BranchFolderError, InputError
from limber.core.files import safe_names
from limber.core.files.atomic import flush_folder, write_atomically
from limber.core.files.temporary_names import is_owned_name, owned_name, sweep, sweep_beside
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
from limber.store.manifest import MANIFEST, Manifest, read_manifest


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
    """Return the manifest of a branch folder, after finishing an interrupted commit.

    For callers that copy a folder without reading it.

    Raises:
        BranchFolderError: as for :func:`~limber.store.manifest.read_manifest`; or it has links.
    """
    refuse_links(folder)
    finish_pending(folder)
    return read_manifest(folder)


@contextmanager
def opening(folder: Path, *, only_reads: bool = False) -> Iterator[None]:
    """Refuse a folder that does not exist, has links, or is too deep for Windows; report a lost
    disk.
    """
    require_short(folder, 0 if only_reads else NAME_ROOM)
    with in_words(folder):
        if not folder.is_dir():
            raise BranchFolderError(
                f"There is no folder {folder}.", "A branch folder was expected.",
                "Make one with `limber reconstruct CLOUD -o NAME.branch`.")
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
    """Remove a branch folder with a manifest but no other content; keep any other.

    It is also kept if another program writes to it.
    """
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
