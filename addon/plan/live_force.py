"""The force at a moving robot, read from a file that the worker writes meanwhile. No bpy.

The file also exists if the robot was armed at a terminal. This module orders nothing.
"""

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path

FILE = ".robot-live.json"
FORMAT = 1
_OLDEST_SECONDS = 3.0
"""Older files were left behind by a worker that was killed."""


@dataclass(frozen=True)
class LiveForce:
    """Force at the gripper now [N]; ``force`` and ``expected`` are None if unknown."""

    title: str
    step: str
    force: float | None
    expected: float | None
    peak: float
    limit: float

    @property
    def share(self) -> float:
        """Force as a fraction of the limit at which the guard pauses the robot."""
        return (self.force or 0.0) / self.limit


def read(folder: Path, now: float | None = None) -> LiveForce | None:
    """Return the force that the robot at a branch measures; None while no robot moves, or if the
    file is invalid."""
    path = folder / FILE
    if not path.is_file():
        # There is none; or a pipe, for which Blender would wait.
        return None
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        if told["format"] != FORMAT or (time.time() if now is None else now) - told["at"] > (
                _OLDEST_SECONDS):
            return None
        found = LiveForce(str(told["title"]), str(told["step"]), _number(told["force_n"]),
                          _number(told["expected_n"]), _number(told["peak_n"]) or 0.0,
                          _number(told["limit_n"]) or 0.0)
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return found if found.limit > 0 else None


def _number(value: float | None) -> float | None:
    return float(value) if value is not None and math.isfinite(value) else None
