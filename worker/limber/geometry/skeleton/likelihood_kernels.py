"""Loops of the tree's score: densities of points across axes, nodes left, radii that fall."""

import numpy as np

from limber.kernels import Kernel

HIDDEN = 0.03
"""Density of the half hidden from a sensor, as a fraction of that all around."""

_densities = Kernel(
    "densities", "distance float64[points]", "radius float64[points]", "facing float64[points]",
    "open_ float64[points]", "noises float64[noises]", "out found float64[points, noises]",
    "power float", "hidden float", "sharp float")
_falling = Kernel("falling", "value float64[nodes]", "weight float64[nodes]",
                  "parent int64[nodes]", "out found float64[nodes]")
_left = Kernel("nodes_left", "near int64[points, candidates]", "gone bool[nodes]",
               "out found int64[points, count]")


def densities(distance: np.ndarray, radius: np.ndarray, facing: np.ndarray, open_: np.ndarray,
              noises: np.ndarray, power: float, sharp: float) -> np.ndarray:
    """Density times a ``power`` of the radius at distances from axes [m] with radii [m] for each
    noise along the sight [m], shape [m, k]; across it is ``sharp`` times that. ``facing`` [m] is
    the cosine of the angle to the sensor, or NaN, ``open_`` [m] the sine of that between axis and
    sight."""
    found = np.empty((len(distance), len(noises)))
    _densities.of(distance, radius, facing, open_, noises, found, power, HIDDEN, sharp)
    return found


def left(near: np.ndarray, gone: np.ndarray, count: int) -> np.ndarray:
    """The first ``count`` of each point's nodes, nearest first, [m, k], that are not ``gone``, a
    mask [n]; the last one again where there are fewer, and -1 where there is none."""
    found = np.empty((len(near), count), np.int64)
    _left.of(near, gone, found)
    return found


def falling(value: np.ndarray, weight: np.ndarray, parent: np.ndarray) -> np.ndarray:
    """The nearest values [n] that nowhere rise away from the root: a few far points would swell a
    twig. Least squares with weights [n] on a rooted tree (Pardalos and Xue 1999)."""
    found = np.empty(len(value))
    _falling.of(value, weight, parent, found)
    return found
