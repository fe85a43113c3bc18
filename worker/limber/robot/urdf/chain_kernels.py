"""Kernels of the kinematics of a chain of revolute joints.

``origins`` [n + 1, 4, 4] are the joints' frames at angle 0, each in that of the previous joint, and
the flange's in the last one's; ``axes`` [n, 3] are the joint axes.
"""

import math

import numpy as np

from limber.core.numerics.compiled import compiled
from limber.core.numerics.rigid_kernels import inverse_of, rotation_vector

_MOST_STEPS = 60
_CLOSE = 1e-11  # m and rad: a solution
_LARGEST_STEP = 0.5  # rad
_LEAST_DAMPING, _MOST_DAMPING = 1e-12, 1e3


@compiled
def _chained(origins: np.ndarray, axes: np.ndarray, joints: np.ndarray, frames: np.ndarray,
             ) -> None:
    """Fill the frames [n + 1, 4, 4] of the joints and the flange at one pose [n]."""
    turned, turn = np.eye(4), np.eye(3)
    for k in range(len(origins)):
        if k < len(joints):
            c, s = math.cos(joints[k]), math.sin(joints[k])
            x, y, z = axes[k]
            v = 1.0 - c
            # Rodrigues.
            turn[0, 0], turn[0, 1], turn[0, 2] = c + x * x * v, x * y * v - z * s, x * z * v + y * s
            turn[1, 0], turn[1, 1], turn[1, 2] = y * x * v + z * s, c + y * y * v, y * z * v - x * s
            turn[2, 0], turn[2, 1], turn[2, 2] = z * x * v - y * s, z * y * v + x * s, c + z * z * v
        origin, before = origins[k], frames[max(k - 1, 0)]
        for i in range(3):
            for j in range(3):
                turned[i, j] = origin[i, j] if k == len(joints) else (
                    origin[i, 0] * turn[0, j] + origin[i, 1] * turn[1, j]
                    + origin[i, 2] * turn[2, j])
            turned[i, 3] = origin[i, 3]
        if k == 0:
            frames[0] = turned
            continue
        for i in range(3):
            for j in range(4):
                frames[k, i, j] = (before[i, 0] * turned[0, j] + before[i, 1] * turned[1, j]
                                   + before[i, 2] * turned[2, j] + before[i, 3] * turned[3, j])
        frames[k, 3] = turned[3]


@compiled
def _slopes(axes: np.ndarray, frames: np.ndarray, slopes: np.ndarray) -> None:
    """Fill the flange's Jacobian [6, n] from the frames [n + 1, 4, 4] of one pose."""
    count = len(axes)
    for k in range(count):
        for i in range(3):
            slopes[3 + i, k] = (frames[k, i, 0] * axes[k, 0] + frames[k, i, 1] * axes[k, 1]
                                + frames[k, i, 2] * axes[k, 2])
        axis, lever = slopes[3:, k], frames[count, :3, 3] - frames[k, :3, 3]
        slopes[0, k] = axis[1] * lever[2] - axis[2] * lever[1]
        slopes[1, k] = axis[2] * lever[0] - axis[0] * lever[2]
        slopes[2, k] = axis[0] * lever[1] - axis[1] * lever[0]


@compiled
def _off(frame: np.ndarray, flange: np.ndarray, off: np.ndarray) -> None:
    """Fill the translation [m] and rotation [rad] from the flange to its target, shape [6]."""
    off[:3] = frame[:3, 3] - flange[:3, 3]
    off[3:] = rotation_vector(frame @ inverse_of(flange))


@compiled
def chain_frames(origins: np.ndarray, axes: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Return the frames of the joints and the flange in the base's, shape [poses, n + 1, 4, 4]."""
    frames = np.empty((len(joints), len(origins), 4, 4))
    for pose in range(len(joints)):
        _chained(origins, axes, joints[pose], frames[pose])
    return frames


@compiled
def chain_jacobian(axes: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Return Jacobians of the flange [poses, 6, n] from frames [poses, n + 1, 4, 4]."""
    slopes = np.empty((len(frames), 6, len(axes)))
    for pose in range(len(frames)):
        _slopes(axes, frames[pose], slopes[pose])
    return slopes


@compiled
def solved(origins: np.ndarray, axes: np.ndarray, frames: np.ndarray, starts: np.ndarray,
           is_path: bool) -> np.ndarray:
    """Return the angles that bring the flange to ``frames`` [k, 4, 4], shape [k, n].

    Gauss-Newton steps with Levenberg-Marquardt damping; NaN if they do not converge.

    Args:
        starts: Start angles of each search, shape [k, n].
        is_path: Search each but the first from the one before; NaN from the first unreached one on.
    """
    count = len(axes)
    found = np.full((len(frames), count), np.nan)
    chain, tried = np.empty((count + 1, 4, 4)), np.empty((count + 1, 4, 4))
    slopes, off, off_tried = np.empty((6, count)), np.empty(6), np.empty(6)
    for number in range(len(frames)):
        is_later = is_path and number > 0
        guess = found[number - 1].copy() if is_later else starts[number].copy()
        if np.isnan(guess[0]):
            continue
        joints, damping, least = guess, 1e-3, np.inf
        for _ in range(_MOST_STEPS):
            _chained(origins, axes, guess, tried)
            _off(frames[number], tried[count], off_tried)
            square = (off_tried * off_tried).sum()
            if square < least:
                joints, least = guess, square
                chain[:], off[:] = tried, off_tried
                damping = max(0.1 * damping, _LEAST_DAMPING)
                _slopes(axes, chain, slopes)
            else:
                damping *= 10.0
            if not np.abs(off).max() > _CLOSE:
                found[number] = joints
                break
            if not damping < _MOST_DAMPING:
                break
            step = slopes.T @ np.linalg.solve(slopes @ slopes.T + damping * np.eye(6), off)
            guess = joints + step * min(1.0, _LARGEST_STEP / max(np.abs(step).max(), 1e-12))
    return found
