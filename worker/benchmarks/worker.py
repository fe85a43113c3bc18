"""The worker's table: mutated files, start-up times, exports bent in other programs, ringing.

Times are those of this computer under its load at the moment: ``--only two-cores`` wants it quiet.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from benchmarks import truth_beam
from benchmarks.table import Row
from benchmarks.worker_batches import memory, on_dask, speed_up
from benchmarks.worker_exports import rows as exported
from benchmarks.worker_fuzz import fuzz
from benchmarks.worker_kills import killed
from benchmarks.worker_readers import READERS
from benchmarks.worker_readme import run_readme
from benchmarks.worker_ringing import rows as rung
from limber.progress import Progress

TEMPLATE = Path(__file__).parents[2] / "blend_files" / "bending_branch"


@dataclass(frozen=True)
class Setting:
    """How much is measured: ``quick`` takes a tenth of the files, branches and jobs.

    Harmful files go to ``keep``; ``out`` is where a campaign may go on, if one was named.
    """

    quick: bool
    seed: int
    keep: Path
    out: Path | None


def rows(quick: bool, progress: Progress, out: Path | None, seed: int,
         only: tuple[str, ...] = ()) -> list[Row]:
    """Measure the parts named in ``only``, or all; ``quick`` takes about a tenth of each."""
    table = []
    chosen = only or WHOLE
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as place:
        setting = Setting(quick, seed, (out or Path(place)) / "harmful", out)
        for number, name in enumerate(chosen):
            table += PARTS[name](setting, progress.part(
                number / len(chosen), (number + 1) / len(chosen)))
    return table


def _exports(setting: Setting, progress: Progress) -> list[Row]:
    return exported([setting.seed + k for k in range(2 if setting.quick else 5)], progress)


def _ringing(setting: Setting, progress: Progress) -> list[Row]:
    return rung(10 if setting.quick else 100, setting.seed, progress)


def _memory(setting: Setting, progress: Progress) -> list[Row]:
    return [memory(30 if setting.quick else 100, TEMPLATE, progress)]


def _kills(setting: Setting, progress: Progress) -> list[Row]:
    kills, branches = (3, 1) if setting.quick else (30, 2)
    kept = None if setting.out is None else setting.out / "kills.jsonl"
    return [killed(kills, branches, setting.seed, kept, progress)]


def _silicone_beam(_setting: Setting, _progress: Progress) -> list[Row]:
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as place:
        return [truth_beam.swing_row(Path(place))]


def _readme(setting: Setting, progress: Progress) -> list[Row]:
    return [run_readme(setting.seed, progress)]


def _dask(setting: Setting, progress: Progress) -> list[Row]:
    return on_dask(2 if setting.quick else 8, setting.seed, progress)


def _two_cores(setting: Setting, progress: Progress) -> list[Row]:
    return [speed_up(4 if setting.quick else 40, setting.seed, progress)]


def _start_up(_setting: Setting, _progress: Progress) -> list[Row]:
    found = []
    for arguments, asked in ((("--help",), 0.3), (("doctor",), 2.0)):
        seconds = []
        for _ in range(5):
            started = time.perf_counter()
            subprocess.run([sys.executable, "-m", "limber", *arguments], check=True,
                           stdout=subprocess.DEVNULL)
            seconds.append(time.perf_counter() - started)
        found.append(Row(f"limber {' '.join(arguments)}, least of 5", f"{asked} s",
                         f"{min(seconds):.2f} s", min(seconds) <= asked))
    return found


def _fuzzed(setting: Setting, progress: Progress, names: tuple[str, ...] = tuple(READERS),
            ) -> list[Row]:
    """A row a reader, and one for all."""
    count = 20 if setting.quick else 200
    found = fuzz(list(names), count, setting.seed, TEMPLATE, setting.keep, progress)
    table = []
    for name, outcomes in found.items():
        told = ", ".join(f"{number} {word}" for word, number in sorted(outcomes.counts.items()))
        table.append(Row(f"{count} mutated files, {name}", "an error or a valid result", told,
                         outcomes.bad == 0))
        for word, file, message in outcomes.examples:
            print(f"{name}: {word}: {message} ({Path(file).name})")
    bad, total = sum(each.bad for each in found.values()), count * len(found)
    if len(found) > 1:
        table.append(Row(f"{len(found)} readers, {total} files: traceback, crash, hang over 10 s, "
                         "over 2 GB, numbers not finite", "0", str(bad), bad == 0))
    return table


WHOLE: dict[str, Callable[[Setting, Progress], list[Row]]] = {
    "start-up": _start_up, "exports": _exports, "ringing": _ringing,
    "silicone-beam": _silicone_beam, "fuzz": _fuzzed,
    "readme": _readme, "memory": _memory, "kills": _kills, "dask": _dask,
    "two-cores": _two_cores}
"""The table's parts, in its order."""
PARTS = WHOLE | {f"fuzz:{name}": partial(_fuzzed, names=(name,)) for name in READERS}
"""What ``--only`` knows: those, and the fuzz of one reader."""
