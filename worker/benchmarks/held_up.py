"""Tells when the machine stood still: what a virtual robot then does is the machine's doing.

A virtual machine whose host gives its processors to others stands still for tens of milliseconds,
all its processes together. A robot's data is then older than the guard allows, and the arm is
stopped, as it should be; of what was to be measured that says nothing.
"""

import subprocess
import sys
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import TypeVar

from limber.errors import LimberError

HELD_UP_SECONDS = 0.03
"""From here on a loop that may be silent for 50 ms can come to be: chosen."""
_MOST_AGAIN = 3
_Result = TypeVar("_Result")

_WATCHING = """
import sys, time
from limber.robot.real_time import claim_real_time
claim_real_time(30)
last = time.monotonic()
while True:
    time.sleep(0.002)
    now = time.monotonic()
    if now - last > 0.01:
        try:
            print(now, now - last, flush=True)
        except BrokenPipeError:
            sys.exit()
    last = now
"""


class Witness:
    """A process that wants to run every 2 ms before all others, and notes when it could not."""

    def __init__(self) -> None:
        self._process = subprocess.Popen([sys.executable, "-c", _WATCHING], text=True,
                                         stdin=subprocess.DEVNULL, stdout=subprocess.PIPE)
        self._seen: list[tuple[float, float]] = []
        self._reader = threading.Thread(target=self._read, name="witness", daemon=True)
        self._reader.start()

    def __enter__(self) -> "Witness":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()

    def longest(self, since: float) -> float:
        """Return the longest stand-still [s] that ended after ``since`` [s, monotonic clock]."""
        return max((seconds for moment, seconds in self._seen if moment > since), default=0.0)

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        self._reader.join(2.0)
        assert self._process.stdout is not None
        self._process.stdout.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            moment, seconds = map(float, line.split())
            self._seen.append((moment, seconds))


class Voided:
    """Runs that failed while the machine stood still; each is told, and done once more."""

    def __init__(self, witness: Witness):
        self._witness = witness
        self.count = 0

    def again(self, run: Callable[[], _Result], name: str) -> _Result:
        """Return what ``run`` returns, doing it again where the machine held it up.

        Raises:
            AssertionError, LimberError: it failed and the machine did not stand still, or stood
                still at every one of four tries.
        """
        for _ in range(_MOST_AGAIN):
            began = time.monotonic()
            try:
                return run()
            except (AssertionError, LimberError) as error:
                longest = self._witness.longest(began)
                if longest < HELD_UP_SECONDS:
                    raise
                self.count += 1
                print(f"{name}: once more, the machine stood still for {1000 * longest:.0f} ms: "
                      f"{error}", flush=True)
        return run()

    def __str__(self) -> str:
        return f"; {self.count} done again, the machine stood still" if self.count else ""
