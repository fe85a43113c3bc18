"""The motion of grasps between given poses: smooth, with velocity and acceleration."""

from collections.abc import Sequence

import numpy as np

from limber.core.errors import InputError
from limber.mechanics.grasp import Grasp

_DIFFERENCE = 2e-5
"""Time difference [s] for velocity and acceleration of the patch's nodes."""


class PosePath:
    """Poses of one or several grasps over time.

    A cubic spline through positions and (unwrapped) rotation vectors that starts at rest.

    Args:
        grasps: The grasps.
        rest: Rest positions of all nodes [m].
        times: Times of the poses [s].
        poses: [m, rad], shape [frames, 6] or [frames, grasps, 6].

    Attributes:
        poses: Shape [frames, grasps, 6], rotation vectors unwrapped.
        clamped, pinned: The grasps of each mode.

    Raises:
        InputError: shapes do not fit, or values are not finite.
    """

    def __init__(self, grasps: Sequence[Grasp], rest: np.ndarray, times: np.ndarray,
                 poses: np.ndarray):
        from scipy.interpolate import CubicSpline

        expected = (len(times), len(grasps), 6)
        poses = np.asarray(poses, float)
        if poses.size != np.prod(expected) or not np.isfinite(poses).all():
            raise InputError(f"The poses have shape {poses.shape} or are not finite.",
                             f"{len(times)} times and {len(grasps)} grasps need shape {expected}.",
                             "Give x, y, z [m] and a rotation vector [rad] for each.")
        self.grasps, self._rest = list(grasps), rest
        self.poses = unwrapped(poses.reshape(expected))
        self.clamped = [g for g in self.grasps if g.mode == "rigid"]
        self.pinned = [g for g in self.grasps if g.mode == "point"]
        self._spline = None
        if len(times) > 1:
            self._spline = CubicSpline(times, self.poses, axis=0,
                                       bc_type=((1, np.zeros(expected[1:])),
                                                (2, np.zeros(expected[1:]))))

    def at(self, instant: float) -> tuple[list[list[np.ndarray]], list[np.ndarray]]:
        """Return displacement, velocity and acceleration at a time.

        Returns:
            For the nodes of each clamped grasp: three lists of arrays [k, 3]; and for the means
            of the pinned ones: three arrays [pinned, 3].
        """
        before, now, after = (self._placed(instant + shift)
                              for shift in (-_DIFFERENCE, 0.0, _DIFFERENCE))
        held = [now[0],
                [(b - a) / (2 * _DIFFERENCE) for a, b in zip(before[0], after[0], strict=True)],
                [(a - 2 * m + b) / _DIFFERENCE**2
                 for a, m, b in zip(before[0], now[0], after[0], strict=True)]]
        pins = [now[1], (after[1] - before[1]) / (2 * _DIFFERENCE),
                (before[1] - 2 * now[1] + after[1]) / _DIFFERENCE**2]
        return held, pins

    def _placed(self, instant: float) -> tuple[list[np.ndarray], np.ndarray]:
        poses = self.poses[0] if self._spline is None else self._spline(instant)
        held, pins = [], []
        for grasp, pose in zip(self.grasps, poses, strict=True):
            if grasp.mode == "rigid":
                held.append(grasp.displacement(self._rest, pose))
            else:
                pins.append(pose[:3] - grasp.centre)
        return held, np.reshape(pins, (-1, 3))


def unwrapped(poses: np.ndarray) -> np.ndarray:
    """Return poses [frames, grasps, 6] whose rotation vectors do not jump by a full turn."""
    result = poses.copy()
    for frame in range(1, len(result)):
        for number in range(result.shape[1]):
            vector, last = result[frame, number, 3:], result[frame - 1, number, 3:]
            angle = np.linalg.norm(vector)
            if angle < 1e-12:
                # A zero rotation has no unique axis: a full turn about the last axis may be nearer.
                size = np.linalg.norm(last)
                turns = np.round(size / (2 * np.pi))
                result[frame, number, 3:] = last / size * 2 * np.pi * turns if turns else 0.0
                continue
            axis = vector / angle
            turns = np.round((last @ axis - angle) / (2 * np.pi))
            result[frame, number, 3:] = vector + axis * 2 * np.pi * turns
    return result
