"""Times at which a gripper passes the poses of a path, under limits of speed and acceleration.

The fastest motion from rest to rest along a polyline of given corners: the squared speed may grow
and fall by ``2 a ds`` along the path (one pass forward and one backward), and at a corner of
curvature ``k`` it is at most ``a / k``. Both components of the acceleration, along and across, get
a fraction of the limit, so that the total never exceeds it.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from limber.core.numerics.rigid import curve_through, rotations_at

_SHARE = np.sqrt(0.5)  # fraction of the acceleration, along and across
_PIECES = 16  # pieces of an edge, so that speed changes within it
_STILL = 1e-9  # [m] below which two poses are one


@dataclass(frozen=True)
class Pace:
    """Largest speed [m/s] and acceleration [m/s^2] of the gripper."""

    speed: float = 0.02
    acceleration: float = 0.1

    def slower(self, times: float) -> "Pace":
        """Return the pace of a motion that takes this many times as long."""
        return Pace(self.speed / times, self.acceleration / times**2)


DEFAULT_PACE = Pace()


@dataclass(frozen=True)
class TimeLaw:
    """Distance [m] of a motion along its path over time [s], with constant acceleration between
    knots [k], which start at 0."""

    along: np.ndarray
    times: np.ndarray
    speeds: np.ndarray

    @property
    def duration(self) -> float:
        """[s]."""
        return float(self.times[-1])

    @property
    def accelerations(self) -> np.ndarray:
        """Acceleration along the path, between the knots [m/s^2], shape [k - 1]."""
        durations = np.diff(self.times)
        return np.diff(self.speeds) / np.maximum(durations, 1e-12) * (durations > 0.0)

    def at(self, instants: np.ndarray) -> np.ndarray:
        """Return the distance along the path at ``instants`` [s] [m]; the last one afterwards."""
        instants = np.clip(instants, 0.0, self.duration)
        piece = np.clip(np.searchsorted(self.times, instants, side="right") - 1, 0,
                        len(self.times) - 2)
        since = instants - self.times[piece]
        moved = self.speeds[piece] * since + 0.5 * self.accelerations[piece] * since**2
        return np.clip(self.along[piece] + moved, self.along[piece], self.along[piece + 1])


def time_law(positions: np.ndarray, pace: Pace, stops: tuple[int, ...] = ()) -> TimeLaw:
    """Return the fastest motion along ``positions`` [n, 3], two or more. It is at standstill at
    both ends and at the points ``stops``."""
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
    times = np.cumsum(np.where(steps > 0.0, durations, 0.0))
    return TimeLaw(np.concatenate([[0.0], np.cumsum(steps)]), np.concatenate([[0.0], times]),
                   speeds)


def times_along(positions: np.ndarray, pace: Pace, stops: tuple[int, ...] = ()) -> np.ndarray:
    """Return the times [s], from 0, at ``positions`` [n, 3], shape [n]; see :func:`time_law`."""
    if len(positions) < 2:
        return np.zeros(len(positions))
    return time_law(positions, pace, stops).times[::_PIECES]


def poses_at(poses: np.ndarray, law: TimeLaw, instants: np.ndarray,
             stops: tuple[int, ...] = ()) -> np.ndarray:
    """Return poses [m, 6] [m, rad] at ``instants`` [s] of a timed motion: between stops a curve
    through positions, and shortest turns of rotations."""
    knots = law.along[::_PIECES]
    along = law.at(instants)
    found = np.empty((len(along), 6))
    ends = [0, *stops, len(poses) - 1]
    for first, last in pairwise(ends):
        here = (along >= knots[first]) & (along <= knots[last])
        moves = np.flatnonzero(np.diff(knots[first:last + 1]) > _STILL) + first + 1
        passed = np.concatenate([[first], moves]).astype(int)
        if len(passed) < 2 or not here.any():
            found[here] = poses[first]
            continue
        distances, asked = knots[passed], np.clip(along[here], knots[first], knots[passed[-1]])
        found[here, :3] = curve_through(distances, poses[passed, :3], asked)
        found[here, 3:] = rotations_at(distances, poses[passed, 3:], asked)
    return found


def _at_corners(positions: np.ndarray, edges: np.ndarray, pace: Pace) -> np.ndarray:
    """Return the speed at each point that its curvature allows [m/s], shape [n]."""
    fastest = np.full(len(positions), pace.speed)
    direction = np.diff(positions, axis=0) / np.maximum(edges, 1e-12)[:, None]
    turn = np.linalg.norm(np.diff(direction, axis=0), axis=1)
    curvature = turn / np.maximum(0.5 * (edges[1:] + edges[:-1]), 1e-12)
    with np.errstate(divide="ignore"):
        fastest[1:-1] = np.minimum(pace.speed, np.sqrt(_SHARE * pace.acceleration / curvature))
    return fastest
