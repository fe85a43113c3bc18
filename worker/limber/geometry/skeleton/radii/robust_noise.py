"""Scatter of points around fitted cylinders, and the points that belong to something else."""

import numpy as np

_TUKEY = 4.685  # 95 % efficiency for normal noise
_ENOUGH = 200  # points that determine the noise
# Distances of points scattered around a circle by noise s follow Rice's law. _MEASURED: estimate
# from points within a radius of the circle, over that radius. _TRUE: s over that estimate.
_MEASURED = (0.1655, 0.2461, 0.3234, 0.3802, 0.4506, 0.4810, 0.5102, 0.5360)
_TRUE = (1.007, 1.016, 1.031, 1.052, 1.110, 1.155, 1.225, 1.333)


def robust_sigma(residual: np.ndarray, radius: np.ndarray) -> float:
    """Noise [m] of points on the thicker half: thin twigs' radii absorb part of it.

    Points farther than a radius from the surface may belong to something else. Where noise reaches
    that far, the result is corrected for those left out.
    """
    near = np.abs(residual) < radius
    if near.sum() < 10:
        near = np.ones(len(residual), bool)
    thick = near & (radius >= np.median(radius[near]))
    if thick.sum() >= _ENOUGH:
        near = thick
    middle = np.median(residual[near])
    sigma = 1.4826 * np.median(np.abs(residual[near] - middle))
    share = sigma / max(float(np.median(radius[near])), 1e-300)
    return float(sigma * np.interp(share, _MEASURED, _TRUE))


def tukey(residual: np.ndarray, limit: np.ndarray | float) -> np.ndarray:
    """Weight of each residual [m], 0 from ``limit`` [m] on, shape [m]."""
    return np.clip(1 - (residual / limit)**2, 0, None)**2


def settled_weights(residual: np.ndarray, noise: float) -> np.ndarray:
    """Weight of each residual [m] once the noise [m] is known, shape [m]."""
    return tukey(residual, _TUKEY * max(noise, 1e-12))


def residual_limit(spread: float, noise: float, trusted: float, radius: np.ndarray) -> np.ndarray:
    """Residual [m] from which a point belongs to something else, shape [m].

    Noise that is not trusted yet widens no limit by more than its radius.
    """
    return np.minimum(_TUKEY * spread,
                      0.9 * radius + 3 * np.maximum(trusted, np.minimum(noise, radius)))
