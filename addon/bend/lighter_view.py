"""The view without anti-aliasing while the branch is held, where the view is drawn slowly."""

import time
from collections import deque

import bpy

_SLOW_SECONDS = 1 / 30
_COUNT = 12
"""Number of drawn frames that are judged."""


class LighterView:
    """Measures how long drawn frames hold Blender up; switches anti-aliasing off if that is long.

    On a software renderer anti-aliasing takes 40 % of the time of a frame.
    """

    def __init__(self, preferences: bpy.types.Preferences):
        self._preferences = preferences
        self._seconds: deque[float] = deque(maxlen=_COUNT)
        self._shown_at: float | None = None
        self._before = ""

    @property
    def is_on(self) -> bool:
        return bool(self._before)

    def shown(self, now: float | None = None) -> None:
        """Note that a frame was given to Blender, at ``now`` of the clock [s]."""
        self._shown_at = time.perf_counter() if now is None else now

    def turned(self, now: float | None = None) -> None:
        """Note that Blender's next turn has come: it has drawn the frame before."""
        if self._shown_at is None:
            return
        self._seconds.append((time.perf_counter() if now is None else now) - self._shown_at)
        self._shown_at = None
        is_slow = len(self._seconds) == _COUNT and (
            sorted(self._seconds)[_COUNT // 2] > _SLOW_SECONDS)
        if is_slow and not self.is_on and self._preferences.system.viewport_aa != "OFF":
            self._before = self._preferences.system.viewport_aa
            self._set("OFF")

    def end(self) -> None:
        """Switch anti-aliasing on again; safe to call again."""
        if self.is_on:
            self._set(self._before)
            self._before = ""

    def _set(self, kind: str) -> None:
        # Blender would otherwise save the preferences when it quits.
        was_changed = self._preferences.is_dirty
        self._preferences.system.viewport_aa = kind
        self._preferences.is_dirty = was_changed
