"""Python client of an interactive session (limber.session.worker)."""

import contextlib
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from limber.errors import WorkError
from limber.session.frames import Frame, FrameReader

_GRACE_SECONDS = 3.0


class InteractiveSession:
    """A branch in a process of its own that follows the grasp. ::

        with InteractiveSession("apple.branch") as session:
            session.move(pose)
            frame = session.latest()

    Args:
        branch_folder: The branch.
        mode: ``clamped`` or ``pinned``.
        options: Further options of ``python -m limber.session.worker``.
        start_seconds: How long the start may take.

    Attributes:
        hello: What the session said of itself.
        faces: Triangles of the surface, shape [f, 3].
        events: Events so far, newest last (at most 1000 are kept).

    Raises:
        WorkError: the session did not start.
    """

    def __init__(self, branch_folder: str | Path, *, mode: str = "clamped",
                 options: Sequence[str] = (), start_seconds: float = 60.0):
        self.events: list[dict[str, Any]] = []
        self._said = threading.Condition()
        self._errors = tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace")
        self._process = subprocess.Popen(
            [sys.executable, "-m", "limber.session.worker", str(branch_folder),
             "--mode", mode, *options],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, text=True)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()
        self._moves = 0
        self._frames: FrameReader | None = None
        hello = self.wait_for("hello", start_seconds)
        if hello is None:
            message = self._trouble()
            self.close()
            raise WorkError(f"The session did not start: {message}")
        self.hello = hello
        self._frames = FrameReader(Path(hello["positions"]))
        self.faces = self._frames.faces

    def __enter__(self) -> "InteractiveSession":
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    @property
    def alive(self) -> bool:
        """Whether the session's process runs."""
        return self._process.poll() is None

    @property
    def process_id(self) -> int:
        return self._process.pid

    def move(self, pose: np.ndarray) -> int:
        """Ask for the grasp at a pose [m, rad]; return the number that the answer will carry.

        Raises:
            WorkError: the session has ended.
        """
        self._moves += 1
        self._send(command="move", id=self._moves, pose=np.asarray(pose, float).tolist())
        return self._moves

    def set_young(self, young: np.ndarray) -> None:
        """Set Young's modulus at the control points [Pa]."""
        self._send(command="young", young_pa=np.asarray(young, float).tolist())

    def set_dynamics(self, on: bool) -> None:
        """Let the branch move in time, or answer with equilibria."""
        self._send(command="dynamics", on=on)

    def latest(self) -> Frame | None:
        """Return the newest frame, None before the first.

        Raises:
            WorkError: the session has ended by itself.
        """
        self._check()
        return self._frames.read()

    def wait(self, move_id: int, seconds: float = 10.0) -> Frame | None:
        """Return the first frame seen that answers ``move_id`` or a later one; None if too late."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            frame = self.latest()
            if frame is not None and frame.move_id >= move_id:
                return frame
            time.sleep(0.0005)
        return None

    def wait_for(self, event: str, seconds: float = 10.0, count: int = 1) -> dict | None:
        """Return the ``count``-th event of a kind, waiting for it; None if it does not come."""
        end = time.monotonic() + seconds
        with self._said:
            while True:
                found = [line for line in self.events if line.get("event") == event]
                if len(found) >= count:
                    return found[count - 1]
                left = end - time.monotonic()
                if left <= 0 or not self._listener.is_alive():
                    return None
                self._said.wait(min(left, 0.2))

    def close(self) -> None:
        """End the session; safe to call again."""
        if self.alive:
            try:
                self._send(command="close")
                self._process.stdin.close()
                self._process.wait(_GRACE_SECONDS)
            except (WorkError, OSError, subprocess.TimeoutExpired):
                self._process.kill()
        self._process.wait()
        if self._frames is not None:
            self._frames.close()
            # Where the session was killed it could not tidy up itself.
            Path(self.hello["positions"]).unlink(missing_ok=True)
            self._frames = None
        self._listener.join(1.0)
        for stream in (self._process.stdin, self._process.stdout, self._errors):
            if stream and not stream.closed:
                with contextlib.suppress(OSError):  # what was not sent has nobody to read it
                    stream.close()

    def _listen(self) -> None:
        for line in self._process.stdout or ():
            try:
                content = json.loads(line)
            except json.JSONDecodeError:
                continue  # a native library's own words
            with self._said:
                self.events.append(content)
                del self.events[:-1000]
                self._said.notify_all()
        with self._said:
            self._said.notify_all()

    def _send(self, **command: Any) -> None:
        self._check()
        try:
            self._process.stdin.write(json.dumps(command) + "\n")
            self._process.stdin.flush()
        except (OSError, ValueError) as error:
            raise WorkError(f"The session has ended: {self._trouble()}") from error

    def _check(self) -> None:
        if self._frames is None and hasattr(self, "hello"):
            raise WorkError("The session is closed.", "", "Start a new one.")
        if not self.alive:
            raise WorkError(
                f"The session has ended with exit code {self._process.returncode}:"
                f" {self._trouble()}", "", "Close it and start a new one.")

    def _trouble(self) -> str:
        said = [line["message"] for line in self.events if line.get("event") == "error"]
        if said:
            return said[-1]
        if self._errors.closed:
            return "no message"
        self._errors.seek(0)
        return " | ".join(self._errors.read().strip().splitlines()[-4:]) or "no message"
