"""The content of a job file: branches, and the stages to run on each."""

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from limber.core.json_values import plain
from limber.core.processes import Limits
from limber.core.settings import Settings


@dataclass(frozen=True)
class StageTask:
    """A stage to run on a branch, with checked inputs, settings and options."""

    stage: str
    inputs: Settings
    settings: Settings
    options: Settings

    @property
    def label(self) -> str:
        """The stage's name, with the name of its result if there may be several."""
        name = getattr(self.inputs, "name", None) or getattr(self.settings, "name", None)
        return f"{self.stage}:{name}" if name else self.stage

    @property
    def fingerprint(self) -> str:
        """The task without its options: the same text for the same task."""
        content = json.dumps([self.stage, plain(self.inputs), plain(self.settings)], sort_keys=True)
        return hashlib.sha256(content.encode("utf-8")).hexdigest()[:16]


@dataclass(frozen=True)
class BranchJob:
    """The stages to run on one branch, in this order; ``sweep`` contains its own values.

    ``fetched`` has the addresses of its inputs and their local paths, ``home`` the address of the
    branch folder itself, or an empty text.
    """

    name: str
    folder: Path
    tasks: tuple[StageTask, ...]
    sweep: dict[str, Any] = field(default_factory=dict)
    fetched: tuple[tuple[str, Path], ...] = ()
    home: str = ""

    @property
    def is_moved(self) -> bool:
        """Whether it, or one of its inputs, is remote."""
        return bool(self.fetched or self.home)


@dataclass(frozen=True)
class JobFile:
    """A checked job file; ``limits`` hold for each stage, ``home`` is the address of results."""

    path: Path
    out: Path
    branches: tuple[BranchJob, ...]
    workers: int | None = None
    cluster: str | None = None
    limits: Limits = field(default_factory=Limits)
    home: str = ""
