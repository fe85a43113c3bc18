"""When a gripper passes the poses of a path, under limits of speed and acceleration.

Along a polyline of given corners the fastest motion from rest to rest: the squared speed may grow
and fall by ``2 a ds`` along the way (a pass forward and one backward), and at a corner of curvature
``k`` it is at most ``a / k``. Both parts of the acceleration, along and across, get their share, so
that the whole is never over the limit.
"""

from dataclasses import dataclass

import numpy as np

_SHARE = np.sqrt(0.5)  # of the acceleration, each along and across
_PIECES = 16  # an edge is cut into, so that speeds change within it


@dataclass(frozen=True)
class Pace:
    """Largest speed [m/s] and acceleration [m/s^2] of the gripper."""

    speed: float = 0.02
    acceleration: float = 0.1


DEFAULT_PACE = Pace()


def times_along(positions: np.ndarray, pace: Pace, stops: tuple[int, ...] = ()) -> np.ndarray:
    """Return when ``positions`` [n, 3] are passed [s], from 0, shape [n].

    The motion stands still at both ends and at the points ``stops``.
    """
    if len(positions) < 2:
        return np.zeros(len(positions))
    edges = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    slowest = _at_corners(positions, edges, pace)
    slowest[[0, -1, *stops]] = 0.0
    bound = np.full((len(edges), _PIECES), pace.speed)
    bound[:, 0] = slowest[:-1]
    bound = np.append(bound.ravel(), slowest[-1])
    steps = np.repeat(edges / _PIECES, _PIECES)
    gain = 2.0 * _SHARE * pace.acceleration * steps
    squared = bound**2
    for k in range(len(steps)):
        squared[k + 1] = min(squared[k + 1], squared[k] + gain[k])
    for k in range(len(steps) - 1, -1, -1):
        squared[k] = min(squared[k], squared[k + 1] + gain[k])
    speeds = np.sqrt(squared)
    durations = 2.0 * steps / np.maximum(speeds[1:] + speeds[:-1], 1e-12)
    return np.concatenate([[0.0], np.cumsum(np.where(steps > 0.0, durations, 0.0))])[::_PIECES]


def _at_corners(positions: np.ndarray, edges: np.ndarray, pace: Pace) -> np.ndarray:
    """Return the speed at each point that its curvature allows [m/s], shape [n]."""
    fastest = np.full(len(positions), pace.speed)
    way = np.diff(positions, axis=0) / np.maximum(edges, 1e-12)[:, None]
    turn = np.linalg.norm(np.diff(way, axis=0), axis=1)
    curvature = turn / np.maximum(0.5 * (edges[1:] + edges[:-1]), 1e-12)
    with np.errstate(divide="ignore"):
        fastest[1:-1] = np.minimum(pace.speed, np.sqrt(_SHARE * pace.acceleration / curvature))
    return fastest
