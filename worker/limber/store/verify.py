"""The damage of a branch folder's files, compared with the checksums in its manifest."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from limber.core.errors import BranchFolderError
from limber.core.files.atomic import file_digest
from limber.core.files.temporary_names import is_owned_name
from limber.store import journal
from limber.store.manifest import MANIFEST, FileEntry, Manifest, read_manifest


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
    return BranchFolderError(
        f"Damaged files in {folder}: {listed}{more}.",
        "They differ from the checksums written when they were made.",
        f"Restore them from a copy, or run again with --force: {', '.join(stages)}.")


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
