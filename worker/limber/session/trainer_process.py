"""The trainer's process as a session sees it, and the thread that listens to it."""

import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import LimberError
from limber.core.processes.child import Child
from limber.mechanics.grasp import Grasp
from limber.reduced.model_cache import read_model
from limber.reduced.reduced_model import ReducedModel, ReducedState
from limber.session.protocol import SessionSettings

_CHECK_INTERVAL = 1.0


@dataclass(frozen=True)
class Learnt:
    """A reduced model that is ready, with the data that a frame needs; ``key`` states its grasp."""

    key: tuple[str, bytes]
    model: ReducedModel
    event: dict[str, Any]


@dataclass(frozen=True)
class Checked:
    """A comparison with the full model at a pose [m, rad]."""

    key: tuple[str, bytes]
    pose: np.ndarray
    good: bool
    event: dict[str, Any]


def key_of(grasp: Grasp) -> tuple[str, bytes]:
    """Return the key of a learnt model: the patch, and how it is held."""
    return grasp.mode, grasp.nodes.tobytes() + grasp.weights.tobytes()


class Learning:
    """A trainer at work on one grasp.

    Args:
        folder, settings: Those of the session.
        grasp: Grasp to learn.
        tell: Receives :class:`Learnt` and :class:`Checked`, from another thread.
        say: Receives the trainer's other events.
    """

    def __init__(self, folder: Path, settings: SessionSettings, grasp: Grasp,
                 tell: Callable[[Learnt | Checked], object], say: Callable[..., None]):
        self.key = key_of(grasp)
        self.has_failed = False
        self._tell, self._say = tell, say
        self._last_check = 0.0
        self._checked: np.ndarray | None = None
        self._busy, self._closed = True, False
        self._child = Child(
            [sys.executable, "-m", "limber.session.trainer", str(folder),
             settings.model_dump_json()], self._hear, self._ended,
            # Windows has no `nice` for the trainer to call itself.
            creationflags=getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0))
        self._write({"nodes": grasp.nodes.tolist(), "weights": grasp.weights.tolist(),
                     "mode": grasp.mode})

    def check(self, state: ReducedState) -> None:
        """Request a comparison with the full model, if the trainer is free and the pose is new."""
        now = time.monotonic()
        if self._busy or now - self._last_check < _CHECK_INTERVAL or (
                self._checked is not None and np.allclose(self._checked, state.pose)):
            return
        self._last_check, self._checked, self._busy = now, state.pose, True
        self._write({"pose": state.pose.tolist(), "young_pa": state.young.tolist()})

    def close(self) -> None:
        """End the process."""
        self._closed = True
        self._child.kill()

    def _write(self, line: dict[str, Any]) -> None:
        try:
            self._child.send(line)
        except ConnectionError:
            self._checked = None  # it has ended, which `_ended` reports

    def _ended(self) -> None:
        if not self._closed:
            self.has_failed = True
            self._say(event="warning", message="the trainer has ended; the reduced model is no "
                      "longer checked, or does not exist")

    def _hear(self, content: dict[str, Any]) -> bool:
        if self._closed:
            return True
        kind = content.get("event")
        if kind == "model":
            self._adopt(content)
        elif kind == "check":
            if self._checked is not None:
                self._tell(Checked(self.key, self._checked, bool(content["good"]), content))
            self._busy = False
        elif "progress" in content:
            self._say(event="progress", **content)
        elif kind == "failed":
            self._say(event="warning", message=f"there is no reduced model: {content['message']}")
        else:
            self._say(**content)
        return True

    def _adopt(self, content: dict[str, Any]) -> None:
        try:
            model = read_model(Path(content.pop("path")))
        except LimberError as error:
            self._say(event="warning", message=f"the reduced model was lost: {error}")
            return
        self._busy = False
        self._tell(Learnt(self.key, model, content))
