"""Delays of the driver's loop by the computer."""

import time
from collections.abc import Callable

_HELD_UP_SECONDS = 0.02
_GRACE_SECONDS = 0.015


class HoldUps:
    """Detects a delay of the loop, and gives it time to read the messages from that time.

    Messages that arrived wait in the connections, and are read and judged. Their absence does not
    prove silence yet: the loop listens once more, and not a second time without a sample.

    Args:
        quiet: Time for which the loop listens at once [s].
        tell: Reports events.
    """

    def __init__(self, quiet: float, tell: Callable[..., None]):
        self._quiet, self._tell = quiet, tell
        self._woke, self._listened = -float("inf"), time.monotonic()

    def set_off(self) -> None:
        """Starting a program took this time; it is no delay."""
        self._listened = time.monotonic()

    def note(self, last_arrived: float | None, *, moving: bool) -> None:
        """The loop has listened once more.

        Args:
            last_arrived: When the last sample came, on the monotonic clock [s].
            moving: Whether a trajectory is followed.
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
        """Whether a delay has just ended."""
        return time.monotonic() - self._woke < _GRACE_SECONDS
