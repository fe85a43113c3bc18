"""The closed loop on random branches: what `limber demo --robot` does, many times."""

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.held_up import Voided
from benchmarks.kept_trials import keep, read_trials, source_digest
from benchmarks.table import Row
from limber.closed_loop.loop import GOAL_TOLERANCE_M, OPEN_FACTOR, ClosedLoop, comparison
from limber.errors import LimberError
from limber.progress import Progress
from limber.terminal import table_lines

_PACKAGES = ("closed_loop", "robot", "planning", "estimation", "mechanics", "stages")


@dataclass(frozen=True)
class _Loop:
    """One loop: what it found, or the error that ended it; and of which sources it was."""

    seed: int
    source: str
    result: dict[str, Any] | None
    error: str | None


def closed_loops(seed: int, count: int, address: str, progress: Progress, out: Path | None,
                 voided: Voided) -> list[Row]:
    """Go around with each of ``count`` random branches.

    Where ``out`` is given folders stay there, and loops that were made before with these seeds and
    sources are taken over.
    """
    source = source_digest(_PACKAGES, __file__)
    kept = None if out is None else out / "loops.jsonl"
    known = {loop.seed: loop for loop in read_trials(_Loop, kept) if loop.source == source}
    loops = []
    for number in range(count):
        which = seed + number
        if which not in known:
            known[which] = _once(which, source, address, out, progress.part(
                number / count, (number + 1) / count), voided)
            keep(known[which], kept)
        loops.append(known[which])
    return _rows(loops, voided)


def _once(seed: int, source: str, address: str, out: Path | None, progress: Progress,
          voided: Voided) -> _Loop:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place, "loop") if out is None else out / f"loop-{seed}"

        def run() -> dict[str, Any]:
            # Of a run that was stopped in the middle.
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
    told = f"closed loop, {count} branches"
    if not results:
        return [Row(f"{told}: ended", "all", f"none: {failed[0]}", False)]
    covered = np.concatenate([result["covered"] for result in results])
    share = float(covered.mean())
    within = [result["force_within_share"] for result in results]
    flowers = [result["flower_in_goal"] for result in results]
    broken = sum(result["limit_broken"] for result in results)
    ways = [result["overload_way_m"] for result in results if result["overload_way_m"] is not None]
    worst = max(result["flower_off_m"] or np.inf for result in results)
    opened = [result for result in results if result["open_factor"] > OPEN_FACTOR]
    pulls = sum(result["pull_count"] for result in results)
    # So few intervals cannot tell 99 from 100 %.
    is_covered = None if share > 0.99 else 0.88 <= share
    return [
        Row(f"{told}: true E in its 95 % interval", "88 to 99 %",
            f"{int(covered.sum())} of {len(covered)} ({100 * share:.0f} %)", is_covered),
        Row(f"{told}: the flower within {1000 * GOAL_TOLERANCE_M:.0f} mm of its goal", "all",
            f"{sum(flowers)} of {count}; farthest {1000 * worst:.1f} mm",
            all(flowers) and not failed),
        Row(f"{told}: ended, no limit broken", "all",
            f"{len(results)} of {count} ended, {broken} broke one{voided}",
            not failed and not broken),
        Row(f"{told}: force within 5 % of the peak or the interval, least share of a path", "95 %",
            f"{100 * min(within):.1f} % (median {100 * np.median(within):.1f})",
            min(within) >= 0.95 and not failed),
        Row(f"{told}: an interval of E open beyond a factor of {OPEN_FACTOR:g} that another pull "
            "would be worth for the path", "reported", f"{len(opened)} open after {pulls} pulls: "
            f"{sum('keeps its limits' in one['no_further_pull'] for one in opened)} of no worth "
            "for it", None),
        Row(f"{told}: way after a provoked overload at 30 mm/s, worst", "reported",
            f"{1000 * max(ways):.1f} mm" if ways else "none came to one", None)]
