"""The worker's table: mutated files, start-up times, exports bent in other programs, ringing.

Times are those of this computer under its load at the moment.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.table import Row
from benchmarks.worker_batches import killed, memory, on_dask, speed_up
from benchmarks.worker_exports import rows as exported
from benchmarks.worker_fuzz import fuzz
from benchmarks.worker_readers import READERS
from benchmarks.worker_ringing import rows as rung
from limber.progress import Progress

TEMPLATE = Path(__file__).parents[2] / "blend_files" / "bending_branch"


def rows(quick: bool, progress: Progress, out: Path | None, seed: int) -> list[Row]:
    """Measure; ``quick`` takes a tenth of the files, branches and jobs."""
    table = _start_up()
    table += exported([seed + k for k in range(2 if quick else 5)], progress.part(0.02, 0.08))
    table += rung(10 if quick else 100, seed, progress.part(0.08, 0.1))
    progress(0.1, "mutated files")
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as place:
        keep = (out or Path(place)) / "harmful"
        table += _fuzzed(20 if quick else 200, seed, keep, progress.part(0.1, 0.5))
    table.append(memory(30 if quick else 100, TEMPLATE, progress.part(0.5, 0.6)))
    table.append(killed(3 if quick else 30, 2 if quick else 4, seed, progress.part(0.6, 0.75)))
    table += on_dask(2 if quick else 8, seed, progress.part(0.75, 0.8))
    table.append(speed_up(4 if quick else 40, seed, progress.part(0.8, 1.0)))
    return table


def _start_up() -> list[Row]:
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


def _fuzzed(count: int, seed: int, keep: Path, progress: Progress) -> list[Row]:
    """A row a reader, and one for all."""
    found = fuzz(list(READERS), count, seed, TEMPLATE, keep, progress)
    table = []
    for name, outcomes in found.items():
        told = ", ".join(f"{number} {word}" for word, number in sorted(outcomes.counts.items()))
        table.append(Row(f"{count} mutated files, {name}", "an error or a valid result", told,
                         outcomes.bad == 0))
        for word, file, message in outcomes.examples:
            print(f"{name}: {word}: {message} ({Path(file).name})")
    bad, total = sum(each.bad for each in found.values()), count * len(found)
    table.append(Row(f"{len(found)} readers, {total} files: traceback, crash, hang over 10 s, "
                     "over 2 GB, numbers not finite", "0", str(bad), bad == 0))
    return table
