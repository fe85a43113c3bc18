"""The force while a robot moves, for observers: a small file that exists meanwhile.

It is rewritten ten times a second and read by the add-on. It orders nothing, and nothing depends on
its being read.
"""

from __future__ import annotations

import json
import os
import time
from collections import deque
from pathlib import Path

import numpy as np

from limber.core.files.atomic import owned_name
from limber.robot.driver.link import COLUMNS

FILE = ".robot-live.json"
"""In the branch folder, beside the lock of the program that moves the robot."""
FORMAT = 1
_INTERVAL_SECONDS = 0.1
_KEPT = 150
"""Number of forces in the file, those of the last quarter of a minute."""
_FORCE, _SMOOTH, _EXPECTED = (slice(COLUMNS.index(name), COLUMNS.index(name) + 3)
                              for name in ("fx_n", "smooth_fx_n", "expected_fx_n"))


class LiveForce:
    """Writes the gripper's force; a context manager, which removes the file at its end.

    Args:
        folder: The branch folder.
        title: Title of the motion, for a person.
        limit: Force at which the guard pauses [N].
    """

    def __init__(self, folder: Path, title: str, limit: float):
        self._path = Path(folder) / FILE
        self._title, self._limit = title, limit
        self._step, self._peak, self._written = "", 0.0, 0.0
        self._recent: deque[tuple[float, float]] = deque(maxlen=_KEPT)
        self._force = self._expected = float("nan")

    def __enter__(self) -> LiveForce:
        return self

    def __exit__(self, *_exception: object) -> None:
        self._path.unlink(missing_ok=True)

    def at(self, step: str) -> None:
        """State the robot's current action."""
        self._step = step

    def take(self, samples: np.ndarray) -> None:
        """Take a batch of samples [n, 37], as in :data:`limber.robot.driver.link.COLUMNS`."""
        forces = np.linalg.norm(samples[:, _SMOOTH], axis=1)
        forces = np.where(np.isfinite(forces), forces,
                          np.linalg.norm(samples[:, _FORCE], axis=1))
        if np.isfinite(forces).any():
            self._peak = max(self._peak, float(np.nanmax(forces)))
        self._force = float(forces[-1])
        self._expected = float(np.linalg.norm(samples[-1, _EXPECTED]))
        now = time.monotonic()
        if now - self._written >= _INTERVAL_SECONDS:
            self._written = now
            if np.isfinite(self._force):
                self._recent.append((round(float(samples[-1, 0]), 3), round(self._force, 3)))
            self._write()

    def _write(self) -> None:
        """Without waiting for the disk: samples arrive meanwhile, and the file is short-lived."""
        content = {"format": FORMAT, "title": self._title, "step": self._step,
                   "force_n": _finite_or_none(self._force),
                   "expected_n": _finite_or_none(self._expected),
                   "peak_n": _finite_or_none(self._peak), "limit_n": self._limit, "at": time.time(),
                   "recent": list(self._recent)}
        temporary = self._path.with_name(owned_name(self._path.name))
        try:
            temporary.write_text(json.dumps(content), encoding="utf-8")
            os.replace(temporary, self._path)
        except OSError:
            # A full disk, or a reader that holds it on Windows: the samples continue, and the
            # recording reports the disk's error.
            temporary.unlink(missing_ok=True)


def _finite_or_none(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None
