"""The table that every benchmark prints: measure, asked, measured, met."""

import argparse
import importlib
import inspect
import json
import secrets
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from limber.plain import plain
from limber.progress import BarSink, Progress

NAMES = ("geometry", "mechanics", "estimation", "truth", "planning", "robot", "scans", "viewport",
         "worker")


@dataclass(frozen=True)
class Row:
    """One line. ``met`` is None where nothing was asked, or where it could not be measured."""

    measure: str
    asked: str
    measured: str
    met: bool | None


def main(arguments: list[str] | None = None) -> int:
    """``scripts/bench NAME``: measure, print the table; 0 whenever it could measure."""
    parser = argparse.ArgumentParser(prog="scripts/bench", description=main.__doc__)
    parser.add_argument("name", choices=NAMES)
    parser.add_argument("--quick", action="store_true", help="fewer seeds")
    parser.add_argument("--json", action="store_true", help="last line: the table as JSON")
    parser.add_argument("--seed", type=int, help="repeat what a printed base seed drew")
    parser.add_argument("--only", nargs="+", metavar="PART", default=(), help=(
        "only these parts of the table, where a bench has parts; a wrong one lists them"))
    parser.add_argument("--out", type=Path, help="folder for pictures and raw numbers")
    options = parser.parse_args(arguments)
    module = importlib.import_module(f"benchmarks.{options.name}")
    parts = getattr(module, "PARTS", {})
    for part in options.only:
        if part not in parts:
            parser.error(f"{options.name} has no part {part!r}; it has: {', '.join(parts)}")
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    rows = _measure(module, options)
    show(rows)
    print(f"{options.name}: {time.perf_counter() - started:.0f} s")
    if options.json:
        print(json.dumps({"bench": options.name, "rows": [plain(asdict(row)) for row in rows]}))
    return 0


def show(rows: list[Row]) -> None:
    """Print rows as a table."""
    from rich.console import Console
    from rich.table import Table

    table = Table("measure", "asked", "measured", "met")
    for row in rows:
        met = {True: "yes", False: "NO", None: "-"}[row.met]
        table.add_row(row.measure, row.asked, row.measured, met)
    console = Console(width=None if sys.stdout.isatty() else 160)
    console.print(table)


def _measure(module: object, options: argparse.Namespace) -> list[Row]:
    drawn = {"only": tuple(options.only)} if options.only else {}
    if "seed" in inspect.signature(module.rows).parameters:
        drawn["seed"] = secrets.randbits(31) if options.seed is None else options.seed
        print(f"base seed {drawn['seed']} (--seed repeats it)", flush=True)
    if not sys.stderr.isatty():
        return module.rows(options.quick, Progress(), options.out, **drawn)
    with BarSink(options.name) as bar:
        return module.rows(options.quick, Progress(bar), options.out, **drawn)


if __name__ == "__main__":
    sys.exit(main())
