"""An arm's path on disk: a retreat finds it even after the program has crashed.

There is one file per controller, in this user's state folder (``LIMBER_STATE`` names another). Each
line is a JSON object: the first identifies the arm and tool, the others hold the poses passed
since, or that the gripper moved. The driver adds to it while the arm moves. After the driver is
killed, all but the last lines are there.
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

from limber.cell.cell_file import Cell
from limber.core.errors import InputError
from limber.core.json_values import json_objects, plain

_FORMAT = 1


@dataclass(frozen=True)
class FollowedPath:
    """A path read from disk.

    Attributes:
        poses: Poses of the tool's centre, base frame [m, rad], in order, shape [n, 6].
        joints: [rad], shape [n, joints].
        speeds: Greatest speeds on it [m/s], [rad/s], shape [2].
        bias: Bias of the force sensor by its last tare, flange frame [N, N m], shape [6]; None if
            it is not known with the cell's payload (`limber robot weigh` tares with another).
        gripper_closed: Whether the gripper was last closed; None: it was not moved.
        at: Start time of the path, seconds since 1970.
    """

    poses: np.ndarray
    joints: np.ndarray
    speeds: np.ndarray
    bias: np.ndarray | None
    gripper_closed: bool | None
    at: float


def followed_path_file(cell: Cell) -> Path:
    """Return the file of the path of a cell's robot."""
    key = hashlib.sha256(cell.robot.address.encode()).hexdigest()[:16]
    return _state_folder() / "robot-ways" / f"{key}.jsonl"


def log_path() -> Path:
    """Return the log of motions by `limber robot`, one JSON object a line."""
    return _state_folder() / "robot-moves.jsonl"


def read_followed_path(cell: Cell) -> FollowedPath | None:
    """Return the path that the cell's robot followed last; None if none is known.

    A line that is half written is ignored; a path of another arm or tool does not count.
    """
    try:
        with open(followed_path_file(cell), encoding="utf-8") as stream:
            lines = list(json_objects(stream))
    except FileNotFoundError:
        return None
    if not lines or lines[0].get("head") != plain(_head(cell)):
        return None
    try:
        pose_lines = [line for line in lines if "pose" in line]
        last = {name: line[name] for line in lines[1:] for name in line}
        if last.get("bias_with") != plain(_payload(cell)):
            last["bias"] = None
        followed = FollowedPath(
            _rows([line["pose"] for line in pose_lines], 6),
            _rows([line["joints"] for line in pose_lines], len(cell.arm.joint_names)),
            np.array(last.get("speeds", (0.0, 0.0)), float),
            None if last.get("bias") is None else np.array(last["bias"], float).reshape(6),
            last.get("gripper_closed"), float(lines[0]["at"]))
    except (KeyError, TypeError, ValueError):
        return None
    whole = all(np.isfinite(part).all() for part
                in (followed.poses, followed.joints, followed.speeds))
    return followed if whole and (followed.bias is None
                                  or np.isfinite(followed.bias).all()) else None


def followed_path(cell: Cell, otherwise: str) -> FollowedPath:
    """Return the path that the cell's robot followed last.

    Args:
        otherwise: What to do instead, for the message.

    Raises:
        InputError: none is known.
    """
    followed = read_followed_path(cell)
    if followed is None:
        raise InputError(f"No path that the robot at {cell.robot.address} followed with this arm "
                         "and tool is known.", "It followed none from this account, or the cell "
                         "has changed since.", otherwise)
    return followed


class FollowedPathFile:
    """Writes a path while it is followed, in its own thread: the loop waits for no disk."""

    def __init__(self, cell: Cell):
        self._lasting: dict[str, Any] = {}
        self._path, self._head = followed_path_file(cell), _head(cell)
        self._payload = _payload(cell)
        self._lines: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write, name="way", daemon=True)
        self._thread.start()

    def begin(self) -> None:
        """Begin a new path; the old one is discarded."""
        self._lines.put({"format": _FORMAT, "head": self._head, "at": time.time()})
        self.add(**self._lasting)

    def tared(self, bias: np.ndarray) -> None:
        """The force sensor's bias [6] is known; it holds for later paths."""
        self._lasting |= {"bias": bias.copy(), "bias_with": self._payload}
        self.add(**self._lasting)

    def gripped(self, closed: bool) -> None:
        """The gripper was closed or opened; it stays so for later paths."""
        self._lasting["gripper_closed"] = closed
        self.add(gripper_closed=closed)

    def add(self, **content: Any) -> None:
        """Add new data; returns at once."""
        self._lines.put(content)

    def close(self, seconds: float = 1.0) -> None:
        """Wait until all is written, at most this long."""
        self._lines.put(None)
        self._thread.join(seconds)

    def _write(self) -> None:
        """Write data as it arrives; a disk error ends this, and a retreat then finds less."""
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


def _payload(cell: Cell) -> dict[str, Any]:
    """What the controller subtracts from the force, and so what a tare is relative to."""
    return {"mass_kg": cell.tool.mass_kg, "centre_of_mass_m": cell.tool.centre_of_mass_m}


def _head(cell: Cell) -> dict[str, Any]:
    """Arm and tool to which the path belongs: poses are of this arm's tool."""
    return {"address": cell.robot.address, "arm": cell.arm.name, "tool": cell.tool.grasp_pose}
