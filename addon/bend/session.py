"""A branch held by a process of the worker (``limber session``), which answers while it is bent.

No bpy here. The owner of the session calls :meth:`Session.poll` from Blender's main thread.
``python -m limber.session.worker --help`` describes the protocol. Frames come through a file that
both have mapped.
"""

import atexit
import json
import mmap
import subprocess
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..jobs.worker_process import WorkerProcess

PROTOCOL = 2
_MAGIC = b"LIMBPOS2"
_HEADER_BYTES = 128
_NUMBERS = ("id", "status", "is_trusted", "is_converged", "is_reached", "is_reduced", "energy_j",
            "force_x_n", "force_y_n", "force_z_n", "torque_x_nm", "torque_y_nm", "torque_z_nm",
            "delay_s", "kinetic_energy_j", "time_s", "greatest_strain", "strain_x_m", "strain_y_m",
            "strain_z_m", "min_det_f", "gravity_on", "sag_m")
_WHO = {1: "learning", 2: "reduced", 3: "full", 4: "untrusted"}
_GRASP_COLUMNS = 13


@dataclass(frozen=True)
class HeldFrame:
    """The present state of the held branch.

    Attributes:
        sequence: Number of the frame.
        answers: Number of the command that it answers.
        who: ``learning``, ``reduced``, ``full`` or ``untrusted``: the model that answers.
        energy: [J], above the hanging branch.
        force: Force of the gripper on the branch [N], three components.
        strain: The greatest principal strain.
        sag: Largest displacement along gravity [m].
        positions: Positions of the surface's vertices [m], float32, shape [v, 3].
    """

    sequence: int
    answers: int
    who: str
    energy: float
    force: tuple[float, float, float]
    strain: float
    sag: float
    positions: np.ndarray


class FrameFile:
    """The file of frames, read; ValueError if it is not one, or of another version."""

    def __init__(self, path: Path, vertex_count: int):
        with open(path, "rb") as stream:
            if stream.read(8) != _MAGIC:
                raise ValueError(f"{path} has no frames that this version of the add-on can read.")
            self._map = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        vertices, _, slots, numbers, grasps, targets = np.frombuffer(
            self._map, "<u4", 6, 8).tolist()
        _, first, size = np.frombuffer(self._map, "<u8", 3, 48).tolist()
        before = 8 * (numbers + _GRASP_COLUMNS * grasps + 3 * targets)
        if vertices != vertex_count:
            self._map.close()
            raise ValueError(f"The branch in its folder has {vertices} surface vertices, but the "
                             f"shown branch has {vertex_count}. Open the result again.")
        if slots < 2 or numbers < len(_NUMBERS) or before + 12 * vertices > size or (
                first < _HEADER_BYTES or first + slots * size > len(self._map)):
            self._map.close()
            raise ValueError(f"{path} is truncated.")
        self._sequence = np.frombuffer(self._map, "<u8", 1, 40)
        starts = [first + slot * size for slot in range(slots)]
        self._numbers = [np.frombuffer(self._map, "<f8", len(_NUMBERS), at) for at in starts]
        self._positions = [np.frombuffer(self._map, "<f4", 3 * vertices, at + before)
                           for at in starts]

    def read(self, after: int = 0) -> HeldFrame | None:
        """Return the newest frame if it is newer than number ``after``."""
        while (sequence := int(self._sequence[0])) > after:
            slot = sequence % len(self._numbers)
            numbers = dict(zip(_NUMBERS, self._numbers[slot].tolist(), strict=True))
            positions = self._positions[slot].copy()
            if int(self._sequence[0]) - sequence < len(self._numbers) - 1:
                return HeldFrame(
                    sequence, int(numbers["id"]), _WHO.get(int(numbers["status"]), "untrusted"),
                    numbers["energy_j"], tuple(numbers[f"force_{axis}_n"] for axis in "xyz"),
                    numbers["greatest_strain"], numbers["sag_m"], positions.reshape(-1, 3))
        return None

    def close(self) -> None:
        """Release the file: a map cannot be closed while arrays refer to it."""
        self._numbers, self._positions, self._sequence = [], [], np.zeros(1, "<u8")
        self._map.close()


class Session:
    """One branch that is held; close it when done.

    Attributes:
        hello: The session's report about itself after loading the branch; empty before.
        error: Reason of its end, for the user; empty while it runs.
        message: Its current work, with the fraction done.
    """

    def __init__(self, command: list[str], vertex_count: int):
        self.hello: dict[str, Any] = {}
        self.error = ""
        self.message = "loading the branch"
        self._vertex_count = vertex_count
        self._frames: FrameFile | None = None
        self._ids = 0
        self._said: deque[str] = deque(maxlen=20)
        self._process = WorkerProcess(command)
        _open.append(self)

    @property
    def pid(self) -> int:
        return self._process.pid

    def poll(self) -> list[dict[str, Any]]:
        """Return the replies and errors since the last call; the other messages are stored."""
        told = []
        has_ended = self._process.poll() is not None
        for event in self._process.told():
            kind = event.get("event") if isinstance(event, dict) else None
            if not isinstance(kind, str):
                self._said.append(str(event))
                continue
            if kind == "hello":
                self._begin(event)
            elif kind == "failed":
                self.error = str(event.get("message", ""))
            elif kind == "progress":
                self.message = f"learning {100 * float(event.get('progress', 0)):.0f} %"
            elif kind == "model":
                self.message = ""
            elif kind in ("reply", "error"):
                told.append(event)
        if has_ended and not self.error:
            self.error = " ".join(["The session ended.", *list(self._said)[-2:]])
        return told

    def frame(self, after: int = 0) -> HeldFrame | None:
        """Return the newest frame if it is newer than number ``after``."""
        return self._frames.read(after) if self._frames else None

    def grasp(self, point: tuple[float, float, float], radius: float) -> int:
        """Hold the branch about ``point`` [m], on the branch as scanned, at its present position.

        Returns:
            The number that the reply carries.
        """
        return self._send(command="grasp", point=list(point), radius_m=radius, mode="point")

    def move(self, grasp: int, position: tuple[float, float, float]) -> int:
        """Move a grasp to ``position`` [m]."""
        return self._send(command="move", grasp=grasp, pose=[*position, 0.0, 0.0, 0.0])

    def release(self) -> int:
        """Release all grasps."""
        return self._send(command="release")

    def load(self, **loads: Any) -> int:
        """Apply wind, snow, fruit and cut twigs, instead of the previous ones.

        Returns:
            The number that the reply carries; it states what is ``gone``.
        """
        return self._send(command="outdoors", **loads)

    def weigh(self, on: bool) -> int:
        """Switch the branch's weight on or off."""
        return self._send(command="gravity", on=on)

    def close(self) -> None:
        """End the session; safe to call again."""
        if self in _open:
            _open.remove(self)
        if self._frames is not None:
            self._frames.close()
            self._frames = None
        try:
            # It ends with its input, within seconds, and removes its own file.
            self._process.stdin.close()
            self._process.wait(2.0)
        except (OSError, subprocess.TimeoutExpired):
            self._process.end_now()
            self._process.wait()
            if path := self.hello.get("positions"):
                Path(path).unlink(missing_ok=True)

    def _begin(self, hello: dict[str, Any]) -> None:
        if hello.get("protocol") != PROTOCOL:
            self.error = (f"The worker's session uses protocol {hello.get('protocol')}, but this "
                          f"add-on uses protocol {PROTOCOL}. Install the add-on and the worker of "
                          "the same version.")
            return
        try:
            self._frames = FrameFile(Path(hello["positions"]), self._vertex_count)
        except (OSError, ValueError, KeyError) as error:
            self.error = str(error)
            return
        self.hello, self.message = hello, ""

    def _send(self, **command: Any) -> int:
        self._ids += 1
        try:
            self._process.stdin.write(json.dumps({"id": self._ids, **command}) + "\n")
            self._process.stdin.flush()
        except (OSError, ValueError):
            # It has ended; the next poll states why.
            self.error = self.error or "The session has ended."
        return self._ids


_open: list[Session] = []


def close_all() -> None:
    """End every session: the add-on is removed or Blender closes."""
    for session in list(_open):
        session.close()


atexit.register(close_all)
