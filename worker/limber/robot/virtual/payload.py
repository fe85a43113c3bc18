"""What the virtual flange carries and feels: force sensor, gripper, load."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from limber.robot.ur.grippers import ACTIVATED, CLOSED, HELD_CLOSING, MOVING


@dataclass(frozen=True)
class SensorTraits:
    """Errors of a sensor.

    The defaults are those of an e-Series' built-in sensor as measured by users: its Fz drifted by 4
    N in five minutes at rest, within its data sheet.

    Attributes:
        force_sigma, torque_sigma: White noise of a sample [N], [N m].
        force_bias, torque_bias: Reading without load, each axis at random [N], [N m].
        gain_sigma: Relative standard deviation of the sensor's gain, one for all readings.
        drift_n_per_minute: Drift of the force along z.
        force_range, torque_range: Saturation of a reading [N], [N m].
        estimated: Whether it is computed from motor currents (CB3): slow errors of newtons.
    """

    force_sigma: float = 0.15
    torque_sigma: float = 0.005
    force_bias: float = 3.0
    torque_bias: float = 0.1
    gain_sigma: float = 0.02
    drift_n_per_minute: float = 0.8
    force_range: float = 100.0
    torque_range: float = 10.0
    estimated: bool = False


E_SERIES = SensorTraits()
CB3_ESTIMATE = SensorTraits(force_sigma=0.5, torque_sigma=0.1, force_bias=5.0, torque_bias=0.5,
                            estimated=True)
FT300 = SensorTraits(force_sigma=0.1, torque_sigma=0.005, force_bias=2.0, torque_bias=0.05,
                     drift_n_per_minute=0.2, force_range=300.0, torque_range=30.0)


class ForceSensor:
    """One sensor: true wrench in, reading out, in the sensor's frame; ``gain``: reading for one
    newton."""

    def __init__(self, traits: SensorTraits, rng: np.random.Generator):
        self.traits = traits
        self._rng = rng
        self._bias = np.r_[traits.force_bias * rng.standard_normal(3),
                           traits.torque_bias * rng.standard_normal(3)]
        self._drift = 0.0
        self._slow = np.zeros(6)
        self._range = np.r_[np.full(3, traits.force_range), np.full(3, traits.torque_range)]
        self._sigma = np.r_[np.full(3, traits.force_sigma), np.full(3, traits.torque_sigma)]
        self.gain = 1.0 + traits.gain_sigma * float(rng.standard_normal())

    def zero(self, wrench: np.ndarray) -> None:
        """Read nothing at this wrench [6] from here on, but noise and drift."""
        self._bias, self._drift = -self.gain * wrench, 0.0

    def read(self, wrench: np.ndarray, seconds: float) -> np.ndarray:
        """Return a reading, ``seconds`` after the last one, shape [6] in N and N m."""
        self._drift += self.traits.drift_n_per_minute / 60.0 * seconds
        if self.traits.estimated:
            # Friction in the joints: an error that drifts with about a second's memory.
            kept = np.exp(-seconds)
            spread = np.r_[np.full(3, 2.0), np.full(3, 0.3)] * np.sqrt(1 - kept**2)
            self._slow = kept * self._slow + spread * self._rng.standard_normal(6)
        reading = self.gain * wrench + self._bias + self._slow
        reading[2] += self._drift
        return np.clip(reading + self._sigma * self._rng.standard_normal(6),
                       -self._range, self._range)


_AT_POSITION, _HELD_AT = 3, 200  # of 255: where an object stops the fingers
_SETTING = re.compile(r"([A-Z]{3}) (\d+)")


class Load:
    """The gripper's load; this one is nothing."""

    picture: bytes | None = None
    """The requested depth image, once it is available."""

    def wrench(self, flange: np.ndarray, seconds: float) -> np.ndarray:
        """Return force and torque of the load on the flange at its pose, its frame, shape [6]."""
        return np.zeros(6)

    def grasp(self) -> None:
        """Close the gripper."""

    def release(self) -> None:
        """Open the gripper."""

    def lose(self, how: str) -> None:
        """Lose the load: ``slipped`` or ``broken``."""

    def slide(self, part: float) -> None:
        """Let the load slide back by a fraction of its displacement."""

    def seen(self) -> list[list[float]]:
        """Return the positions of the points that a tracker sees, base frame [m]."""
        return []

    def look(self, camera: dict[str, Any]) -> None:
        """Ask for a depth image."""

    def report(self) -> dict[str, Any]:
        """Return the state of the load, as plain data."""
        return {"branch": "none"}

    def close(self) -> None:
        """End the simulation."""


class RobotiqRegisters:
    """The registers of a Robotiq gripper, as its URCap answers for them; ``drive`` closes (True) or
    opens the jaws, ``load_state`` names what is between them, as :class:`.HeldBranch` does."""

    def __init__(self, drive: Callable[[bool], None], load_state: Callable[[], str]):
        self._drive, self._load_state = drive, load_state
        self.values = {"ACT": 1, "GTO": 0, "POS": 0, "SPE": 0, "FOR": 0, "STA": ACTIVATED, "FLT": 0}
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
