"""Order and axes of a cloud that are its own, not its file's.

What is chosen point by point, or in cells of a grid, must not depend on how a file is sorted or
turned: the same plant is to give the same result.
"""

import numpy as np


def own_order(points: np.ndarray) -> np.ndarray:
    """Return indices of points in an order that only hangs on where they lie, shape [n].

    By distance from the middle alone, what grows from the first points would grow from there.

    Args:
        points: Positions, shape [n, 3].
    """
    order = np.argsort(np.linalg.norm(points - points.mean(axis=0), axis=1), kind="stable")
    return order[np.random.default_rng(0).permutation(len(points))]


def own_axes(points: np.ndarray) -> np.ndarray:
    """The directions in which a cloud extends, farthest first, as columns, shape [3, 3].

    Right-handed; the first two point to where the cloud has its longer tails.
    """
    offset = points - points.mean(axis=0)
    axes = np.linalg.eigh(offset.T @ offset)[1][:, ::-1]
    axes = axes * np.where(((offset @ axes)**3).sum(axis=0) < 0, -1.0, 1.0)
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return axes
