"""The addresses that a job file names, and where what is there goes here."""

import hashlib
from collections.abc import Callable
from pathlib import Path

from limber.batch.addresses import checked_address, matching, plain_name
from limber.batch.jobs.toml_positions import Place
from limber.core.errors import InputError, LimberError
from limber.store.manifest import MANIFEST


class JobAddresses:
    """Gives what is at an address a path here, and keeps in mind that it does.

    Args:
        problem: Told what is wrong with an address, and its place in the job file.
    """

    def __init__(self, problem: Callable[[Place, str], None]):
        self._problem = problem
        self._known: dict[Path, str] = {}

    def of(self, path: Path) -> str:
        """Return the address of a path; nothing for what is here anyway."""
        return self._known.get(path, "")

    def checked(self, text: str, place: Place) -> str:
        """Return an address as it is used; nothing if it is refused."""
        try:
            return checked_address(text)
        except InputError as error:
            self._problem(place, str(error))
            return ""

    def folders(self, pattern: str, out: Path, place: Place) -> list[Path] | None:
        """Return where the branch folders go that a pattern names; None if it is refused."""
        found = self._listed(f"{pattern.rstrip('/')}/{MANIFEST}", place)
        return None if found is None else [
            self._here(each.removesuffix(f"/{MANIFEST}"), out, place) for each in found]

    def files(self, pattern: str, out: Path, place: Place) -> list[Path] | None:
        """Return where the files go that a pattern names; None if it is refused."""
        found = self._listed(pattern, place)
        return None if found is None else [self.file(each, out, place) for each in found]

    def file(self, address: str, out: Path, place: Place) -> Path:
        """Return where one file, or folder, goes: beside what stands beside it there."""
        around = address.rpartition("/")[0]
        own = hashlib.sha256(around.encode("utf-8")).hexdigest()[:12]
        return self._here(address, out / ".inputs" / own, place)

    def among(self, paths: list[Path]) -> tuple[tuple[str, Path], ...]:
        """Return address and path of those that have to be fetched."""
        return tuple((self._known[path], path) for path in dict.fromkeys(paths)
                     if path in self._known)

    def _listed(self, pattern: str, place: Place) -> list[str] | None:
        try:
            return matching(pattern)
        except LimberError as error:
            self._problem(place, str(error))
            return None

    def _here(self, address: str, folder: Path, place: Place) -> Path:
        try:
            path = folder / plain_name(address)
        except InputError as error:
            self._problem(place, str(error))
            return folder / "refused"
        self._known[path] = address
        return path
