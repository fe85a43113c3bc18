"""Remote branches and inputs: fetched before the stages run, uploaded afterwards.

The local branch folder is processed as any other. At its address its files have the same layout,
with the manifest last. A remote reader therefore finds the branch before or after a batch, or a
wrong checksum that reveals an interrupted transfer, which the next run completes.
"""

import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path

from limber.batch.batch_progress import path_of_page, path_of_table
from limber.batch.job_file import BranchJob, JobFile
from limber.batch.remote_files import (
    copy_here,
    fetch,
    put,
    read_bytes,
    remove,
    take_away,
)
from limber.core.errors import BranchFolderError, InputError, WorkError
from limber.core.files.atomic import file_digest, owned_name, sweep_beside, write_atomically
from limber.core.files.reading import read_json
from limber.store.folder_state import settled_manifest
from limber.store.manifest import MANIFEST, Manifest, checked_name, read_manifest

AT_ONCE = 2
"""Number of parallel transfers."""


def bring_in(branch: BranchJob, stop: Callable[[], None]) -> None:
    """Fetch the inputs of a branch, and the branch if missing here or changed remotely. WorkError
    if a file cannot be fetched; BranchFolderError if both copies were changed."""
    for address, path in branch.fetched:
        fetch(address, path, stop)
    if not branch.home:
        return
    theirs = read_bytes(f"{branch.home}/{MANIFEST}")
    if theirs is None or _is_unchanged(branch, theirs):
        return
    if (branch.folder / MANIFEST).is_file():
        # All local content was uploaded before the remote content was changed.
        old = branch.folder.with_name(owned_name(branch.folder.name))
        branch.folder.rename(old)
        remove(old)
    _download(branch, theirs, stop)


def put_out(jobs: JobFile, branch: BranchJob) -> None:
    """Upload the new files of a branch to its address, and those that its stages wrote beside it.
    WorkError if it cannot be written; BranchFolderError if the remote branch changed."""
    if (branch.folder / MANIFEST).is_file():
        _put_branch(branch)
    if jobs.home:
        for path in _beside(jobs, branch):
            put(path, f"{jobs.home}/{path.relative_to(jobs.out.resolve()).as_posix()}")


def put_summary(jobs: JobFile) -> None:
    """Upload the table and the page if the branches are remote."""
    for path in (path_of_table(jobs), path_of_page(jobs)):
        if jobs.home and path.is_file():
            put(path, f"{jobs.home}/{path.name}")


def _is_unchanged(branch: BranchJob, theirs: bytes) -> bool:
    """Whether the local branch is the one at its address, or newer; BranchFolderError if each has
    content that the other lacks."""
    path = branch.folder / MANIFEST
    if not path.is_file():
        return False
    # Files of a killed program come first: they are this branch.
    settled_manifest(branch.folder)
    remote_digest, known = hashlib.sha256(theirs).hexdigest(), _known(branch)
    here = file_digest(path)
    if here == remote_digest:
        _note(branch, here)
        return True
    if here != known != remote_digest:
        raise BranchFolderError(
            f"{branch.home} and {branch.folder} are different branches.",
            "Both have changed since one was copied from the other, or they were never the same "
            "branch.",
            f"Move {branch.folder} away to continue with the remote branch, or move the remote "
            "branch away to continue with the local one.")
    return remote_digest == known


def _download(branch: BranchJob, manifest: bytes, stop: Callable[[], None]) -> None:
    sweep_beside(branch.folder)
    made = branch.folder.with_name(owned_name(branch.folder.name))
    made.mkdir(parents=True)
    try:
        write_atomically(made / MANIFEST, manifest)
        for name, entry in read_manifest(made).files.items():
            target = made / checked_name(name)
            copy_here(f"{branch.home}/{name}", target, stop)
            if file_digest(target) != entry.sha256:
                raise WorkError(f"{branch.home}/{name} differs from its manifest.",
                                "It is damaged, or another program was writing it.",
                                "Wait until the program that writes it has ended, or restore the "
                                "file.")
        made.rename(branch.folder)
    finally:
        remove(made)
    _note(branch, hashlib.sha256(manifest).hexdigest())


def _put_branch(branch: BranchJob) -> None:
    theirs = read_bytes(f"{branch.home}/{MANIFEST}")
    if theirs is not None and not _is_unchanged(branch, theirs):
        raise BranchFolderError(f"Another program changed {branch.home} at the same time.",
                                f"The results of this run are in {branch.folder}.",
                                "Run only one batch at a time on this branch.")
    mine = settled_manifest(branch.folder)
    remote_files = _files(theirs)
    for name, entry in mine.files.items():
        if remote_files.pop(name, None) != entry.sha256:
            put(branch.folder / checked_name(name), f"{branch.home}/{name}")
    digest = file_digest(branch.folder / MANIFEST)
    if theirs is None or hashlib.sha256(theirs).hexdigest() != digest:
        put(branch.folder / MANIFEST, f"{branch.home}/{MANIFEST}")
    _note(branch, digest)
    for name in remote_files:
        take_away(f"{branch.home}/{name}")


def _files(manifest: bytes | None) -> dict[str, str]:
    """Names and checksums of a remote manifest; empty if it is damaged."""
    if manifest is None:
        return {}
    try:
        files = Manifest.model_validate_json(manifest).files
        return {checked_name(name): entry.sha256 for name, entry in files.items()}
    except ValueError:
        return {}


def _beside(jobs: JobFile, branch: BranchJob) -> Iterator[Path]:
    """Files that stages wrote into the results' folder, outside the branch's."""
    out, own = jobs.out.resolve(), branch.folder.resolve()
    fetched = {path.resolve() for _, path in branch.fetched}
    for task in branch.tasks:
        for value in (getattr(task, name) for name in task.parts()["inputs"]):
            path = value.resolve() if isinstance(value, Path) else None
            if path is None or path in fetched or not path.is_relative_to(out) or (
                    path.is_relative_to(own)):
                continue
            yield from sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else (
                [path] if path.is_file() else [])


def _mark(branch: BranchJob) -> Path:
    return branch.folder.with_name(f".{branch.folder.name}.home.json")


def _known(branch: BranchJob) -> str:
    """The manifest's checksum when the local and the remote branch were last the same."""
    try:
        record = read_json(_mark(branch), "a record of the fetched files")
    except InputError:
        # There is none, or it is damaged: then its state is unknown.
        return ""
    is_of_it = isinstance(record, dict) and record.get("address") == branch.home
    return str(record.get("manifest", "")) if is_of_it else ""


def _note(branch: BranchJob, digest: str) -> None:
    write_atomically(_mark(branch), json.dumps({"address": branch.home, "manifest": digest}))
