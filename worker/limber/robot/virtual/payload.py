"""What the virtual gripper holds, as its controller knows it; and nothing at all."""

from typing import Any, Protocol

import numpy as np


class Load(Protocol):
    """What the gripper holds: gives the wrench on the tool at a pose of the flange."""

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
        """Lose what is held: ``slipped`` or ``broken``."""
        ...

    def slide(self, part: float) -> None:
        """Let what is held slide back by a part of its way."""
        ...

    def seen(self) -> list[list[float]]:
        """Return where the points are that a tracker sees, base frame [m]."""
        ...

    @property
    def picture(self) -> bytes | None:
        """The depth image that was asked for, once it is there."""
        ...

    def look(self, camera: dict[str, Any]) -> None:
        """Ask for a depth image."""
        ...

    def report(self) -> dict[str, Any]:
        """Return the state of what is held, as plain data."""
        ...

    def close(self) -> None:
        """End what simulates it."""
        ...


class Nothing:
    """There is nothing to hold."""

    def wrench(self, flange: np.ndarray, seconds: float) -> np.ndarray:
        return np.zeros(6)

    def grasp(self) -> None:
        """There is nothing between the jaws."""

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
        """There is nothing to end."""
