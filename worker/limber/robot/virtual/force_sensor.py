"""The force-torque sensor of the virtual robot: noise, drift, saturation."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SensorTraits:
    """Errors of a sensor.

    The defaults are those of an e-Series' built-in sensor as measured by users: its Fz drifted by 4
    N in five minutes at rest, within its data sheet.

    Attributes:
        force_sigma, torque_sigma: White noise of a sample [N], [N m].
        force_bias, torque_bias: Reading without load, each axis at random [N], [N
            m].
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
    """One sensor: true wrench in, reading out, both in the sensor's frame.

    Attributes:
        gain: Reading for one newton.
    """

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
