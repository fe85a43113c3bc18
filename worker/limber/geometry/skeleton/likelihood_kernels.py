"""Compiled loops of the tree's score: the density of points across axes, and without some of them.
"""

import numpy as np

from limber.core.numerics.compiled import compiled_exactly

HIDDEN = 0.03
"""Density of the half hidden from a sensor, as a fraction of that all around."""
_NOWHERE = 12.0  # standard deviations from a skin beyond which it shows no point


@compiled_exactly
def _bessel(x: float) -> float:
    """exp(-x) I0(x), to 2e-7 of it (Abramowitz and Stegun 1964, 9.8.1 and 9.8.2)."""
    if x < 3.75:
        t = (x / 3.75)**2
        return np.exp(-x) * (1 + t * (3.5156229 + t * (3.0899424 + t * (1.2067492 + t * (
            0.2659732 + t * (0.0360768 + t * 0.0045813))))))
    t = 3.75 / x
    return (0.39894228 + t * (0.01328592 + t * (0.00225319 + t * (-0.00157565 + t * (
        0.00916281 + t * (-0.02057706 + t * (0.02635537 + t * (-0.01647633 + t * 0.00392377
                                                               )))))))) / np.sqrt(x)


@compiled_exactly
def _density(distance: float, radius: float, facing: float, noise: float, power: float) -> float:
    """Density [1/m^2] across an axis times a ``power`` of its radius [m]; ``facing`` is NaN where
    points are seen from all around."""
    off = (distance - radius) / noise
    if abs(off) > _NOWHERE:
        return 0.0
    sharpness = distance * radius / noise**2
    density = radius**power * _bessel(sharpness) * np.exp(-0.5 * off**2) / (2 * np.pi * noise**2)
    if np.isnan(facing):
        return density
    # Fourier's series of the half-wave rectified cosine. Around the circle the noise is von
    # Mises'; its harmonics are nearly those of a wrapped normal distribution.
    first = sharpness / (0.5 + np.sqrt(sharpness**2 + 2.25))
    twice = 2 * facing**2 - 1
    seen = (1 + np.pi / 2 * first * facing + 2 / 3 * first**4 * twice
            - 2 / 15 * first**16 * (2 * twice**2 - 1)
            + 2 / 35 * first**36 * (4 * twice**3 - 3 * twice))
    return density * (HIDDEN + (1 - HIDDEN) * max(seen, 0.0))


@compiled_exactly
def densities(distance: np.ndarray, radius: np.ndarray, facing: np.ndarray, noises: np.ndarray,
              power: float) -> np.ndarray:
    """Density times a ``power`` of the radius at distances from axes [m] with radii [m] for each
    noise [m], shape [m, k]; ``facing`` [m] is the cosine of the angle to the sensor, or NaN."""
    found = np.empty((len(distance), len(noises)))
    for i in range(len(distance)):
        for k in range(len(noises)):
            found[i, k] = _density(distance[i], radius[i], facing[i], noises[k], power)
    return found


@compiled_exactly
def left(near: np.ndarray, gone: np.ndarray, count: int) -> np.ndarray:
    """The first ``count`` of each point's nodes, nearest first, [m, k], that are not ``gone``, a
    mask [n]; the last one again where there are fewer, and -1 where there is none."""
    found = np.full((len(near), count), -1)
    for i in range(len(near)):
        place = 0
        for k in range(near.shape[1]):
            if place < count and not gone[near[i, k]]:
                found[i, place:] = near[i, k]
                place += 1
    return found
