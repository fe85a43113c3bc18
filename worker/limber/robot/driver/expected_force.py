"""Differences between the measured wrench and the predicted one: their bound and their name."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from limber.core.numerics.rigid_kernels import length

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell

DEVIATIONS = 2.0
"""Standard deviations of a prediction that are allowed."""

_MOSTLY = 0.8  # cosine of the angle to the predicted force that a difference opposes
_MOSTLY_AT_ONCE = 0.5  # the same for a sudden change: a sliding piece pulls sideways
NOISES = 7.0
"""Standard deviations of the filtered force that noise explains: in three directions, one in a
million motions of a minute exceeds it.
"""
LOST_SHARE = 0.4
"""Fraction of its force that a held branch loses when it slips or breaks."""
FAULTS = {"an empty gripper, a branch that slipped or a broken one": 1.0,
          "a sensor that reads a tenth": 0.9, "a branch three times softer": 2.0 / 3.0}
"""Faults that the guard has to see during a path, and the fraction of the force lost with each."""

_UNLIKE = "the force differs from the predicted one [N]"
_SHORT = ("less force than predicted: the branch slipped, broke, was never held or is softer, or "
          "the sensor reads too little [N]")
_FELL = "the predicted force dropped suddenly: the branch slipped, broke or came loose [N]"


def difference_name(off: np.ndarray, expected: np.ndarray, before: np.ndarray, least: float,
                    ) -> str:
    """Return the most probable name of a difference to the expected force.

    Args:
        off: The difference [N], shape [3].
        expected: The expected force [N], shape [3].
        before: The usual difference so far [N], shape [3].
        least: Expected force [N] up to which a difference has no direction.
    """
    expected_size, missing = length(expected), -float(off @ expected)
    if expected_size <= least:
        return _UNLIKE
    size = length(off)
    at_once = length(off - before) > 0.5 * size
    if at_once and missing > _MOSTLY_AT_ONCE * expected_size * size:
        return _FELL
    return _SHORT if missing > _MOSTLY * expected_size * size else _UNLIKE


def allowed_difference(off: np.ndarray, covariance: np.ndarray, least: float, most: float,
                       ) -> float:
    """Return the largest allowed difference in the direction of ``off`` [3], which is not 0.

    The bound is an ellipsoid: ``least``, widened by standard deviations of the prediction up to
    ``most``.
    """
    squares, axes = np.linalg.eigh(covariance)
    radii = least**2 + np.minimum(DEVIATIONS**2 * np.maximum(squares, 0.0), most**2)
    along = axes.T @ (off / length(off))
    return float(1.0 / np.sqrt((along**2 / radii).sum()))


@dataclass(frozen=True)
class ForceErrors:
    """Errors of a measured force that no branch causes.

    Attributes:
        noise: Standard deviation of the filtered force at rest, per axis [N].
        drift: Of the sensor [N/s].
        inertia: Force that accelerates the gripper [N].
    """

    noise: float
    drift: float
    inertia: float

    @classmethod
    def of_cell(cls, cell: "Cell", kept: float) -> "ForceErrors":
        """Return the errors that a cell states, of a force whose filter keeps a fraction ``kept``
        of its value each step.
        """
        return cls(white_noise(cell.sensor.force_sigma_n, kept),
                   cell.sensor.drift_n_per_minute / 60.0,
                   (cell.tool.mass_kg or 0.0) * cell.limits.acceleration_m_s2)

    def measured(self, noise: float | None) -> "ForceErrors":
        """Return them with the noise measured at rest [N], if it was."""
        return self if noise is None else replace(self, noise=noise)

    def within(self, seconds: float | np.ndarray) -> np.ndarray:
        """Return the force that they explain ``seconds`` after a reference [N]."""
        return np.sqrt((NOISES * self.noise) ** 2 + (self.drift * np.asarray(seconds)) ** 2
                       + self.inertia**2)


def kept_share(step: float, filter_time: float) -> float:
    """Return the fraction of its value that a filter keeps at each step [s]."""
    return float(np.exp(-step / filter_time))


def white_noise(sigma: float, kept: float) -> float:
    """Return the filtered force's standard deviation for white noise ``sigma`` of a reading."""
    return sigma * float(np.sqrt((1.0 - kept) / (1.0 + kept)))


def noise_at_rest(forces: np.ndarray, kept: float) -> float:
    """Return the filtered force's standard deviation, from forces at rest [N], shape [n, 3].

    The filter averages readings that are repeated, or smoothed by the sensor, less than white ones.
    """
    off = forces - forces.mean(axis=0)
    filtered, rows = np.zeros(3), np.empty_like(off)
    for number, row in enumerate(off):
        filtered = kept * filtered + (1.0 - kept) * row
        rows[number] = filtered
    return max(white_noise(float(off.std()), kept), float(rows.std()))


def allowed_change(off: np.ndarray, covariance: np.ndarray, largest: float, within: float,
                   most: float) -> float:
    """Return the largest allowed change of a difference since the branch was held.

    Args:
        off: The change [N], shape [3].
        largest: Largest predicted force so far [N].
        within: Force that the sensor's errors explain [N].
    """
    return allowed_difference(off, covariance, float(np.hypot(LOST_SHARE * largest, within)), most)


def not_seen(times: np.ndarray, forces: np.ndarray, covariance: np.ndarray, errors: ForceErrors,
             most: float) -> dict[str, float]:
    """Return the :data:`FAULTS` that the guard cannot see along a path.

    Args:
        times: Since the branch was held [s], shape [n].
        forces: Predicted [N], shape [n, 3].
        covariance: Theirs, shape [n, 3, 3].
        most: As :func:`allowed_difference` takes it.

    Returns:
        For each such fault the peak force [N] from which it could be seen.
    """
    sizes = np.linalg.norm(forces, axis=1)
    largest, within = np.maximum.accumulate(sizes), errors.within(times)
    rows = np.flatnonzero(sizes > 0.0)
    allowed = np.array([allowed_change(forces[k], covariance[k], float(largest[k]),
                                       float(within[k]), most) for k in rows])
    peak, found = float(sizes.max()), {}
    for name, share in FAULTS.items():
        if not len(rows):
            found[name] = float("inf")
        elif not np.any(share * sizes[rows] > allowed):
            best = int(np.argmax(sizes[rows] / allowed))
            # Of what is allowed there, the rest does not grow with the force.
            rest = np.sqrt(max(allowed[best] ** 2 - (LOST_SHARE * largest[rows[best]]) ** 2, 0.0))
            found[name] = float(rest / np.sqrt(share**2 - LOST_SHARE**2) * peak
                                / sizes[rows[best]])
    return found
