"""The way that an arm has come, on disk: a retreat finds it also when the program has crashed.

One file for each controller, in this user's state folder (``LIMBER_STATE`` names another). Each
line is a JSON object: the first says whose way it is, the others what was passed since, or that
the gripper moved. The driver adds to it while the arm moves; a killed driver leaves all but the
last lines.
"""

import hashlib
import json
import os
import queue
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from limber.core.json_lines import json_objects
from limber.core.json_values import plain
from limber.robot.cell.cell import Cell

_FORMAT = 1


@dataclass(frozen=True)
class FollowedWay:
    """A way that was read.

    Attributes:
        poses: Of the tool's centre, base frame [m, rad], in order, shape [n, 6].
        joints: [rad], shape [n, joints].
        speeds: Greatest ones on it [m/s], [rad/s], shape [2].
        bias: Of the force sensor by its last tare, flange frame [N, N m], shape [6]; or None.
        gripper_closed: Whether the gripper was closed last; None: it was not moved.
        at: When the way began, seconds since 1970.
    """

    poses: np.ndarray
    joints: np.ndarray
    speeds: np.ndarray
    bias: np.ndarray | None
    gripper_closed: bool | None
    at: float


def way_path(cell: Cell) -> Path:
    """Return where the way of a cell's robot is kept."""
    key = hashlib.sha256(cell.robot.address.encode()).hexdigest()[:16]
    return _state_folder() / "robot-ways" / f"{key}.jsonl"


def log_path() -> Path:
    """Return where motions by `limber robot` are logged, a JSON object a line."""
    return _state_folder() / "robot-moves.jsonl"


def read_way(cell: Cell) -> FollowedWay | None:
    """Return the way that the cell's robot followed last; None where none is known.

    A line that was half written counts as not written; a way of another arm or tool is none.
    """
    try:
        with open(way_path(cell), encoding="utf-8") as stream:
            lines = list(json_objects(stream))
    except FileNotFoundError:
        return None
    if not lines or lines[0].get("head") != plain(_head(cell)):
        return None
    try:
        places = [line for line in lines if "pose" in line]
        last = {name: line[name] for line in lines[1:] for name in line}
        way = FollowedWay(
            _rows([line["pose"] for line in places], 6),
            _rows([line["joints"] for line in places], len(cell.arm.joint_names)),
            np.array(last.get("speeds", (0.0, 0.0)), float),
            None if last.get("bias") is None else np.array(last["bias"], float).reshape(6),
            last.get("gripper_closed"), float(lines[0]["at"]))
    except (KeyError, TypeError, ValueError):
        return None
    whole = all(np.isfinite(part).all() for part in (way.poses, way.joints, way.speeds))
    return way if whole and (way.bias is None or np.isfinite(way.bias).all()) else None


class WayFile:
    """Writes a way while it is followed, in a thread of its own: the loop waits for no disk."""

    def __init__(self, cell: Cell):
        self._lasting: dict[str, Any] = {}
        self._path, self._head = way_path(cell), _head(cell)
        self._lines: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write, name="way", daemon=True)
        self._thread.start()

    def begin(self) -> None:
        """A new way begins; the old one is forgotten."""
        self._lines.put({"format": _FORMAT, "head": self._head, "at": time.time()})
        self.add(**self._lasting)

    def tared(self, bias: np.ndarray) -> None:
        """The force sensor's bias [6] is known; it holds for the ways to come."""
        self._lasting["bias"] = bias.copy()
        self.add(bias=self._lasting["bias"])

    def gripped(self, closed: bool) -> None:
        """The gripper was closed or opened; it stays so for the ways to come."""
        self._lasting["gripper_closed"] = closed
        self.add(gripper_closed=closed)

    def add(self, **content: Any) -> None:
        """Add what was passed or done; returns at once."""
        self._lines.put(content)

    def close(self, seconds: float = 1.0) -> None:
        """Wait until all is written, at most this long."""
        self._lines.put(None)
        self._thread.join(seconds)

    def _write(self) -> None:
        """Write what comes; a disk that refuses ends it, and a retreat then finds less."""
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            while (line := self._lines.get()) is not None:
                with open(self._path, "w" if "head" in line else "a", encoding="utf-8") as stream:
                    stream.write(json.dumps(plain(line)) + "\n")
        except OSError:
            return


def _state_folder() -> Path:
    return Path(os.environ.get("LIMBER_STATE") or platformdirs.user_state_path("limber"))


def _rows(values: list[Any], count: int) -> np.ndarray:
    """Rows of ``count`` numbers; another count is a ValueError."""
    rows = np.array(values, float) if values else np.zeros((0, count))
    if rows.ndim != 2 or rows.shape[1] != count:
        raise ValueError(f"rows of shape {rows.shape}")
    return rows


def _head(cell: Cell) -> dict[str, Any]:
    """Whose way it is: poses are of this arm's tool."""
    return {"address": cell.robot.address, "arm": cell.arm.name, "tool": cell.tool.grasp_pose}
