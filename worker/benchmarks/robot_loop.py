"""The closed loop on random branches: `limber demo --robot`, many times."""

import shutil
import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine_stalls import Voided
from benchmarks.table import Asked, Row, Setting, share_met
from benchmarks.trial_log import go_on, read_trials, source_digest
from limber.cli.closed_loop.comparison import GOAL_TOLERANCE_M, comparison
from limber.cli.closed_loop.loop import OPEN_FACTOR, ClosedLoop
from limber.cli.terminal import table_lines
from limber.core.errors import LimberError
from limber.core.progress import Progress

_PACKAGES = ("cli", "robot", "planning", "estimation", "mechanics", "stages")


@dataclass(frozen=True)
class _Loop:
    """One loop: its result, or the error that ended it; and the sources' digest."""

    seed: int
    source: str
    result: dict[str, Any] | None
    error: str | None


_LOOP = "closed loop on random branches"
LOOP_ROWS = (
    Asked(f"{_LOOP}: ended, no limit broken", "all"),
    Asked(f"{_LOOP}: true E in its 95 % interval", "88 to 99 %"),
    Asked(f"{_LOOP}: the flower within {1000 * GOAL_TOLERANCE_M:.0f} mm of its goal", "all"),
    Asked(f"{_LOOP}: force within 5 % of the peak or the interval, least share of a path", "95 %"),
    Asked(f"{_LOOP}: an interval of E open beyond a factor of {OPEN_FACTOR:g} that another pull "
          "would be worth for the path", "reported"),
    Asked(f"{_LOOP}: way after a provoked overload at 30 mm/s, worst", "reported"))


def closed_loops(setting: Setting, voided: Voided, address: str) -> list[Row]:
    """Run the loop on as many random branches as there is time for.

    Folders stay in the user's folder, if named; loops made before with these seeds and sources are
    reused.
    """
    source, kept = source_digest(_PACKAGES, __file__), setting.kept / "loops.jsonl"
    seeds = [setting.seed + number for number in range(setting.at_most(10, 1))]
    loops = go_on(read_trials(_Loop, kept), seeds, lambda loop: loop.seed, partial(
        _once, source=source, address=address, out=setting.out, progress=setting.progress,
        voided=voided), source, kept, setting.budget)
    return _rows(loops, voided)


def _once(seed: int, source: str, address: str, out: Path | None, progress: Progress,
          voided: Voided) -> _Loop:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place, "loop") if out is None else out / f"loop-{seed}"

        def run() -> dict[str, Any]:
            # Files of a run that was stopped in the middle.
            shutil.rmtree(folder, ignore_errors=True)
            return ClosedLoop(folder, seed, address, progress=progress).run()
        try:
            result = voided.again(run, f"closed loop, seed {seed}")
        except LimberError as error:
            print(f"closed loop, seed {seed}: {error}", flush=True)
            return _Loop(seed, source, None, str(error))
    print(f"closed loop, seed {seed}: {result['part_seconds']}")
    for title, rows in comparison(result):
        print("\n".join([title, *(f"  {line}" for line in table_lines(rows))]), flush=True)
    return _Loop(seed, source, result, None)


def _rows(loops: list[_Loop], voided: Voided) -> list[Row]:
    results = [loop.result for loop in loops if loop.result is not None]
    failed = [f"seed {loop.seed}: {loop.error}" for loop in loops if loop.error is not None]
    count = len(loops)
    for line in failed:
        print(line, flush=True)
    if not results:
        return [Row(*asked, f"none ended: {failed[0]}", False, count) for asked in LOOP_ROWS]
    covered = np.concatenate([result["covered"] for result in results])
    share = float(covered.mean())
    within = [result["force_within_share"] for result in results]
    flowers = [result["flower_in_goal"] for result in results]
    broken = sum(result["limit_broken"] for result in results)
    ways = [result["overload_way_m"] for result in results if result["overload_way_m"] is not None]
    worst = max(result["flower_off_m"] or np.inf for result in results)
    opened = [result for result in results if result["open_factor"] > OPEN_FACTOR]
    pulls = sum(result["pull_count"] for result in results)
    return [
        Row(*LOOP_ROWS[0], f"{len(results)} of {count} ended, {broken} broke one{voided}",
            not failed and not broken, count),
        Row(*LOOP_ROWS[1], f"{int(covered.sum())} of {len(covered)} ({100 * share:.0f} %)",
            share_met(share, len(covered), 0.88, 0.99), len(results)),
        Row(*LOOP_ROWS[2], f"{sum(flowers)} of {count}; farthest {1000 * worst:.1f} mm",
            all(flowers) and not failed, count),
        Row(*LOOP_ROWS[3], f"{100 * min(within):.1f} % (median {100 * np.median(within):.1f})",
            min(within) >= 0.95 and not failed, count),
        Row(*LOOP_ROWS[4], f"{len(opened)} open after {pulls} pulls: "
            f"{sum('keeps its limits' in one['no_further_pull'] for one in opened)} of no worth "
            "for it", None, len(results)),
        Row(*LOOP_ROWS[5],
            f"{1000 * max(ways):.1f} mm" if ways else "none came to one", None, len(ways))]
