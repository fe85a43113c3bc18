"""The table that every benchmark prints: measure, required, measured, met, count."""

import argparse
import datetime
import importlib
import json
import os
import secrets
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.trials import Budget, Trial, go_on, parsed_seconds
from limber.core.errors import Cancelled
from limber.core.json_values import plain
from limber.core.progress import SILENT, BarSink, Progress

NAMES = ("mechanics", "estimation", "truth", "planning", "robot", "scans", "viewport", "worker")
NOT_SHOWN = "not shown"
"""Entry of a row without time, or without anything to measure it with."""
_FEW = 20
"""Least number of intervals that is judged: of fewer, one miss is more than 5 %."""


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        measure: Name of the measure.
        asked: The limit set by the issue.
        measured: The result.
        met: None if nothing was required, or if it could not be measured.
        count: Number of trials behind the row: seeds, files, runs; 0 if it is not shown.
    """

    measure: str
    asked: str
    measured: str
    met: bool | None
    count: int = 1


class Asked(NamedTuple):
    """Measure and limit of a row: known before anything is measured."""

    measure: str
    asked: str

    def not_shown(self) -> Row:
        """Return the row without a measurement."""
        return Row(*self, NOT_SHOWN, None, 0)


@dataclass(frozen=True)
class Setting:
    """Settings for measuring a part.

    Attributes:
        seed: Base seed of all draws.
        quick: Fewer trials, smaller cases.
        budget: Time of the part.
        progress: Called during the work.
        kept: Folder where trials are kept; parts of one run and runs of one ``--out`` share it.
        out: Folder for pictures and raw numbers, or None if the user named none.
    """

    seed: int
    quick: bool
    budget: Budget
    progress: Progress
    kept: Path
    out: Path | None = None

    def at_most(self, count: int, quick: int) -> int:
        """Return the number of trials to take if the time allows."""
        return quick if self.quick else count

    def seeds(self, count: int, quick: int, first: int = 0) -> range:
        """Return seeds of trials: fresh ones for each base seed, ``count`` or ``quick`` many."""
        start = 1000 * self.seed + first
        return range(start, start + self.at_most(count, quick))

    def generator(self, *which: int) -> np.random.Generator:
        """Return a generator of the base seed; ``which`` separates those of parts."""
        return np.random.default_rng([self.seed, *which])

    def trials(self, part: str, tasks: Iterable[Any], work: Callable[[Any], dict[str, Any]],
               *packages: str, **more: Any) -> list[Trial]:
        """Return as many trials as there is time for, as :func:`benchmarks.trials.go_on` says."""
        return go_on(part, tasks, work, packages, self.kept / "trials.jsonl", self.budget,
                     **{"progress": self.progress} | more)


@dataclass(frozen=True)
class Part:
    """One part of a benchmark's table.

    Attributes:
        run: Measures it.
        seconds: Approximate time of the least of it on two cores [s]: all of it, or one trial if it
            grows. It is not started with less.
        gives: Its rows; one that ``run`` does not return is listed as not shown.
        grows: Whether it takes trials as long as its budget lasts.
        alone: Whether it is measured only if ``--only`` names it.
    """

    run: Callable[[Setting], list[Row]]
    seconds: float
    gives: tuple[Asked, ...]
    grows: bool = False
    alone: bool = False


def main(arguments: list[str] | None = None) -> int:
    """``scripts/bench NAME``: measure, print the table; 0 whenever it could measure."""
    parser = argparse.ArgumentParser(prog="scripts/bench", description=main.__doc__)
    parser.add_argument("name", choices=NAMES)
    parser.add_argument("--budget", type=_seconds, default="15m", metavar="TIME", help=(
        "how long to measure, as 90s, 15m (default) or 1h; rows come in order of importance"))
    parser.add_argument("--quick", action="store_true", help="fewer seeds")
    parser.add_argument("--json", action="store_true", help="last line: the table as JSON")
    parser.add_argument("--seed", type=int, help="repeat what a printed base seed drew")
    parser.add_argument("--only", nargs="+", metavar="PART", default=(), help=(
        "only these parts of the table; a wrong name lists them"))
    parser.add_argument("--out", type=Path, help=(
        "folder for pictures, raw numbers and trials; with the same --seed, a run goes on there"))
    options = parser.parse_args(arguments)
    budget = Budget(options.budget)
    parts = importlib.import_module(f"benchmarks.{options.name}").PARTS
    for name in options.only:
        if name not in parts:
            parser.error(f"{options.name} has no part {name!r}; it has: {', '.join(parts)}")
    options.seed = secrets.randbits(31) if options.seed is None else options.seed
    started = time.perf_counter()
    rows, failed = _measured(parts, options, budget)
    show(rows)
    print(f"{options.name}: {time.perf_counter() - started:.0f} s")
    if options.json:
        print(json.dumps(_record(options, rows)))
    return 1 if rows and failed == len(rows) else 0


def show(rows: Sequence[Row]) -> None:
    """Print rows as a table."""
    from rich.console import Console
    from rich.table import Table

    table = Table("measure", "asked", "measured", "met", "count")
    for row in rows:
        met = {True: "yes", False: "NO", None: "-"}[row.met]
        table.add_row(row.measure, row.asked, row.measured, met, str(row.count))
    console = Console(width=None if sys.stdout.isatty() else 160, markup=False)
    console.print(table)


def rows_of(parts: dict[str, Part], setting: Setting, only: Sequence[str] = (),
            ) -> tuple[list[Row], int]:
    """Measure parts in their order, within the setting's budget.

    Returns:
        The rows of all chosen parts, and the number of rows from failed parts.
    """
    chosen = only or [name for name, part in parts.items() if not part.alone]
    table: list[Row] = []
    failed = 0
    for number, name in enumerate(chosen):
        part, later = parts[name], [parts[each] for each in chosen[number + 1:]]
        seconds = allowance(part, later, setting.budget.remaining)
        if seconds is None:
            print(f"{name}: not shown, it takes {part.seconds:.0f} s or more and "
                  f"{max(setting.budget.remaining, 0):.0f} s are left", flush=True)
            table += [asked.not_shown() for asked in part.gives]
            continue
        progress = setting.progress.part(number / len(chosen), (number + 1) / len(chosen))
        progress(0.0, name)
        began = setting.budget.clock()
        found = _tried(name, part, replace(setting, budget=setting.budget.part(seconds),
                                           progress=progress))
        print(f"{name}: {setting.budget.clock() - began:.0f} s", flush=True)
        failed += 0 if found else len(part.gives)
        table += found or [Row(*asked, "failed, see above", False, 0) for asked in part.gives]
    return table, failed


def allowance(part: Part, later: Sequence[Part], remaining: float) -> float | None:
    """Return the time [s] of a part, or None if the least of it does not fit.

    The least time of each later part that still fits, the most important first, is set aside. Parts
    that grow divide the rest evenly.
    """
    spare, growing = remaining - part.seconds, 1
    if spare < 0:
        return None
    for other in later:
        if other.seconds <= spare:
            spare -= other.seconds
            growing += other.grows
    return part.seconds + (spare / growing if part.grows else 0.0)


def share_met(share: float, count: int, low: float, high: float) -> bool | None:
    """Whether the fraction of ``count`` intervals is in a required range; None: too few.

    A fraction above ``high`` is inconclusive if a single miss would bring it below.
    """
    if count < _FEW or (share > high and count * (1 - high) < 1):
        return None
    return bool(low <= share <= high)


def limber_command(*words: object, folder: Path | None = None, seconds: float = 600.0,
                   **environment: str) -> subprocess.CompletedProcess[str]:
    """Run ``limber`` in a process of its own, at most ``seconds`` [s]; return what it wrote."""
    return subprocess.run(
        [sys.executable, "-m", "limber", *map(str, words)], cwd=folder, text=True, check=False,
        capture_output=True, timeout=seconds, env=os.environ | environment)


def last_json(done: subprocess.CompletedProcess[str]) -> dict[str, Any]:
    """Return the last line that a command with ``--json`` wrote."""
    return json.loads(done.stdout.splitlines()[-1])


def _tried(name: str, part: Part, setting: Setting) -> list[Row]:
    """The rows of a part, including those not shown; none if it failed, which is printed."""
    try:
        found = part.run(setting)
    except Cancelled:
        raise
    except Exception:
        print(f"{name}: {traceback.format_exc()}", flush=True)
        return []
    shown = {(row.measure, row.asked) for row in found}
    return found + [asked.not_shown() for asked in part.gives if tuple(asked) not in shown]


def _measured(parts: dict[str, Part], options: argparse.Namespace, budget: Budget,
              ) -> tuple[list[Row], int]:
    print(f"base seed {options.seed} (--seed repeats it)", flush=True)
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as place:
        kept = options.out or Path(place)
        kept.mkdir(parents=True, exist_ok=True)
        setting = Setting(options.seed, options.quick, budget, SILENT, kept, options.out)
        if not sys.stderr.isatty():
            return rows_of(parts, setting, options.only)
        with BarSink(options.name) as bar:
            return rows_of(parts, replace(setting, progress=Progress(bar)), options.only)


def _record(options: argparse.Namespace, rows: Sequence[Row]) -> dict[str, object]:
    """The table with its context: date, code, seed."""
    done = subprocess.run(["git", "rev-parse", "--short=10", "HEAD"], cwd=Path(__file__).parent,
                          capture_output=True, text=True, check=False)
    return {"bench": options.name, "date": datetime.date.today().isoformat(),
            "commit": done.stdout.strip() or None, "seed": options.seed,
            "budget_s": options.budget, "rows": [plain(asdict(row)) for row in rows]}


def _seconds(text: str) -> float:
    try:
        return parsed_seconds(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


if __name__ == "__main__":
    sys.exit(main())
