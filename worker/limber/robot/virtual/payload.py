"""The virtual gripper's load, as its controller knows it; and an empty gripper."""

from typing import Any, Protocol

import numpy as np


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
