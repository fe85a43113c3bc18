"""Detects when the machine stalled: a virtual robot's faults then are due to the machine.

A virtual machine whose host gives its processors to others stalls for tens of milliseconds, with
all its processes. A robot's data is then older than the guard allows, and the arm is stopped, as it
should be. Such a run does not measure what was intended.
"""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import TypeVar

from limber.core.errors import LimberError

HELD_UP_SECONDS = 0.03
"""Shortest stall that may silence a loop for 50 ms. Chosen."""
_TOGETHER_SECONDS = 0.06
_MEANWHILE_SECONDS = 10.0
"""Longest delay of a failure after its cause: a loop of minutes has seen many stalls."""
_MOST_AGAIN = 3
FAILURES = (AssertionError, LimberError)
"""Of a run of a virtual robot."""
_Result = TypeVar("_Result")

_WATCHING = """
import os, sys, time
from limber.robot.driver.real_time import claim_real_time
if sys.argv[1:]:
    os.sched_setaffinity(0, [int(sys.argv[1])])
claim_real_time(30)
last = time.monotonic()
while True:
    time.sleep(0.001)
    now = time.monotonic()
    if now - last > 0.0015:
        try:
            print(now, now - last - 0.001, flush=True)
        except BrokenPipeError:
            sys.exit()
    last = now
"""


class Witness:
    """A process on each processor that wakes every 1 ms before all others.

    It records wake-ups that are at least 0.5 ms late.
    """

    def __init__(self) -> None:
        self._processes = [
            subprocess.Popen([sys.executable, "-c", _WATCHING, *processor], text=True,
                             stdin=subprocess.DEVNULL, stdout=subprocess.PIPE)
            for processor in _processors()]
        self._seen: list[list[tuple[float, float]]] = [[] for _ in self._processes]
        self._readers = [
            threading.Thread(target=self._read, args=[process, seen], name="witness", daemon=True)
            for process, seen in zip(self._processes, self._seen, strict=True)]
        for reader in self._readers:
            reader.start()

    def __enter__(self) -> "Witness":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()

    def longest(self, since: float) -> float:
        """Return the longest stall [s] that ended after ``since`` [s, monotonic clock].

        Consecutive pieces within the 60 ms in which a robot's data grows too old count as one: a
        host takes its time away like this.
        """
        near = [[one for one in tuple(seen) if one[0] > since - _TOGETHER_SECONDS]
                for seen in self._seen]
        return max((max(seconds, self._lost_of(seen, moment - _TOGETHER_SECONDS, moment))
                    for seen in near for moment, seconds in seen if moment > since), default=0.0)

    def lost(self, since: float, until: float) -> float:
        """Return the largest total stall of a processor between two moments [s]."""
        return max(self._lost_of(tuple(seen), since, until) for seen in self._seen)

    @staticmethod
    def _lost_of(seen: Sequence[tuple[float, float]], since: float, until: float) -> float:
        return sum(max(min(moment, until) - max(moment - seconds, since), 0.0)
                   for moment, seconds in seen)

    def close(self) -> None:
        """End the processes."""
        for process, reader in zip(self._processes, self._readers, strict=True):
            process.kill()
            process.wait()
            reader.join(2.0)
            assert process.stdout is not None
            process.stdout.close()

    def _read(self, process: subprocess.Popen[str], seen: list[tuple[float, float]]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            if not line.endswith("\n"):
                # The process ended while it wrote.
                return
            moment, seconds = map(float, line.split())
            seen.append((moment, seconds))


def _processors() -> list[list[str]]:
    """Return the arguments of each watching process; one without any if none can be bound."""
    if not hasattr(os, "sched_getaffinity"):
        return [[]]
    return [[str(processor)] for processor in sorted(os.sched_getaffinity(0))]


class Voided:
    """Runs that failed while the machine stalled; each is reported and repeated."""

    def __init__(self, witness: Witness):
        self._witness = witness
        self.count = 0

    def again(self, run: Callable[[], _Result], name: str) -> _Result:
        """Return what ``run`` returns; repeat it if the machine stalled.

        Raises:
            AssertionError, LimberError: it failed and the machine did not stall, or stalled at
                every one of four tries.
        """
        for _ in range(_MOST_AGAIN):
            began = time.monotonic()
            try:
                return run()
            except FAILURES as error:
                longest = self._witness.longest(max(began, time.monotonic() - _MEANWHILE_SECONDS))
                if longest < HELD_UP_SECONDS:
                    raise
                self.count += 1
                print(f"{name}: once more, the machine stood still for {1000 * longest:.0f} ms: "
                      f"{error}", flush=True)
        return run()

    def explains(self, since: float, until: float, late: float, name: str) -> bool:
        """Return whether the machine stalled between two moments for at least the delay.

        Its host takes a processor away in pieces, which are added up. If they explain the delay, it
        is reported and counted: the run is to be repeated.
        """
        lost = self._witness.lost(since, until)
        if lost < late:
            return False
        self.count += 1
        print(f"{name}: once more, {1000 * late:.1f} ms late where the machine stood still for "
              f"{1000 * lost:.1f} ms", flush=True)
        return True

    def __str__(self) -> str:
        return f"; {self.count} done again, the machine stood still" if self.count else ""
