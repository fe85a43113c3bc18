"""The branch folder ``NAME.branch/``: ordinary files and a manifest that vouches for them.

Every stage of the pipeline writes through :meth:`Branch.stage`::

    branch = Branch.create("apple.branch")
    with branch.stage("reconstruct", settings=settings, reads=["cloud.ply"]) as stage:
        write_mesh(stage.path("mesh.vtu"))
        stage.result["tet_count"] = 2500

Files are written beside the folder's own and enter it together when the block ends without an
error; otherwise the folder stays as it was. A process that dies in the middle of that last move
is finished by the next one that opens the folder (the journal is the folder ``.commit``).
"""

import hashlib
import json
import os
import platform
import shutil
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from filelock import FileLock, Timeout
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from limber.errors import BranchFolderError, InputError
from limber.version import VERSION

FORMAT_VERSION = 1
MANIFEST = "branch.json"
GRAVITY = (0.0, 0.0, -9.80665)
"""Standard gravity [m/s^2] along -z: that of a branch whose stages do not say otherwise."""

_COMMIT = ".commit"
_LOCK = ".lock"
_PROGRAMS = ("numpy", "scipy", "numba", "cvxopt", "pytetwild", "robust_laplacian", "ompl")


class FileEntry(BaseModel):
    """What the manifest vouches for: the bytes of one file, and which stage wrote them."""

    model_config = ConfigDict(extra="forbid")

    sha256: str
    bytes: int
    stage: str


class StageEntry(BaseModel):
    """One finished stage: its settings, what it read (name to sha256), wrote and found."""

    model_config = ConfigDict(extra="forbid")

    settings: dict[str, Any]
    reads: dict[str, str]
    writes: list[str]
    result: dict[str, Any]
    programs: dict[str, str]
    seconds: float
    finished: str


class Alignment(BaseModel):
    """From the input file's coordinates to the branch's: ``x = rotation (scale * p - origin)``.

    ``scale`` is metres per input unit, ``origin`` [m] the recentring in scaled input axes,
    ``rotation`` the upright turn. All three are kept so that a result can be taken back.
    """

    model_config = ConfigDict(extra="forbid")

    scale: float = 1.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[tuple[float, float, float], ...] = (
        (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Take input coordinates, shape [n, 3], to branch coordinates [m]."""
        return (np.asarray(points) * self.scale - self.origin) @ np.array(self.rotation).T

    def undo(self, points: np.ndarray) -> np.ndarray:
        """Take branch coordinates [m], shape [n, 3], back to those of the input file."""
        return (np.asarray(points) @ np.array(self.rotation) + self.origin) / self.scale


class Manifest(BaseModel):
    """Content of ``branch.json``."""

    model_config = ConfigDict(extra="forbid")

    format_version: int = FORMAT_VERSION
    name: str
    unit: str = "m"
    created_with: str = f"limber {VERSION}"
    source: dict[str, Any] = Field(default_factory=dict)
    alignment: Alignment = Field(default_factory=Alignment)
    stages: dict[str, StageEntry] = Field(default_factory=dict)
    files: dict[str, FileEntry] = Field(default_factory=dict)


class Stage:
    """A stage in progress. ``path`` gives where to write; ``result`` goes to the manifest."""

    def __init__(self, folder: Path, manifest: Manifest):
        self._folder = folder
        self.manifest = manifest
        self.result: dict[str, Any] = {}
        self.removes: set[str] = set()

    def path(self, name: str) -> Path:
        """Return where to write file ``name`` (relative, ``/``) of the branch folder."""
        path = self._folder / _checked_name(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def remove(self, name: str) -> None:
        """Drop file ``name`` of an earlier run when this stage ends well."""
        self.removes.add(_checked_name(name))

    def written(self) -> list[str]:
        """Return the names written so far, sorted."""
        files = (p for p in self._folder.rglob("*") if p.is_file())
        return sorted(p.relative_to(self._folder).as_posix() for p in files)


class Branch:
    """An opened branch folder."""

    def __init__(self, folder: Path, manifest: Manifest):
        self.folder = folder
        self.manifest = manifest
        self._verified: dict[str, tuple[int, int, str]] = {}

    @property
    def name(self) -> str:
        return self.manifest.name

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
        if (folder / MANIFEST).exists() or (folder / _COMMIT).exists():
            return cls.open(folder)
        if folder.is_dir() and any(p.name != _LOCK for p in folder.iterdir()):
            raise BranchFolderError(
                f"{folder} exists and is not a branch folder.",
                f"It has files but no {MANIFEST}; writing there could overwrite them.",
                "Name a new folder with -o, for example NAME.branch.")
        _make_writable(folder)
        name = folder.name.removesuffix(".branch") or folder.resolve().name.removesuffix(".branch")
        branch = cls(folder, Manifest(name=name))
        write_atomically(folder / MANIFEST, branch._manifest_text())
        return branch

    @classmethod
    def open(cls, folder: str | os.PathLike, *, verify: bool = False) -> "Branch":
        """Open an existing branch folder.

        A file is compared with its checksum when it is used (:meth:`path`), so that a damaged
        one stops what needs it but not the stage that makes it anew; ``verify`` compares all.

        Raises:
            BranchFolderError: not a branch folder, damaged, or of a newer format.
        """
        folder = Path(folder)
        if not folder.is_dir():
            raise BranchFolderError(
                f"There is no folder {folder}.", "A branch folder was expected.",
                "Make one with `limber reconstruct CLOUD -o NAME.branch`.")
        if (folder / _COMMIT).is_dir():
            with _locked(folder):
                _roll_forward(folder)
        branch = cls(folder, _read_manifest(folder))
        if verify:
            branch.verify()
        return branch

    def path(self, name: str) -> Path:
        """Return the path of file or folder ``name``, whether it exists or not.

        Raises:
            BranchFolderError: the manifest has it, or files in it, and they are damaged.
        """
        name = _checked_name(name)
        self._check(n for n in self.manifest.files if n == name or n.startswith(name + "/"))
        return self.folder / name

    def has(self, name: str) -> bool:
        return name in self.manifest.files and (self.folder / _checked_name(name)).is_file()

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

    def _check(self, names: Iterable[str]) -> None:
        wrong = {name: trouble for name in names if (trouble := self._trouble(name))}
        if not wrong:
            return
        shown = [f"{name} ({trouble})" for name, trouble in list(wrong.items())[:4]]
        more = f" and {len(wrong) - 4} more" if len(wrong) > 4 else ""
        stages = sorted({self.manifest.files[name].stage for name in wrong})
        raise BranchFolderError(
            f"Damaged files in {self.folder}: {', '.join(shown)}{more}.",
            "They differ from the checksums written when they were made.",
            f"Restore them from a copy, or run again with --force: {', '.join(stages)}.")

    def _trouble(self, name: str) -> str:
        """Say what is wrong with a file, or "": read again only when its time or size changed."""
        path, entry = self.folder / name, self.manifest.files[name]
        if not path.is_file():
            return "missing"
        about = path.stat()
        if about.st_size != entry.bytes:
            return f"{about.st_size} bytes where {entry.bytes} were written"
        state = (about.st_mtime_ns, about.st_size, entry.sha256)
        if self._verified.get(name) != state:
            if file_digest(path) != entry.sha256:
                return "other content"
            self._verified[name] = state
        return ""

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
                     and not self._trouble(name)
                     for name in entry.writes if self._owner(name) == key)
        return intact and entry.reads == wanted and entry.settings == plain(settings or {})

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
        read = self._read_digests(reads, digests)
        work = Path(tempfile.mkdtemp(prefix=f".{key.replace(':', '-')}-", dir=self.folder))
        try:
            stage = Stage(work, self.manifest.model_copy(deep=True))
            yield stage
            entry = StageEntry(
                settings=plain(settings or {}), reads=read, writes=stage.written(),
                result=plain(stage.result), programs=program_versions(),
                seconds=round(time.perf_counter() - started, 3),
                finished=datetime.now(UTC).isoformat(timespec="seconds"))
            self._commit(key, entry, stage, work)
        finally:
            shutil.rmtree(work, ignore_errors=True)

    def _commit(self, key: str, entry: StageEntry, stage: Stage, work: Path) -> None:
        with _locked(self.folder):
            manifest = _read_manifest(self.folder)
            manifest.alignment, manifest.source = stage.manifest.alignment, stage.manifest.source
            manifest.unit = stage.manifest.unit
            manifest.stages[key] = entry
            for name in stage.removes - set(entry.writes):
                manifest.files.pop(name, None)
            for name in entry.writes:
                path = work / name
                manifest.files[name] = FileEntry(
                    sha256=file_digest(path), bytes=path.stat().st_size, stage=key)
            self.manifest = manifest
            (work / MANIFEST).write_text(self._manifest_text(), encoding="utf-8")
            _flush_to_disk(work)
            os.replace(work, self.folder / _COMMIT)
            _roll_forward(self.folder)

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

    def _manifest_text(self) -> str:
        return json.dumps(self.manifest.model_dump(mode="json"), indent=1, allow_nan=False) + "\n"


def plain(value: Any) -> Any:
    """Return ``value`` as JSON has it: models, numpy and paths become dicts, lists, numbers.

    A number that is not finite becomes None: JSON has no NaN.
    """
    if isinstance(value, BaseModel):
        return plain(value.model_dump())
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple | set):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file so that a reader sees the old or the new content, never a part."""
    path = Path(path)
    data = content.encode("utf-8") if isinstance(content, str) else content
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def file_digest(path: str | os.PathLike) -> str:
    """Return the sha256 of a file's bytes, in hexadecimal."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def program_versions() -> dict[str, str]:
    """Return the versions of Limber, Python and the numerical packages that are installed."""
    found = {"limber": VERSION, "python": platform.python_version()}
    for name in _PROGRAMS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def _read_manifest(folder: Path) -> Manifest:
    path = folder / MANIFEST
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise BranchFolderError(
            f"{folder} has no {MANIFEST}.", "So it is not a branch folder.",
            "Name a folder that `limber reconstruct` or `limber mesh` made.") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise BranchFolderError(
            f"{path} is not readable JSON ({error}).", "The manifest is damaged.",
            "Restore it from a copy, or reconstruct into a new folder.") from error
    version = content.get("format_version") if isinstance(content, dict) else None
    if isinstance(version, int) and version > FORMAT_VERSION:
        raise BranchFolderError(
            f"{folder} has format {version}; this Limber ({VERSION}) reads up to {FORMAT_VERSION}.",
            "It was made by a newer Limber.", "Update Limber.")
    try:
        return Manifest.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise BranchFolderError(
            f"{path}: {place or 'content'}: {first['msg']}.", "The manifest is damaged.",
            "Restore it from a copy, or reconstruct into a new folder.") from error


def _checked_name(name: str) -> str:
    pure = PurePosixPath(name)
    inside = not pure.is_absolute() and ".." not in pure.parts and pure.parts
    if not inside or name in (MANIFEST, _LOCK, _COMMIT) or "\\" in name:
        raise InputError(f"{name!r} is not a name of a file in a branch folder.",
                         "It must be relative and stay inside.", "Use a plain name.")
    return pure.as_posix()


def _make_writable(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return
    except OSError as error:
        raise BranchFolderError(
            f"{folder} cannot be written to ({error.strerror}).",
            "Results go there.", "Choose another place with -o, or change its permissions.",
        ) from error


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    try:
        with FileLock(folder / _LOCK, timeout=60):
            yield
    except Timeout as error:
        raise BranchFolderError(
            f"{folder} has been locked by another Limber for a minute.",
            "Two stages must not enter results at once.", "Wait for it to end, or stop it.",
        ) from error


def _roll_forward(folder: Path) -> None:
    """Move the journal's files into place, the manifest last; safe to repeat."""
    commit = folder / _COMMIT
    if not commit.is_dir():
        return
    old = _read_manifest(folder) if (folder / MANIFEST).exists() else None
    for path in sorted(p for p in commit.rglob("*") if p.is_file()):
        name = path.relative_to(commit).as_posix()
        if name == MANIFEST:
            continue
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(path, target)
    if (commit / MANIFEST).exists():
        kept = _read_manifest(commit)
        for name in set(old.files if old else ()) - set(kept.files):
            (folder / name).unlink(missing_ok=True)
        os.replace(commit / MANIFEST, folder / MANIFEST)
    shutil.rmtree(commit)


def _flush_to_disk(folder: Path) -> None:
    for path in folder.rglob("*"):
        if path.is_file():
            with open(path, "rb") as stream:
                os.fsync(stream.fileno())
