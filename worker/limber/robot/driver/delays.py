"""Times in which the computer held the driver's loop up."""

import time
from collections.abc import Callable

_HELD_UP_SECONDS = 0.02
_GRACE_SECONDS = 0.015


class HoldUps:
    """Sees that the loop was held up, and gives it time to read what came meanwhile.

    What came waits in the connections, and is read and judged. That nothing came tells of no
    silence yet: it is listened for once more, and no second time without a sample.

    Args:
        quiet: How long the loop listens at a time [s].
        tell: Says what happened.
    """

    def __init__(self, quiet: float, tell: Callable[..., None]):
        self._quiet, self._tell = quiet, tell
        self._woke, self._listened = -float("inf"), time.monotonic()

    def set_off(self) -> None:
        """Starting a program took its time, and is no hold-up."""
        self._listened = time.monotonic()

    def note(self, last_arrived: float | None, *, moving: bool) -> None:
        """The loop has listened once more.

        Args:
            last_arrived: When the last sample came, on the monotonic clock [s].
            moving: Whether anything is followed.
        """
        before, self._listened = self._listened, time.monotonic()
        overslept = self._listened - before - self._quiet
        if overslept < _HELD_UP_SECONDS:
            return
        if last_arrived is None or last_arrived > self._woke:
            self._woke = self._listened
        if moving:
            self._tell(event="warning", text="the computer delayed the robot's program by "
                       f"{1000 * overslept:.0f} ms, and nothing was monitored during that time")

    @property
    def has_just_woken(self) -> bool:
        """Whether a hold-up is just over."""
        return time.monotonic() - self._woke < _GRACE_SECONDS
