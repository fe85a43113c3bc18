"""The trainer's process as a session sees it, and the thread that listens to it."""

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import LimberError
from limber.core.json_lines import json_objects
from limber.core.not_none import present
from limber.mechanics.grasp import Grasp
from limber.reduced.model_file import read_model
from limber.reduced.reduced_model import ReducedModel
from limber.reduced.state import ReducedState
from limber.session.settings import SessionSettings

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
        self._process = subprocess.Popen(
            [sys.executable, "-m", "limber.session.trainer", str(folder),
             settings.model_dump_json()],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            # Windows has no `nice` for the trainer to call itself.
            creationflags=getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0))
        self._write({"nodes": grasp.nodes.tolist(), "weights": grasp.weights.tolist(),
                     "mode": grasp.mode})
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

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
        self._process.kill()
        self._process.wait()
        self._listener.join(1.0)
        for stream in (self._process.stdin, self._process.stdout):
            try:
                if stream is not None:
                    stream.close()
            except (OSError, ValueError):
                continue  # nobody reads what was not sent

    def _write(self, line: dict[str, Any]) -> None:
        try:
            stdin = present(self._process.stdin, "standard input")
            stdin.write(json.dumps(line) + "\n")
            stdin.flush()
        except (OSError, ValueError):
            self._checked = None  # it has ended; its listener reports it

    def _listen(self) -> None:
        try:
            for content in json_objects(self._process.stdout or ()):
                self._hear(content)
        except (OSError, ValueError):
            pass  # closed while it was read
        if not self._closed:
            self.has_failed = True
            self._say(event="warning", message="the trainer has ended; the reduced model is no "
                      "longer checked, or does not exist")

    def _hear(self, content: dict[str, Any]) -> None:
        if self._closed:
            return
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

    def _adopt(self, content: dict[str, Any]) -> None:
        try:
            model = read_model(Path(content.pop("path")))
        except LimberError as error:
            self._say(event="warning", message=f"the reduced model was lost: {error}")
            return
        self._busy = False
        self._tell(Learnt(self.key, model, content))
