"""Plausibility of a force sensor, by the first millimetres of a pull and by its end.

A pull measures the stiffness of a branch. The direction of the force is known before: a force
predicted along one direction does not appear along another, nor with the opposite sign. If the
moduli are known already, its magnitude is predicted as well.
"""

from dataclasses import dataclass

import numpy as np

from limber.robot.cell.cell import Cell

LOOKED_M = 0.01
"""Travel by which a wrong sensor has been detected."""

_NOISES = 4.0  # times a smoothed force's noise: less is no statement
_MOSTLY = 0.5  # cosine of the angle to the predicted force
_AGREE = 10  # samples in a row that say the same
_FROM_M = 0.002  # of travel: before that slack and the bark decide
_BACK_SHARE = 0.15  # of the peak force that may be left when the gripper is back
_SMOOTHED = 3  # readings at least in a smoothed force
_COLUMNS = slice(13, 16)


@dataclass(frozen=True)
class PredictedPull:
    """Forces at the beginning of a pull, by the branch's model.

    Attributes:
        ways: Travel of the gripper [m], ascending from 0, shape [n].
        forces: Forces of the gripper on the branch [N], branch frame, shape [n, 3].
        factor: Factor by which a force may be larger or smaller, if the moduli are known; else
        None.
    """

    ways: np.ndarray
    forces: np.ndarray
    factor: float | None

    def at(self, way: float) -> np.ndarray:
        """Return the force at a travel [m], shape [3]."""
        return np.array([np.interp(way, self.ways, self.forces[:, k]) for k in range(3)])


class PullPlausibility:
    """Checks the samples of a pull as they arrive.

    Args:
        cell: States the sensor's noise and drift.
        predicted: Expected forces.

    Attributes:
        reason: Why the sensor cannot be right, once that is certain.
    """

    def __init__(self, cell: Cell, predicted: PredictedPull):
        self._noise = _NOISES * cell.sensor.force_sigma_n / np.sqrt(_SMOOTHED)
        self._drift = cell.sensor.drift_n_per_minute / 60.0
        self._predicted = predicted
        self._start: np.ndarray | None = None
        self._began = self._peak = 0.0
        self._told = ("", 0)
        self.reason: str | None = None

    def take(self, samples: np.ndarray) -> str | None:
        """Judge samples [n, 37], as in :data:`limber.robot.driver.link.COLUMNS`; returns why the
        sensor cannot be right, or None."""
        if self._start is None:
            self._start, self._began = samples[0, 1:4].copy(), float(samples[0, 0])
        for row in samples:
            force = row[_COLUMNS]
            if not np.isfinite(force).all():
                continue
            self._peak = max(self._peak, float(np.linalg.norm(force)))
            way = float(np.linalg.norm(row[1:4] - self._start))
            if self.reason is None and _FROM_M <= way <= LOOKED_M:
                self._agree(self._doubt(way, force))
        return self.reason

    def left_at_end(self, samples: np.ndarray) -> str | None:
        """Return in words a force that remains with the gripper back at its start and is not
        explained by noise, drift and the branch; ``samples`` [n, 37] are the last ones.
        """
        left = float(np.linalg.norm(samples[:, _COLUMNS].mean(axis=0)))
        drift = self._drift * (float(samples[-1, 0]) - self._began)
        allowed = self._noise + drift + _BACK_SHARE * self._peak
        if not left > allowed:
            return None
        return (f"A force of {left:.2g} N is left where the gripper closed on the resting branch; "
                f"{allowed:.2g} N are explained by noise, drift and the branch. The sensor "
                "drifted, or the branch slipped in the gripper")

    def _agree(self, doubt: str) -> None:
        """Take a suspected error as certain when it is repeated."""
        kind = doubt.split(":", maxsplit=1)[0]
        self._told = (kind, self._told[1] + 1 if doubt and kind == self._told[0] else 1)
        if doubt and self._told[1] >= _AGREE:
            self.reason = doubt

    def _doubt(self, way: float, force: np.ndarray) -> str:
        wanted = self._predicted.at(way)
        size, felt = float(np.linalg.norm(wanted)), float(np.linalg.norm(force))
        if size < 1e-9:
            return ""
        along = float(force @ wanted) / size
        told = f"after {1000 * way:.1f} mm"
        if felt > self._noise and along < -_MOSTLY * felt:
            return ("the force points against the predicted one: the sensor's sign or pose "
                    f"(sensor.pose) is wrong ({felt:.2g} N {told})")
        if felt > self._noise and along < _MOSTLY * felt:
            return ("the force lies across the predicted one: the sensor's axes or pose "
                    f"(sensor.pose) are wrong, or another part is pulled ({felt:.2g} N {told})")
        factor = self._predicted.factor
        if factor is None:
            return ""
        if along > factor * size + self._noise:
            return ("the force is larger than the known moduli allow: the sensor's unit is wrong, "
                    f"or something stiff is in the way ({along:.2g} N {told}, "
                    f"{size:.2g} N predicted)")
        if along < size / factor - self._noise:
            return ("the force is smaller than the known moduli allow: the sensor's unit is "
                    f"wrong, or the branch is not held ({along:.2g} N {told}, {size:.2g} N "
                    "predicted)")
        return ""
