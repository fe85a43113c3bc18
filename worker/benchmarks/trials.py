"""Trials within a time budget, kept as JSON lines as they are made: a stopped run continues."""

import hashlib
import json
import re
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import limber
from limber.core.errors import Cancelled, LimberError
from limber.core.json_values import plain
from limber.core.processes import Pool, core_budget
from limber.core.progress import SILENT, Progress

Task = TypeVar("Task")
Result = TypeVar("Result")
Caught = type[Exception] | tuple[type[Exception], ...]

_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}


class Budget:
    """Time until a deadline.

    Args:
        seconds: Time from now on [s].
        clock: Returns the time [s]; monotonic.
    """

    def __init__(self, seconds: float, clock: Callable[[], float] = time.monotonic):
        self.clock = clock
        self._end = clock() + seconds

    @property
    def remaining(self) -> float:
        """Time left [s]; negative after the deadline."""
        return self._end - self.clock()

    def part(self, seconds: float) -> "Budget":
        """Return a budget of ``seconds`` [s] that ends no later than this one."""
        return Budget(min(seconds, self.remaining), self.clock)

    def items(self, items: Iterable[Task], at_least: int = 1) -> Iterator[Task]:
        """Yield items while the next trial fits, as long as the longest so far took.

        A trial's time is that of the loop's body. The first ``at_least`` are yielded regardless of
        the time left.
        """
        longest = 0.0
        for number, item in enumerate(items):
            if number >= at_least and self.remaining <= longest:
                return
            began = self.clock()
            yield item
            longest = max(longest, self.clock() - began)

    def seeds(self, first: int, at_most: int, at_least: int = 1) -> Iterator[int]:
        """Yield ``first``, ``first + 1``, ... while the next trial fits."""
        return self.items(range(first, first + at_most), at_least)

    def shares(self, items: list[Task]) -> Iterator[tuple[Task, "Budget"]]:
        """Yield each item with an even fraction of the time left then: none after the end."""
        for number, item in enumerate(items):
            yield item, self.part(self.remaining / (len(items) - number))


def parsed_seconds(text: str) -> float:
    """Return the seconds of a duration: ``90s``, ``15m``, ``1.5h``; a bare number is seconds.

    Raises:
        ValueError: it is not a duration, or is not positive.
    """
    found = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)\s*([smh]?)", text.strip())
    seconds = float(found[1]) * _UNITS[found[2] or "s"] if found else 0.0
    if seconds <= 0:
        raise ValueError(f"{text!r} is no duration; write it as 90s, 15m or 1h")
    return seconds


def side_by_side(work: Callable[[Task], Result], tasks: Iterable[Task], budget: Budget,
                 workers: int | None = None, at_least: int = 1) -> Iterator[Result]:
    """Yield results of tasks as they come, on ``workers`` processes; None: one for each core.

    No task begins if the time left is shorter than the longest so far took, save ``at_least``.
    """
    workers = workers or core_budget()
    if workers < 2:
        yield from map(work, budget.items(tasks, at_least))
        return
    waiting, running, longest, begun = iter(tasks), {}, 0.0, 0
    with Pool(workers) as pool:
        while True:
            while len(running) < workers and (begun < at_least or budget.remaining > longest):
                try:
                    task = next(waiting)
                except StopIteration:
                    break
                running[pool.submit(work, task)] = budget.clock()
                begun += 1
            if not running:
                return
            done: set[Future]
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                longest = max(longest, budget.clock() - running.pop(future))
                yield future.result()


@dataclass(frozen=True)
class Trial:
    """What came of one task of a part of a bench's table; ``trial[name]`` is a value.

    Attributes:
        part: Name of the campaign.
        task: Seed, or names and numbers; all random numbers follow from it.
        source: Digest of the sources; trials of other sources do not count.
        values: By name, as JSON has them; what is not finite is infinite.
        failure: Why there are no values, or empty.
        seconds: Time of the trial.
    """

    part: str
    task: Any
    source: str
    values: dict[str, Any]
    failure: str = ""
    seconds: float = 0.0

    def __post_init__(self) -> None:
        for name, value in self.values.items():
            if value is None:
                self.values[name] = np.inf

    def __getitem__(self, name: str) -> Any:
        return self.values[name]


def column(trials: Iterable[Trial], name: str) -> np.ndarray:
    """Return a value of each trial, shape [trials, ...] of float; None in lists is NaN."""
    return np.array([trial[name] for trial in trials], float)


def joined(trials: Iterable[Trial], name: str) -> np.ndarray:
    """Return the values of all trials' lists one after the other, as float."""
    lists = [np.array(trial[name], float) for trial in trials]
    return np.concatenate(lists) if lists else np.zeros(0)


def sound(trials: Iterable[Trial]) -> list[Trial]:
    """Return the trials that have values."""
    return [trial for trial in trials if not trial.failure]


def go_on(part: str, tasks: Iterable[Any], work: Callable[[Any], dict[str, Any]],
          packages: Sequence[str], kept: Path, budget: Budget, *, workers: int | None = 1,
          at_least: int = 1, catch: Caught = (),
          given: Callable[[Any], Any] | None = None, progress: Progress = SILENT) -> list[Trial]:
    """Return the trials of ``tasks``, in their order: those kept, and as many new ones as fit.

    Args:
        part: Name of the campaign in ``kept``.
        tasks: The most important first.
        work: Returns a task's values; what other processes can import if ``workers`` is not 1.
        packages: Folders of ``limber`` whose change makes kept trials void, as that of a bench.
        kept: File from which trials are read, and to which new ones are appended.
        budget: Time for the new ones.
        workers: Number of parallel processes; None: the number of cores.
        at_least: Least number of trials in the end, regardless of the time left.
        catch: Errors of ``work`` that are a trial's failure; any other ends the campaign.
        given: Returns what ``work`` gets for a task, if it is more than the task.
        progress: Called after each.
    """
    tasks, source = list(tasks), source_digest(packages)
    known = {trial.task: trial for trial in read_trials(kept)
             if (trial.part, trial.source) == (part, source) and trial.task in set(tasks)}
    missing = [(task, given(task) if given else task) for task in tasks if task not in known]
    for made in side_by_side(partial(_made, work, catch), missing, budget, workers,
                             max(at_least - len(known), 0)):
        trial = Trial(part, made[0], source, *made[1:])
        known[trial.task] = trial
        with open(kept, "a", encoding="utf-8") as stream:
            stream.write(json.dumps(plain(asdict(trial))) + "\n")
        progress(len(known) / len(tasks), f"trial {len(known)} of at most {len(tasks)}")
    return [known[task] for task in tasks if task in known]


def _made(work: Callable[[Any], dict[str, Any]], catch: Caught,
          pair: tuple[Any, Any]) -> tuple[Any, dict[str, Any], str, float]:
    """Task, values, failure and seconds of one trial."""
    began, values, failure = time.perf_counter(), {}, ""
    try:
        values = plain(work(pair[1]))
    except Cancelled:
        raise
    except catch as error:
        kind = "" if isinstance(error, LimberError) else f"{type(error).__name__}: "
        failure = f"{kind}{error}" or kind
    return pair[0], values, failure, round(time.perf_counter() - began, 2)


def source_digest(packages: Iterable[str]) -> str:
    """Digest of the benches and of folders of ``limber``; a trial of others is not reused."""
    folders = [Path(__file__).parent, *(Path(limber.__file__).parent / name for name in packages)]
    files = [file for folder in folders for file in sorted(folder.rglob("*.py"))]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]


def read_trials(kept: Path) -> list[Trial]:
    """Read the trials of a file, including those of other sources; a truncated line is left out."""
    trials = []
    for line in kept.read_text(encoding="utf-8").splitlines() if kept.is_file() else ():
        try:
            record = json.loads(line)
        except json.JSONDecodeError:
            # The line being written when the run was stopped.
            continue
        if isinstance(record["task"], list):
            record["task"] = tuple(record["task"])
        trials.append(Trial(**record))
    return trials
