"""A recorded swing, the result of its fit, and a first guess of frequency and damping."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from limber.core.errors import InputError

_GONE = 0.3
"""Fraction of its path at which a branch has certainly been released."""


@dataclass(frozen=True)
class SwingSeen:
    """Observations of a swing.

    Attributes:
        times: [s], shape [n].
        moved: Displacement of the markers from the branch's shape at rest [m], shape [n, m, 3]; NaN
            if a marker was not observed.
        rest_points: Positions of the markers on the branch [m], shape [m, 3].
        start: "held": in the shape at rest until weight and load act; "loaded": bent by the load
            until it is removed.
        load: The load [N], shape [3].
        load_mass: Mass that swings with the branch [kg]; 0 if the load is a pull, or removed.
        noise: Noise of one reading [m].
        registration: RMS distance of the markers from their positions [m], None: not known.
    """

    times: np.ndarray
    moved: np.ndarray
    rest_points: np.ndarray
    start: str
    load: np.ndarray
    load_mass: float
    noise: float
    registration: float | None = None


@dataclass(frozen=True)
class SwingFit:
    """Result of a swing. Intervals are 95 % intervals.

    Attributes:
        factor: Factor on the start's Young's modulus, corrected for the mesh's stiffness;
            factor_interval: shape [2].
        mesh_factor: The correction; 1 if a finer mesh was not possible.
        release: [s] on the recording's clock; release_deviation: [s].
        damping: Rayleigh's alpha [1/s] and beta [s]; damping_interval: shape [2, 2].
        damping_ratio: Damping ratio of the first vibration; damping_ratio_interval: shape [2].
        frequency: Frequency of the first vibration about the equilibrium [Hz].
        residual: RMS of observed minus simulated [m]; over the largest displacement it is
            ``relative_residual``.
        readings: Number of independent readings, from the residual's autocorrelation.
        forward_count: Number of simulations.
        window: First and last time used [s].
        times, seen, simulated: For figures [s, m], shapes [f], [f, m, 3].
        converged: Whether the last fit converged.
        creep: ``share``, its ``interval`` and ``time_s`` as for a pull; None: the record does not
            show any.
    """

    factor: float
    factor_interval: np.ndarray
    mesh_factor: float
    release: float
    release_deviation: float
    damping: tuple[float, float]
    damping_interval: np.ndarray
    damping_ratio: float
    damping_ratio_interval: np.ndarray
    frequency: float
    residual: float
    relative_residual: float
    readings: float
    forward_count: int
    window: tuple[float, float]
    times: np.ndarray
    seen: np.ndarray
    simulated: np.ndarray
    converged: bool
    creep: dict[str, Any] | None = None


def first_guess(seen: SwingSeen) -> tuple[float, float]:
    """Return a branch's time of release and its period [s], from the tracks alone.

    Raises:
        InputError: no motion is found, or the branch does not oscillate.
    """
    travel = np.linalg.norm(seen.moved - np.nanmedian(seen.moved[:3], axis=0), axis=2)
    # From the marker that moves farthest: others are disturbed while the branch is still held.
    far = travel[:, np.argmax(np.nan_to_num(travel).max(axis=0))]
    far = np.where(np.isfinite(far), far, 0.0)
    if far.max() < 10 * seen.noise:
        raise InputError("The recording shows no swing.",
                         f"No marker moves by more than {1e3 * far.max():.2g} mm.",
                         "Start the recording before the branch is released.")
    gone = int(np.argmax(far > _GONE * far.max()))
    at_rest = np.flatnonzero(far[:gone] < max(6 * seen.noise, 0.02 * far.max()))
    start = int(at_rest[-1]) + 1 if len(at_rest) else 0
    marker, axis = np.unravel_index(np.nanargmax(np.nanvar(seen.moved[start:], axis=0)),
                                    seen.moved.shape[1:])
    track = seen.moved[start:, marker, axis]
    times = seen.times[start:][np.isfinite(track)]
    track = track[np.isfinite(track)]
    settled = np.median(track[-max(len(track) // 4, 5):])
    away = track - settled
    large = np.flatnonzero(np.abs(away) > 0.05 * np.abs(away).max())
    away, times = away[:large[-1] + 1], times[:large[-1] + 1]
    turns = np.flatnonzero((away[:-1] < 0) != (away[1:] < 0))
    if len(turns) < 3:
        raise InputError("The branch does not oscillate.",
                         f"It passes its rest position only {len(turns)} times.",
                         "Release it abruptly, or fit the rest position: --motion quasi_static.")
    cross = times[turns] - away[turns] * (times[turns + 1] - times[turns]) / (
        away[turns + 1] - away[turns])
    # Over whole periods: the equilibrium may be slightly offset, as for a branch that creeps.
    period = float(np.median(cross[2:] - cross[:-2]))
    rate = float(np.median(np.diff(seen.times)))
    if period < 6 * rate:
        raise InputError(f"The branch swings {1 / period:.3g} times a second.",
                         f"This is too fast for {1 / rate:.3g} frames a second.",
                         "Record with more frames a second.")
    return float(seen.times[max(start - 1, 0)]), period
