"""Trials of a campaign, kept as JSON lines as they are made: a stopped run continues."""

import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from benchmarks.budget import Budget, side_by_side
from limber.core.json_values import plain
from limber.core.progress import SILENT, Progress

Trial = TypeVar("Trial")
Task = TypeVar("Task")


@dataclass(frozen=True)
class Numbers:
    """Result of one trial: numbers by name.

    Attributes:
        part: Part of the benchmark's table.
        seed: Seed of all random numbers.
        source: Digest of the sources; trials of other sources do not count.
        values: JSON has no number that is not finite: such a number is read back as infinite.
    """

    part: str
    seed: int
    source: str
    values: dict[str, Any]

    def __post_init__(self) -> None:
        for name, value in self.values.items():
            if value is None:
                self.values[name] = np.inf


def numbers_of(part: str, seeds: Iterable[int], work: Callable[[int], Numbers], source: str,
               kept: Path | None, budget: Budget, workers: int | None = 1,
               progress: Progress = SILENT, at_least: int = 1) -> list[Numbers]:
    """Return the trials of a part by seed; :func:`go_on` documents which are made and kept."""
    own = [each for each in read_trials(Numbers, kept) if each.part == part]
    return go_on(own, list(seeds), lambda trial: trial.seed, work, source, kept, budget, workers,
                 progress, at_least=at_least)


def go_on(kept_trials: list[Trial], tasks: list[Task], key: Callable[[Trial], Task],
          work: Callable[[Any], Trial], source: str, kept: Path | None, budget: Budget,
          workers: int | None = 1, progress: Progress = SILENT,
          given: Callable[[list[Task]], list] = list, at_least: int = 1) -> list[Trial]:
    """Return the trials of ``tasks``, in their order: those kept, and as many new ones as fit.

    Args:
        kept_trials: From an earlier run; those of another ``source`` do not count.
        tasks: Tasks, the most important first.
        key: Returns the task of a trial.
        work: Makes the trial of a task, from the result of ``given``.
        source: Digest of the sources.
        kept: File to which new trials are appended, or None.
        budget: Time for the new ones.
        workers: Number of parallel processes; None: the number of cores.
        progress: Called after each.
        given: Turns the remaining tasks into arguments of ``work``.
        at_least: Least number of trials in the end, regardless of the time left.
    """
    wanted = set(tasks)
    known = {key(trial): trial for trial in kept_trials
             if trial.source == source and key(trial) in wanted}
    missing = given([task for task in tasks if task not in known])
    for _, trial in side_by_side(work, missing, budget, workers, max(at_least - len(known), 0)):
        known[key(trial)] = trial
        keep(trial, kept)
        progress(len(known) / len(tasks), f"trial {len(known)} of at most {len(tasks)}")
    return [known[task] for task in tasks if task in known]


def source_digest(packages: Iterable[str], *own: str | Path) -> str:
    """Digest of what a trial depends on; a trial of other sources is not reused.

    Args:
        packages: Folders of ``limber`` that are part of the sources.
        own: Further files: those of the campaign itself.
    """
    import limber

    here = Path(limber.__file__).parent
    files = [file for name in packages for file in sorted((here / name).rglob("*.py"))]
    return hashlib.sha256(b"".join(file.read_bytes() for file in [*files, *map(Path, own)])
                          ).hexdigest()[:16]


def read_trials(kind: type[Trial], kept: Path | None) -> list[Trial]:
    """Read the trials of a file, including those of other sources; a truncated line is left out."""
    if kept is None or not kept.is_file():
        return []
    trials = []
    for line in kept.read_text(encoding="utf-8").splitlines():
        try:
            record = json.loads(line)
        except json.JSONDecodeError:
            # The line being written when the run was stopped.
            continue
        trials.append(kind(**{key: tuple(value) if isinstance(value, list) else value
                              for key, value in record.items()}))
    return trials


def keep(trial: object, kept: Path | None) -> None:
    """Append a trial to a file, if there is one."""
    if kept is not None:
        with open(kept, "a", encoding="utf-8") as stream:
            stream.write(json.dumps(plain(asdict(trial))) + "\n")
