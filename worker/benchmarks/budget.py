"""The time budget of a benchmark, and trials that stop when the next one no longer fits."""

import re
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import TypeVar

from limber.core.processes import Pool, core_budget

Task = TypeVar("Task")
Result = TypeVar("Result")

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
                 workers: int | None = None, at_least: int = 1,
                 ) -> Iterator[tuple[Task, Result]]:
    """Yield tasks with their results as they come, on several processes.

    No task begins if the time left is shorter than the longest so far took.

    Args:
        work: A function of one task, which other processes can import.
        tasks: In the order in which they begin.
        budget: Time for all of them.
        workers: Number of parallel processes; by default the number of cores.
        at_least: Number of tasks that begin regardless of the time left.
    """
    workers = workers or core_budget()
    if workers < 2:
        for task in budget.items(tasks, at_least):
            yield task, work(task)
        return
    waiting, running, longest, begun = iter(tasks), {}, 0.0, 0
    with Pool(workers) as pool:
        while True:
            while len(running) < workers and (begun < at_least or budget.remaining > longest):
                try:
                    task = next(waiting)
                except StopIteration:
                    break
                running[pool.submit(work, task)] = task, budget.clock()
                begun += 1
            if not running:
                return
            done: set[Future]
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                task, since = running.pop(future)
                longest = max(longest, budget.clock() - since)
                yield task, future.result()
