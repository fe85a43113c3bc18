"""The manifest ``branch.json``: the content of a branch folder, and its sources."""

import functools
import hashlib
import json
import platform
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from limber.core.alignment import Alignment
from limber.core.errors import BranchFolderError, Command, InputError
from limber.core.files.reading import read_json
from limber.core.files.safe_names import relative_name
from limber.core.json_values import first_refusal, plain, validated
from limber.core.machine_errors import machine_error
from limber.version import VERSION

FORMAT_VERSION = 2
MANIFEST = "branch.json"
RESULTS = "results"
"""Among a stage's programs: the version of its settings' results; see limber.core.settings."""
REPORT = "report"
"""The stage that shows the results of all others."""
_PROGRAMS = ("numpy", "scipy", "cvxopt", "pytetwild", "robust_laplacian", "ompl")


class FileEntry(BaseModel):
    """An entry of the manifest for one file: its bytes, and the stage that wrote it."""

    model_config = ConfigDict(extra="forbid")

    sha256: str
    bytes: int
    stage: str


class StageEntry(BaseModel):
    """One finished stage: settings, files read (name to sha256) and written, and result."""

    model_config = ConfigDict(extra="forbid")

    settings: dict[str, Any]
    reads: dict[str, str]
    writes: list[str]
    result: dict[str, Any]
    programs: dict[str, str]
    seconds: float
    finished: str


class Manifest(BaseModel):
    """Content of ``branch.json``; ``uuid`` names the branch wherever its folder is."""

    model_config = ConfigDict(extra="forbid")

    format_version: int = FORMAT_VERSION
    uuid: str
    name: str
    unit: str = "m"
    created_with: str = f"limber {VERSION}"
    source: dict[str, Any] = Field(default_factory=dict)
    alignment: Alignment = Field(default_factory=Alignment)
    stages: dict[str, StageEntry] = Field(default_factory=dict)
    files: dict[str, FileEntry] = Field(default_factory=dict)

    def text(self) -> str:
        """Return the manifest as it is written."""
        return json.dumps(plain(self.model_dump(mode="json")), indent=1, allow_nan=False) + "\n"

    def content_digest(self) -> str:
        """Return a sha256 of all contents of the branch except its report."""
        held = {"files": {name: entry.sha256 for name, entry in self.files.items()
                          if entry.stage != REPORT},
                "stages": {key: entry.model_dump(mode="json") for key, entry in self.stages.items()
                           if key != REPORT}}
        return hashlib.sha256(json.dumps(held, sort_keys=True).encode()).hexdigest()


def read_manifest(folder: Path) -> Manifest:
    """Read a folder's manifest. BranchFolderError if there is none, it is damaged, of a newer
    format or lists a file outside the folder; WorkError if its disk does not respond."""
    path = folder / MANIFEST
    if not path.is_file():
        raise BranchFolderError(
            f"{folder} has no {MANIFEST}.", "It is not a branch folder.",
            "Name a folder that ", Command("reconstruct"), " or ", Command("mesh"), " made.")
    try:
        content = read_json(path, "a manifest")
    except InputError as error:
        if isinstance(error.__cause__,
                      OSError) and (translated := machine_error(error.__cause__, path)):
            raise translated from error
        raise BranchFolderError(
            error.seen, "The manifest is damaged.",
            "Restore it from a copy, or reconstruct into a new folder.") from error
    version = content.get("format_version") if isinstance(content, dict) else None
    if isinstance(version, int) and version > FORMAT_VERSION:
        raise BranchFolderError(
            f"{folder} has format {version}; this Limber ({VERSION}) reads up to {FORMAT_VERSION}.",
            "It was made by a newer Limber.", "Update Limber.")
    try:
        manifest = validated(Manifest, content)
    except ValidationError as error:
        raise BranchFolderError(
            f"{path}: {first_refusal(error)}.", "The manifest is damaged.",
            "Restore it from a copy, or reconstruct into a new folder.") from error
    _require_inside(path, manifest)
    return manifest


def checked_name(name: str) -> str:
    """Return the name of a file in a branch folder, relative with ``/``; InputError if it is
    outside the folder, or is one of the folder's own."""
    plain = relative_name(name)
    # Windows takes what follows a colon for a stream of the file before it.
    if plain.casefold().partition(":")[0] == MANIFEST or plain.startswith("."):
        raise InputError(f"{name!r} cannot be used as a file name in a branch folder.",
                         f"{MANIFEST} and names that begin with a dot are reserved.",
                         "Use another name.")
    return plain


def _require_inside(path: Path, manifest: Manifest) -> None:
    """Refuse a manifest that lists a file outside its folder: commands remove and write those."""
    for name in (*manifest.files, *(name for stage in manifest.stages.values()
                                    for name in stage.writes)):
        try:
            checked_name(name)
        except InputError as error:
            raise BranchFolderError(
                f"{path} lists a file {name[:200]!r}. {error.why}",
                "The manifest is damaged or was tampered with. Nothing was changed.",
                "Get the folder from its source again, or reconstruct into a new one.",
            ) from error


def program_versions() -> dict[str, str]:
    """Return the installed versions of Limber, Python and the numerical packages."""
    return dict(_installed())


@functools.cache
def _installed() -> tuple[tuple[str, str], ...]:
    found = {"limber": VERSION, "python": platform.python_version()}
    for name in _PROGRAMS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return tuple(found.items())


def results_version(settings: BaseModel | Mapping[str, Any] | None) -> str:
    """Return the version of the results of a stage with these settings."""
    return str(getattr(type(settings), "results_version", 1))


def version_entry(settings: BaseModel | Mapping[str, Any] | None) -> dict[str, str]:
    """Return it as an entry of a stage's programs; the first version has none."""
    version = results_version(settings)
    return {} if version == "1" else {RESULTS: version}
