"""The virtual gripper: its load as the controller knows it, an empty one, Robotiq's registers."""

import re
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from limber.robot.ur.robotiq import ACTIVATED, CLOSED, HELD_CLOSING, MOVING

_AT_POSITION, _HELD_AT = 3, 200  # of 255: where an object stops the fingers
_SETTING = re.compile(r"([A-Z]{3}) (\d+)")



class Load(Protocol):
    """The gripper's load: returns the wrench on the tool at a pose of the flange."""

    def wrench(self, flange: np.ndarray, seconds: float) -> np.ndarray:
        """Return force and torque of the load on the flange, flange frame, shape [6]."""
        ...

    def grasp(self) -> None:
        """Close the gripper."""
        ...

    def release(self) -> None:
        """Open the gripper."""
        ...

    def lose(self, how: str) -> None:
        """Lose the load: ``slipped`` or ``broken``."""
        ...

    def slide(self, part: float) -> None:
        """Let the load slide back by a fraction of its displacement."""
        ...

    def seen(self) -> list[list[float]]:
        """Return the positions of the points that a tracker sees, base frame [m]."""
        ...

    @property
    def picture(self) -> bytes | None:
        """The requested depth image, once it is available."""
        ...

    def look(self, camera: dict[str, Any]) -> None:
        """Ask for a depth image."""
        ...

    def report(self) -> dict[str, Any]:
        """Return the state of the load, as plain data."""
        ...

    def close(self) -> None:
        """End the simulation."""
        ...


class Nothing:
    """An empty gripper."""

    def wrench(self, flange: np.ndarray, seconds: float) -> np.ndarray:
        return np.zeros(6)

    def grasp(self) -> None:
        """Nothing is between the jaws."""

    def release(self) -> None:
        """Nothing is held."""

    def lose(self, how: str) -> None:
        """Nothing is held."""

    def slide(self, part: float) -> None:
        """Nothing is held."""

    def seen(self) -> list[list[float]]:
        return []

    picture = None

    def look(self, camera: dict[str, Any]) -> None:
        """Nothing is seen."""

    def report(self) -> dict[str, Any]:
        return {"branch": "none"}

    def close(self) -> None:
        """There is nothing to close."""


class RobotiqRegisters:
    """The registers of a Robotiq gripper, as its URCap answers for them.

    Args:
        drive: Closes (True) or opens the jaws.
        load_state: Returns the state of what is between them, as :class:`.HeldBranch` names it.

    Attributes:
        values: The registers by name.
    """

    def __init__(self, drive: Callable[[bool], None], load_state: Callable[[], str]):
        self._drive, self._load_state = drive, load_state
        self.values = {"ACT": 1, "GTO": 0, "POS": 0, "SPE": 0, "FOR": 0, "STA": ACTIVATED,
                       "FLT": 0}
        self._is_closed = False

    def answer(self, line: str) -> bytes:
        """Return the reply to a line; an unknown one gets a question mark, as of the URCap."""
        verb, _, rest = line.strip().partition(" ")
        if verb == "GET" and (rest == "OBJ" or rest in self.values):
            return f"{rest} {self._value(rest)}\n".encode()
        settings = dict(_SETTING.findall(rest))
        if verb != "SET" or not settings or not settings.keys() <= self.values.keys():
            return b"?"
        self.values |= {name: int(value) for name, value in settings.items()}
        if self.values["GTO"] and self.values["STA"] == ACTIVATED and "POS" in settings:
            close = self.values["POS"] > CLOSED // 2
            if close != self._is_closed:
                self._is_closed = close
                self._drive(close)
        return b"ack"

    def _value(self, name: str) -> int:
        if name == "OBJ":
            if not self._is_closed:
                return _AT_POSITION
            return {"held": HELD_CLOSING, "closing": MOVING}.get(self._load_state(), _AT_POSITION)
        if name == "POS" and self._is_closed and self._load_state() == "held":
            return _HELD_AT
        return self.values[name]
