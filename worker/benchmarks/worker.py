"""The worker's table: mutated files, start-up times, exports bent in other programs, ringing.

Times are those of this computer under its load at the moment: ``--only two-cores`` needs it idle.
"""

import subprocess
import sys
import time
from functools import partial
from pathlib import Path

from benchmarks import truth_beam
from benchmarks.table import Asked, Part, Row, Setting
from benchmarks.worker_batches import (
    DASK_ROWS,
    MEMORY_ROW,
    SPEED_UP_ROW,
    memory,
    on_dask,
    speed_up,
)
from benchmarks.worker_demo import DEMO_ROWS, run_demo
from benchmarks.worker_exports import EXPORT_ROWS, exported
from benchmarks.worker_fuzz import fuzz
from benchmarks.worker_hostile import HOSTILE_ROWS, hostile
from benchmarks.worker_kernel_cache import KERNELS_ROW, kernels
from benchmarks.worker_kills import KILLS_ROW, killed
from benchmarks.worker_large import LARGE_ROWS, large
from benchmarks.worker_readers import READERS
from benchmarks.worker_readme import README_ROW, run_readme
from benchmarks.worker_reports import REPORT_ROWS, reported
from benchmarks.worker_ringing import RINGING_ROW, rung

TEMPLATE = Path(__file__).parents[2] / "blend_files" / "bending_branch"


_START_UP = {("--help",): Asked("limber --help, least of 5", "0.3 s"),
             ("doctor",): Asked("limber doctor, least of 5", "2.0 s")}
_START_UP_SECONDS = {("--help",): 0.3, ("doctor",): 2.0}


def _harmful(setting: Setting) -> Path:
    """Folder for files that did harm."""
    return setting.kept / "harmful"


def _fuzz_asked(name: str) -> Asked:
    return Asked(f"mutated files, {name}", "an error or a valid result")


_FUZZED = Asked("mutated files, all readers: traceback, crash, hang over 10 s, over 2 GB, numbers "
                "not finite", "0")


def _memory(setting: Setting) -> list[Row]:
    return [memory(setting, TEMPLATE)]


def _start_up(_setting: Setting) -> list[Row]:
    found = []
    for arguments, asked in _START_UP.items():
        seconds = []
        for _ in range(5):
            started = time.perf_counter()
            subprocess.run([sys.executable, "-m", "limber", *arguments], check=True,
                           stdout=subprocess.DEVNULL)
            seconds.append(time.perf_counter() - started)
        found.append(Row(*asked, f"{min(seconds):.2f} s",
                         min(seconds) <= _START_UP_SECONDS[arguments], len(seconds)))
    return found


def _hostile(setting: Setting) -> list[Row]:
    return hostile(setting, TEMPLATE)


def _kernels(setting: Setting) -> list[Row]:
    return kernels(setting, TEMPLATE)


def _fuzzed(setting: Setting, names: tuple[str, ...] = tuple(READERS)) -> list[Row]:
    """One row for all readers, and one for each."""
    found = fuzz(list(names), setting, TEMPLATE, _harmful(setting))
    table = []
    for name, outcomes in found.items():
        told = ", ".join(f"{number} {word}" for word, number in sorted(outcomes.counts.items()))
        table.append(Row(*_fuzz_asked(name), told, outcomes.bad == 0, outcomes.total))
        for word, file, message in outcomes.examples:
            print(f"{name}: {word}: {message} ({Path(file).name})")
    if len(names) == 1:
        return table
    bad, total = (sum(getattr(each, what) for each in found.values()) for what in ("bad", "total"))
    # A reader that was not run is not known to be good.
    is_met = False if bad else True if len(found) == len(names) else None
    return [Row(*_FUZZED, f"{bad} ({len(found)} of {len(names)} readers)", is_met, total), *table]


PARTS = {
    "hostile": Part(_hostile, 60, HOSTILE_ROWS, grows=True),
    "fuzz": Part(_fuzzed, 60, (_FUZZED, *map(_fuzz_asked, READERS)), grows=True),
    "readers": Part(reported, 120, REPORT_ROWS),
    "kernel-cache": Part(_kernels, 60, (KERNELS_ROW,), grows=True),
    "start-up": Part(_start_up, 15, tuple(_START_UP.values())),
    "exports": Part(exported, 60, EXPORT_ROWS, grows=True),
    "ringing": Part(rung, 30, (RINGING_ROW,), grows=True),
    "silicone-beam": Part(truth_beam.swing_row, 60, (truth_beam.SWING_ROW,)),
    "demo": Part(run_demo, 90, DEMO_ROWS),
    "readme": Part(run_readme, 60, (README_ROW,), grows=True),
    "memory": Part(_memory, 30, (MEMORY_ROW,), grows=True),
    "large": Part(large, 60, LARGE_ROWS, grows=True),
    "kills": Part(killed, 90, (KILLS_ROW,), grows=True),
    "dask": Part(on_dask, 120, DASK_ROWS, grows=True),
    "two-cores": Part(speed_up, 120, (SPEED_UP_ROW,), grows=True)}
"""The table, in order of importance; ``--only`` also accepts the fuzz of one reader."""
PARTS |= {f"fuzz:{name}": Part(partial(_fuzzed, names=(name,)), 10, (_fuzz_asked(name),),
                               grows=True, alone=True) for name in READERS}
