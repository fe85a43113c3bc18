"""Reads ``branch.json`` of a branch folder: stages, their results, its scan. No bpy.

Only the worker writes it. An unreadable file counts as missing; the worker reports why.
"""

import hashlib
import json
import stat
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from ..jobs.stages import Stage, stages

MANIFEST = "branch.json"


@dataclass(frozen=True)
class StageRecord:
    """A branch folder's record of a stage that has run."""

    settings: dict[str, Any]
    reads: dict[str, str]
    result: dict[str, Any]
    finished: str


@dataclass(frozen=True)
class BranchRecord:
    """A branch folder's contents: stages by key, the sha256 of its scan, and its own identity.

    ``files`` has, by name, each file's sha256 and the key of the stage that wrote it.
    """

    name: str
    stages: dict[str, StageRecord]
    files: dict[str, tuple[str, str]]
    scan_sha256: str
    uuid: str = ""

    def of(self, stage: Stage, values: Mapping[str, Any]) -> StageRecord | None:
        """Return the record of a stage if it were run with these values."""
        key = stage.key.format_map({"name": values.get("name", "")}) if stage.key else ""
        record = self.stages.get(key)
        # Two stages may make the same file (a pull): the settings show which one did. An older
        # version may have had others.
        return record if record and len(stage.fields.keys() & record.settings.keys()) == max(
            len(other.fields.keys() & record.settings.keys()) for other in stages().values()
            if other.key == stage.key) else None

    def has(self, patterns: Iterable[str]) -> bool:
        """Whether the folder has a file for each of these: its name, or the start of one."""
        return all(any(name.startswith(pattern.split("{name}")[0]) for name in self.files)
                   for pattern in patterns)

    def names(self, pattern: str) -> list[str]:
        """Return the names of the folder's entries, sorted.

        Args:
            pattern: A file with ``{name}`` in it, such as ``plans/{name}.csv``; or, ending with a
                colon, the start of a stage's key, such as ``target:``.
        """
        if pattern.endswith(":"):
            return sorted(key.removeprefix(pattern) for key in self.stages
                          if key.startswith(pattern))
        before, after = pattern.split("{name}")
        found = {file.removeprefix(before).removesuffix(after) for file in self.files
                 if file.startswith(before) and file.endswith(after)}
        return sorted(name for name in found if name and "/" not in name)

    def is_stale(self, stage: Stage, record: StageRecord) -> bool:
        """Whether another stage has since rewritten an input of this stage."""
        for name, (digest, maker) in self.files.items():
            if not any(name == read or (read.endswith("/") and name.startswith(read))
                       for read in stage.reads):
                continue
            if name in record.reads:
                if record.reads[name] != digest:
                    return True
            # It read a part of the file: then the time has to decide.
            elif (made := self.stages.get(maker)) and made is not record and (
                    made.finished > record.finished):
                return True
        return False


def read_record(folder: Path) -> BranchRecord | None:
    """Return the record of ``folder``; None if it is not a branch folder, or is damaged."""
    path = Path(folder) / MANIFEST
    try:
        about = path.stat()
    except OSError:
        return None
    if not stat.S_ISREG(about.st_mode):
        # Blender would wait for the writer of a pipe.
        return None
    return _read(path, about.st_mtime_ns, about.st_size)


@lru_cache(maxsize=8)
def _read(path: Path, _changed: int, _size: int) -> BranchRecord | None:
    """Read once for each state of the file: panels ask at every redraw."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        stages = {key: StageRecord(dict(entry["settings"]), dict(entry["reads"]),
                                   dict(entry["result"]), str(entry["finished"]))
                  for key, entry in content["stages"].items()}
        files = {name: (entry["sha256"], entry["stage"])
                 for name, entry in content["files"].items()}
        return BranchRecord(str(content["name"]), stages, files,
                            str(content.get("source", {}).get("sha256", "")),
                            str(content.get("uuid") or ""))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None


def file_sha256(path: Path) -> str:
    """Return the sha256 of a file, computed once for each of its states."""
    about = path.stat()
    return _sha256(path, about.st_mtime_ns, about.st_size)


@lru_cache(maxsize=16)
def _sha256(path: Path, _changed: int, _size: int) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def folder_for(scan: Path) -> Path:
    """Return the branch folder of a scan: the existing one beside it, or a new one."""
    digest = file_sha256(scan)
    for number in range(1, 1000):
        folder = scan.with_name(f"{scan.stem}{'' if number == 1 else f'-{number}'}.branch")
        if belongs(folder, digest):
            return folder
    raise ValueError(f"There are already a thousand branch folders of other scans beside {scan}. "
                     "Choose a folder yourself.")


def is_of(folder: Path, digest: str) -> bool:
    """Whether ``folder`` is the branch made of the scan with this sha256."""
    record = read_record(folder)
    return record is not None and record.scan_sha256 == digest


def belongs(folder: Path, digest: str) -> bool:
    """Whether ``folder`` is new, empty or that of the scan with this sha256."""
    record = read_record(folder)
    if record is not None:
        return record.scan_sha256 in ("", digest)
    return not folder.exists() or (folder.is_dir() and not any(folder.iterdir()))
