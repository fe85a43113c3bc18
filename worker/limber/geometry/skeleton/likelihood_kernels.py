"""Loops of the tree's score: the density of points across axes, and without some of them."""

import numpy as np

from limber.kernels import Kernel

HIDDEN = 0.03
"""Density of the half hidden from a sensor, as a fraction of that all around."""

_densities = Kernel(
    "densities", "distance float64[points]", "radius float64[points]", "facing float64[points]",
    "noises float64[noises]", "out found float64[points, noises]", "power float", "hidden float")
_left = Kernel("nodes_left", "near int64[points, candidates]", "gone bool[nodes]",
               "out found int64[points, count]")


def densities(distance: np.ndarray, radius: np.ndarray, facing: np.ndarray, noises: np.ndarray,
              power: float) -> np.ndarray:
    """Density times a ``power`` of the radius at distances from axes [m] with radii [m] for each
    noise [m], shape [m, k]; ``facing`` [m] is the cosine of the angle to the sensor, or NaN."""
    found = np.empty((len(distance), len(noises)))
    _densities.of(distance, radius, facing, noises, found, power, HIDDEN)
    return found


def left(near: np.ndarray, gone: np.ndarray, count: int) -> np.ndarray:
    """The first ``count`` of each point's nodes, nearest first, [m, k], that are not ``gone``, a
    mask [n]; the last one again where there are fewer, and -1 where there is none."""
    found = np.empty((len(near), count), np.int64)
    _left.of(near, gone, found)
    return found
