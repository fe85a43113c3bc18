"""The paths that a job file names; a remote file gets a local path."""

import glob
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from limber.batch.jobs.problems import Problems
from limber.batch.jobs.toml_positions import KeyPath
from limber.batch.remote_files import checked_address, is_address, matching, plain_name
from limber.core.errors import LimberError
from limber.store.manifest import MANIFEST


class JobPaths:
    """Finds the files that a job file names, and remembers their addresses.

    Args:
        folder: Folder of the job file: paths in it are relative to it.
        problems: Collects the errors of a path, with its position in the job file.

    Attributes:
        out: Folder of results and fetched files.
        home: The address of results; empty if they stay in ``out``.
    """

    def __init__(self, folder: Path, problems: Problems):
        self._folder, self._problems = folder, problems
        self._known: dict[Path, str] = {}
        self.out = folder
        self.home = ""

    def read_out(self, out: str, work: str, otherwise: str) -> None:
        """Results go to a folder; or to an address, with a local working folder."""
        self.out = self._folder / otherwise
        if work and (is_address(work) or not is_address(out)):
            self._problems.add(
                ("work",), "work must be a folder on this computer, and needs an address in "
                           "`out`.")
        elif is_address(out):
            self.home = self._tried(checked_address, out, ("out",)) or ""
            self.out = self._folder / (work or otherwise)
        elif out:
            self.out = self._folder / out

    def files(self, pattern: str, key_path: KeyPath) -> list[Path] | None:
        """Return the files that a pattern names, sorted; None if it was refused."""
        if not is_address(pattern):
            return [self._folder / name for name in sorted(
                glob.glob(pattern, root_dir=self._folder, recursive=True))]
        found = self._tried(matching, pattern, key_path)
        return None if found is None else [self._file(each, key_path) for each in found]

    def folders(self, pattern: str, key_path: KeyPath) -> list[Path] | None:
        """Return the branch folders that a pattern names; None if it was refused."""
        if not is_address(pattern):
            return [path for path in self.files(pattern, key_path) or ()
                    if (path / MANIFEST).is_file()]
        found = self._tried(matching, f"{pattern.rstrip('/')}/{MANIFEST}", key_path)
        return None if found is None else [
            self._here(each.removesuffix(f"/{MANIFEST}"), self.out, key_path) for each in found]

    def file(self, name: str, key_path: KeyPath) -> Path:
        """Return the path of one file or folder."""
        if not is_address(name):
            return self._folder / name
        address = self._tried(checked_address, name, key_path)
        return self._file(address, key_path) if address else self.out

    def written(self, name: str, key_path: KeyPath) -> Path:
        """Return the path for a stage's output file: never outside ``out``."""
        path = (self.out / name).resolve()
        if is_address(name):
            if self._tried(checked_address, name, key_path):
                self._problems.add(
                    key_path, f"{name!r} is an address. Stages write their files to `out` only.")
        elif not path.is_relative_to(self.out.resolve()):
            self._problems.add(key_path, f"{name!r} is outside {self.out}.")
        return path

    def address_of(self, path: Path) -> str:
        """Return the address of a path; an empty text for a local one."""
        return self._known.get(path, "")

    def fetched(self, paths: list[Path]) -> tuple[tuple[str, Path], ...]:
        """Return address and path of the files that must be fetched."""
        return tuple((self._known[path], path) for path in dict.fromkeys(paths)
                     if path in self._known)

    def _tried(self, function: Callable[[str], Any], address: str, key_path: KeyPath) -> Any:
        """Return ``function(address)``; None if it refuses the address."""
        try:
            return function(address)
        except LimberError as error:
            self._problems.add(key_path, str(error))
            return None

    def _file(self, address: str, key_path: KeyPath) -> Path:
        """Return the local path of a file or folder; neighbours stay neighbours."""
        around = address.rpartition("/")[0]
        own = hashlib.sha256(around.encode("utf-8")).hexdigest()[:12]
        return self._here(address, self.out / ".inputs" / own, key_path)

    def _here(self, address: str, folder: Path, key_path: KeyPath) -> Path:
        name = self._tried(plain_name, address, key_path)
        if name is None:
            return folder / "refused"
        self._known[folder / name] = address
        return folder / name
