"""The closed loop on random branches: what `limber demo --robot` does, many times."""

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.table import Row
from limber.closed_loop.loop import GOAL_TOLERANCE_M, ClosedLoop, comparison
from limber.errors import LimberError
from limber.progress import Progress
from limber.terminal import table_lines


def closed_loops(seed: int, count: int, address: str, progress: Progress,
                 out: Path | None = None) -> list[Row]:
    """Go around with each of ``count`` random branches; folders stay in ``out`` where it is given.
    """
    results, failed = [], []
    for number in range(count):
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place, "loop") if out is None else out / f"loop-{seed + number}"
            try:
                result = ClosedLoop(folder, seed + number, address,
                                    progress=progress.part(number / count, (number + 1) / count),
                                    ).run()
            except LimberError as error:
                failed.append(f"seed {seed + number}: {error}")
                continue
        results.append(result)
        print(f"closed loop, seed {seed + number}: {result['part_seconds']}")
        for title, rows in comparison(result):
            print("\n".join([title, *(f"  {line}" for line in table_lines(rows))]), flush=True)
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
    # So few intervals cannot tell 99 from 100 %.
    is_covered = None if share > 0.99 else 0.88 <= share
    return [
        Row(f"{told}: true E in its 95 % interval", "88 to 99 %",
            f"{int(covered.sum())} of {len(covered)} ({100 * share:.0f} %)", is_covered),
        Row(f"{told}: the flower within {1000 * GOAL_TOLERANCE_M:.0f} mm of its goal", "all",
            f"{sum(flowers)} of {count}; farthest {1000 * worst:.1f} mm",
            all(flowers) and not failed),
        Row(f"{told}: ended, no limit broken", "all",
            f"{len(results)} of {count} ended, {broken} broke one", not failed and not broken),
        Row(f"{told}: force within 5 % of the peak or the interval, least share of a path", "95 %",
            f"{100 * min(within):.1f} % (median {100 * np.median(within):.1f})",
            min(within) >= 0.95 and not failed),
        Row(f"{told}: way after a provoked overload at 30 mm/s, worst", "reported",
            f"{1000 * max(ways):.1f} mm" if ways else "none came to one", None)]
