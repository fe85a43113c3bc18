"""Simulate a few frames of a slow pull and interpolate the others.

Without inertia a branch's state is a smooth function of the gripper's pose (or force) alone. A few
states along the path and a cubic spline through them give the others at a small fraction of the
cost. Every observed frame still counts in the fit, so no measurement is discarded.
"""

import numpy as np
import scipy

ROTATION_LENGTH_M = 0.1
"""Travel equivalent to a rotation of one radian. Chosen; the model checks the spline."""


def travel(poses: np.ndarray, step_m: float = 5e-4) -> np.ndarray:
    """Return the path's length up to each pose, shape [n], without jitter below ``step_m``."""
    scaled = poses * np.r_[np.ones(3), np.full(3, ROTATION_LENGTH_M)]
    length = np.zeros(len(poses))
    last = 0
    for index in range(1, len(poses)):
        moved = float(np.linalg.norm(scaled[index] - scaled[last]))
        if moved >= step_m:
            since = np.linalg.norm(scaled[last:index + 1] - scaled[last], axis=1)
            length[last:index + 1] = length[last] + np.maximum.accumulate(since) * (
                moved / since.max())
            last = index
        else:
            length[index] = length[last]
    return length


def key_frames(along: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Choose the frames to simulate, and the interpolation of all frames.

    Args:
        along: A parameter that increases along the path, shape [n].
        count: Largest number of frames to simulate.

    Returns:
        Indices of the key frames, shape [k], and S, shape [n, k]: values at all frames are
        S @ values at the key frames.
    """
    distances, first = np.unique(along, return_index=True)
    if len(distances) > count:
        targets = np.linspace(distances[0], distances[-1], count)
        near = np.unique(np.abs(distances[:, None] - targets).argmin(axis=0))
        distances, first = distances[near], first[near]
    if len(distances) == 1:
        return first, np.ones((len(along), 1))
    if len(distances) < 4:
        spread = np.column_stack([np.interp(along, distances, row) for row
                                  in np.eye(len(distances))])
        return first, spread
    return first, scipy.interpolate.CubicSpline(distances, np.eye(len(distances)))(along)


def smoothed(times: np.ndarray, values: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """Return noisy measurements at given instants, each from a local quadratic fit.

    Args:
        times: [s], shape [n].
        values: Shape [n, c]; rows with NaN are discarded.
        keys: Requested instants [s], shape [k].
    """
    known = np.isfinite(values).all(axis=1)
    times, values = times[known], values[known]
    width = max(2.0 * np.ptp(times) / max(len(keys) - 1, 1), 1e-9)
    result = np.empty((len(keys), values.shape[1]))
    for row, key in enumerate(keys):
        near = np.abs(times - key) <= width / 2
        if near.sum() < 6:
            result[row] = [np.interp(key, times, column) for column in values.T]
        else:
            result[row] = np.polynomial.polynomial.polyfit(times[near] - key, values[near], 2)[0]
    return result
