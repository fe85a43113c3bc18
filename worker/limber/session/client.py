"""Python client of an interactive session (limber.session.worker)."""

import contextlib
import itertools
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import InputError, WorkError
from limber.core.not_none import present
from limber.core.processes.child import Child
from limber.session.frame_buffer import Frame, FrameReader
from limber.session.protocol import PROTOCOL, SessionSettings
from limber.version import VERSION

_GRACE_SECONDS = 3.0
_MOST_EVENTS = 1000


class InteractiveSession:
    """A branch in a separate process that follows its grasps. ::

        with InteractiveSession("apple.branch", mode="point") as session:
            frame = session.wait(session.move(pose))
            second = session.grab(point=(0.0, 0.1, 0.4))
            session.move(second["pose"], grasp=second["grasp"])

    Args:
        branch_folder: The branch.
        mode: Mode of the marked grasp, which is held at the start: ``rigid`` or ``point``.
        settings: Further fields of :class:`limber.session.protocol.SessionSettings`.
        start_seconds: Longest duration of the start.

    Attributes:
        hello: The session's description of itself.
        faces: Triangles of the surface, shape [f, 3].
        events: Events so far, newest last (at most 1000 are kept).

    Raises:
        WorkError: the session did not start, or speaks another protocol.
    """

    def __init__(self, branch_folder: str | Path, *, mode: str = "rigid",
                 start_seconds: float = 60.0, **settings: Any):
        chosen = SessionSettings(mode=mode, **settings)
        self._child = Child(
            [sys.executable, "-m", "limber.session.worker", str(branch_folder),
             "--settings", chosen.model_dump_json()], most_objects=_MOST_EVENTS,
            keeps_errors=True)
        self.events = self._child.objects
        self._ids = 0
        self._frames: FrameReader | None = None
        self._is_closed = False
        hello = self.wait_for("hello", start_seconds)
        trouble = self._trouble() if hello is None else other_protocol(hello)
        if hello is None or trouble:
            self.close()
            raise WorkError(f"The session did not start: {trouble}")
        self.hello: dict[str, Any] = hello
        self._frames = FrameReader(Path(hello["positions"]))
        self.faces = self._frames.faces

    def __enter__(self) -> "InteractiveSession":
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    @property
    def alive(self) -> bool:
        """Whether the session's process is running."""
        return self._child.alive

    @property
    def process_id(self) -> int:
        return self._child.process.pid

    def move(self, pose: np.ndarray, grasp: int | None = None) -> int:
        """Request a grasp (the first, if not named) at a pose [m, rad].

        Returns:
            The number that the answering frame will contain.

        Raises:
            WorkError: the session has ended.
        """
        return self._send(command="move", pose=np.asarray(pose, float).tolist(), grasp=grasp)

    def grab(self, *, vertex: int | None = None, point: Sequence[float] | None = None,
             mode: str = "point", radius: float = 0.01) -> dict[str, Any]:
        """Hold the branch in its current position; return the reply with ``grasp`` and ``pose``.

        Args:
            vertex: Vertex of the surface; or ``point`` [m] on the branch as it was scanned.
            radius: Radius of the patch [m].

        Raises:
            InputError: the branch is not there, or the base or another grasp is.
        """
        return self.request("grasp", vertex=vertex, mode=mode, radius_m=radius,
                            point=None if point is None else [float(x) for x in point])

    def release(self, grasp: int | None = None) -> dict[str, Any]:
        """Release a grasp, or all; return the reply."""
        return self.request("release", grasp=grasp)

    def set_young(self, young: np.ndarray) -> dict[str, Any]:
        """Set Young's modulus at the control points [Pa]; return the reply."""
        return self.request("young", young_pa=np.asarray(young, float).tolist())

    def set_gravity(self, on: bool) -> dict[str, Any]:
        """Switch the branch's weight on or off; return the reply."""
        return self.request("gravity", on=on)

    def set_loads(self, loads: Sequence[dict[str, Any]]) -> dict[str, Any]:
        """Hang forces on the branch, ``{"vertex" or "point", "force_n"}`` each, replacing the
        earlier ones; return the reply.
        """
        return self.request("loads", loads=list(loads))

    def set_outdoors(self, **loads: Any) -> dict[str, Any]:
        """Apply wind (``wind_m_s``), ``snow_kg_m2`` and ``fruit``, and cut at ``cuts``.

        They replace the earlier ones; see `limber.session.worker` for their form.
        """
        return self.request("outdoors", **loads)

    def effects(self, *, seconds: float = 120.0, **question: Any) -> dict[str, Any]:
        """Return the effects of :meth:`set_outdoors` on the branch: sag, strain over strength,
        frequencies and, with ``limit_load=True``, the factor on the loads that it bears; with
        intervals if an estimate exists. Takes seconds; the branch can be moved meanwhile.

        ``gust=0.3`` adds turbulence of that intensity, ``gust_record`` the gusts of a CSV file
        (``time_s``, ``speed_m_s``) along the wind's direction: the results are then for their peak.

        Raises:
            InputError: there is no weather to apply, or the branch has no equilibrium under it.
            WorkError: there was no reply within ``seconds``.
        """
        record = question.get("gust_record")
        if isinstance(record, str | os.PathLike):
            # It loads the mechanics, which a client does not need otherwise.
            from limber.mechanics.loads.load_effects import WindRecord

            wind = WindRecord.read(Path(record))
            question["gust_record"] = {"time_s": wind.times.tolist(),
                                       "speed_m_s": wind.speeds.tolist()}
        return self.request("effects", seconds, **question)

    def set_dynamics(self, on: bool) -> dict[str, Any]:
        """Switch between motion over time and equilibria; return the reply."""
        return self.request("dynamics", on=on)

    def request(self, command: str, seconds: float = 30.0, **fields: Any) -> dict[str, Any]:
        """Send a command and return its reply.

        Raises:
            InputError: the session refused it, with its reason.
            WorkError: the session has ended, or did not reply in time.
        """
        number = self._send(command=command, **fields)
        found = self._child.wait(lambda: next((
            line for line in reversed(self.events) if line.get("id") == number
            and line.get("event") in ("reply", "error")), None), seconds)
        if found is not None and found["event"] == "error":
            raise InputError(found["message"])
        if found is not None:
            return found
        self._check()
        raise WorkError(f"The session did not reply to `{command}` within {seconds:g} s.",
                        "It may still be solving.", "Wait longer, or close it.")

    def latest(self) -> Frame | None:
        """Return the newest frame, None before the first.

        Raises:
            WorkError: the session process has ended.
        """
        self._check()
        return present(self._frames, "frame of the session").read()

    def wait(self, move_id: int, seconds: float = 10.0) -> Frame | None:
        """Return the first frame that answers ``move_id`` or a later one; None if too late."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            frame = self.latest()
            if frame is not None and frame.move_id >= move_id:
                return frame
            time.sleep(0.0005)
        return None

    def wait_for(self, event: str, seconds: float = 10.0, count: int = 1) -> dict | None:
        """Return the ``count``-th event of a kind, waiting for it; None if it does not come."""
        return self._child.wait(lambda: next(itertools.islice(
            (line for line in self.events if line.get("event") == event), count - 1, None), None),
                                seconds)

    def close(self) -> None:
        """End the session; safe to call again."""
        if self.alive:
            with contextlib.suppress(WorkError):  # it is just ending
                self._send(command="close")
        self._child.close(_GRACE_SECONDS)
        if self._frames is not None:
            self._frames.close()
            # A killed session could not clean up.
            Path(self.hello["positions"]).unlink(missing_ok=True)
            self._frames = None
            self._is_closed = True

    def _send(self, **command: Any) -> int:
        self._check()
        self._ids += 1
        line = {"id": self._ids} | {name: value for name, value in command.items()
                                    if value is not None}
        try:
            self._child.send(line)
        except ConnectionError as error:
            raise WorkError(f"The session has ended: {self._trouble()}") from error
        return self._ids

    def _check(self) -> None:
        if self._is_closed:
            raise WorkError("The session is closed.", "", "Start a new one.")
        if not self.alive:
            raise WorkError(
                f"The session has ended with exit code {self._child.process.returncode}:"
                f" {self._trouble()}", "", "Close it and start a new one.")

    def _trouble(self) -> str:
        messages = [line["message"] for line in self.events if line.get("event") == "failed"]
        if messages:
            return messages[-1]
        return self._child.tail() or "no message"


def other_protocol(hello: dict[str, Any]) -> str:
    """Return the error if a session uses another protocol than this client, else an empty text."""
    theirs = hello.get("protocol")
    if theirs == PROTOCOL:
        return ""
    return (f"it speaks protocol {theirs} (Limber {hello.get('limber', 'of an older version')}),"
            f" this client {PROTOCOL} (Limber {VERSION}). Install one version of Limber for both.")
