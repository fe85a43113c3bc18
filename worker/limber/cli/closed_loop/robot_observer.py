"""The virtual robot as observed from outside, while another process controls it."""

import threading
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from limber.robot.virtual.launch import VirtualRobot

STILL_M_S = 1e-4
_GUIDED_M = 0.015  # the tip moves this far from the grasp's rest while it is guided
_MOVED_M_S = 0.01
_AT_END_M = 5e-4
_EVERY_SECONDS, _CLOSELY_SECONDS = 0.05, 0.004


@dataclass(frozen=True)
class Overload:
    """Effects of a provoked overload.

    Attributes:
        standstill: Time from the overload until the arm stood still [s].
        travel: Distance that the gripper still moved [m].
    """

    standstill: float
    travel: float


@dataclass
class Watch:
    """Records the robot and its branch in a thread; a context manager.

    Args:
        robot: No other code may query it meanwhile.
        overload: Wrench on the sensor from when the branch is driven [N, N m], shape [6], or None.

    Attributes:
        states: As returned by :attr:`VirtualRobot.state`.
        overloaded: Effects of the overload; None if there was none.
    """

    robot: VirtualRobot
    overload: np.ndarray | None = None
    states: list[dict[str, Any]] = field(default_factory=list)
    overloaded: Overload | None = None

    def __enter__(self) -> "Watch":
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_exception: object) -> None:
        self._ended.set()
        self._thread.join()
        if self.overload is not None:
            self.robot.ask("added_wrench", wrench=[0.0] * 6)

    @property
    def extrapolation_error(self) -> float:
        """Largest error of the virtual branch's own force [N]."""
        return max((state.get("extrapolation_error_n", 0.0) for state in self.states), default=0.0)

    def at_the_end(self) -> np.ndarray | None:
        """Return positions of the branch's visible points at the end of the path [m], shape [n, 3].

        That is where it was held still, farthest from where it was grasped.
        """
        held = [state for state in self.states if state["branch"] == "held"]
        still = [state for state in held if _speed(state) < STILL_M_S]
        if not still:
            return None
        positions = np.array([state["flange"] for state in still])
        away = np.linalg.norm(positions - held[0]["flange"], axis=1)
        is_at_end = np.linalg.norm(positions - positions[away.argmax()], axis=1) < _AT_END_M
        return np.mean([state["points"] for state, is_there in zip(still, is_at_end, strict=True)
                        if is_there], axis=0)

    def _run(self) -> None:
        start: np.ndarray | None = None
        while not self._ended.wait(_EVERY_SECONDS):
            state = self.robot.state
            self.states.append(state)
            # The flange's: the tool that poses are of is set for a motion, and put back.
            position = np.array(state["flange"])
            if state["branch"] != "held":
                start = None
                continue
            start = position if start is None else start
            is_moving = np.linalg.norm(position - start) > _GUIDED_M and _speed(state) > _MOVED_M_S
            if self.overload is not None and self.overloaded is None and is_moving:
                self._overload()

    def _overload(self) -> None:
        assert self.overload is not None
        before = self.robot.ask("added_wrench", wrench=list(map(float, self.overload)))
        began = time.monotonic()
        while not self._ended.wait(_CLOSELY_SECONDS):
            state = self.robot.state
            if _speed(state) < STILL_M_S:
                offset = np.subtract(state["flange"], before["flange"])
                self.overloaded = Overload(time.monotonic() - began, float(np.linalg.norm(offset)))
                return


def _speed(state: dict[str, Any]) -> float:
    return float(np.linalg.norm(state["tool_speed"][:3]))
