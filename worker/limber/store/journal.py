"""Commits a stage's files to a branch folder: all or none, even if the program is killed.

The work folder, with the new manifest in it, is renamed to ``.commit``. From that moment on, the
stage counts. Then its files are moved into position, the manifest last. Any program that finds a
``.commit`` finishes it first.
"""

import os
import shlex
import shutil
from collections.abc import Iterable
from pathlib import Path

from limber.core.errors import BranchFolderError
from limber.core.files.atomic import flush_folder, flush_tree
from limber.core.files.safe_names import inside
from limber.store.manifest import MANIFEST, Manifest, read_manifest

_COMMIT = ".commit"


def is_pending(folder: Path) -> bool:
    """Whether a killed program left a commit to finish, or a running one is in the middle of it."""
    return (folder / _COMMIT).is_dir()


def current_manifest(folder: Path) -> Manifest:
    """Return the valid manifest: that of a pending commit, if any. Changes no files.

    Raises:
        BranchFolderError: as for :func:`~limber.store.manifest.read_manifest`.
    """
    pending = folder / _COMMIT
    return read_manifest(pending if (pending / MANIFEST).exists() else folder)


def current_path(folder: Path, name: str) -> Path:
    """Return the path of file ``name`` of :func:`current_manifest`, in place or pending."""
    waiting = inside(folder, f"{_COMMIT}/{name}")
    return waiting if waiting.is_file() else inside(folder, name)


def unfinished_error(folder: Path) -> BranchFolderError:
    """Return the error of a read-only command that finds an interrupted commit."""
    return BranchFolderError(
        f"{folder} has results of an interrupted command that are not in place yet "
        f"({_COMMIT}).", "This command only reads, and changes nothing in the folder.",
        f"Run `limber verify {shlex.quote(str(folder))} --finish`, or any stage that writes to "
        "the folder. It puts the results in place. Then run this again.")


def commit(folder: Path, work: Path, manifest: Manifest) -> None:
    """Commit the files in ``work``, and ``manifest``; under the commit lock.

    Args:
        folder: The branch folder, without a pending commit.
        work: A folder in it with the new files under their names.
        manifest: The new content of ``branch.json``.

    Raises:
        BranchFolderError: an entry that is not a file of a branch is in the way; no file was
        committed.
    """
    _require_targets(folder, (path.relative_to(work).as_posix() for path in work.rglob("*")
                              if path.is_file()))
    (work / MANIFEST).write_text(manifest.text(), encoding="utf-8")
    flush_tree(work)
    os.replace(work, folder / _COMMIT)
    flush_folder(folder)
    roll_forward(folder)


def roll_forward(folder: Path) -> None:
    """Finish a pending commit, if any; under the commit lock. Safe to repeat from any point.

    Raises:
        BranchFolderError: a file cannot be replaced, or another entry is in its place.
    """
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
    """Refuse to commit files if a folder, or a pipe or file in place of a folder, is in the way.

    Checked before the first of them is moved: a commit that stops halfway would never end.
    """
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
