"""Trials of a campaign, kept as JSON lines as they are made: a stopped run goes on."""

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import TypeVar

from limber.plain import plain

Trial = TypeVar("Trial")


def source_digest(packages: Iterable[str], *own: str | Path) -> str:
    """Digest of what a trial depends on; one of other sources is not taken over.

    Args:
        packages: Folders of ``limber`` whose sources count.
        own: Further files: those of the campaign itself.
    """
    import limber

    here = Path(limber.__file__).parent
    files = [file for name in packages for file in sorted((here / name).rglob("*.py"))]
    return hashlib.sha256(b"".join(file.read_bytes() for file in [*files, *map(Path, own)])
                          ).hexdigest()[:16]


def read_trials(kind: type[Trial], kept: Path | None) -> list[Trial]:
    """Read the trials of a file, those of other sources too; a line cut off is left out."""
    if kept is None or not kept.is_file():
        return []
    trials = []
    for line in kept.read_text(encoding="utf-8").splitlines():
        try:
            record = json.loads(line)
        except json.JSONDecodeError:
            # The line that was being written when the run was stopped.
            continue
        trials.append(kind(**{key: tuple(value) if isinstance(value, list) else value
                              for key, value in record.items()}))
    return trials


def keep(trial: object, kept: Path | None) -> None:
    """Append a trial to a file, if there is one."""
    if kept is not None:
        with open(kept, "a", encoding="utf-8") as stream:
            stream.write(json.dumps(plain(asdict(trial))) + "\n")
