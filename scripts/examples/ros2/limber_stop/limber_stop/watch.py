"""When to stop: on a stop that was published, or where the beat of ``limber ros`` ends."""


class Watch:
    """Decides by what came on the stop topic; reads no clock.

    Args:
        longest: Silence after which a motion is stopped [s]; Limber beats every 0.1 s.
    """

    def __init__(self, longest: float = 0.3):
        self._longest = longest
        self._beat: float | None = None

    def heard(self, stop: bool, now: float) -> bool:
        """A message came; returns whether to stop. False is a beat: a motion is under way."""
        self._beat = None if stop else now
        return stop

    def ended(self) -> None:
        """The motion has come to its end: no more beats follow."""
        self._beat = None

    def is_silent(self, now: float) -> bool:
        """Whether the beat has ended without a word; told once."""
        if self._beat is None or now - self._beat <= self._longest:
            return False
        self._beat = None
        return True
