"""Order and axes of a cloud that are its own, not its file's.

What is chosen point by point, or in cells of a grid, must not depend on how a file is sorted or
turned: the same plant is to give the same result.
"""

from dataclasses import dataclass

import numpy as np

_STEP = 1e-6  # of the cloud's size: far finer than any scanner tells, far coarser than rounding


@dataclass(frozen=True)
class OwnFrame:
    """A cloud's points in its own order and axes, from its middle, the same wherever it lies.

    Moved, turned or in another unit, a file's numbers are rounded otherwise. What is chosen by
    comparing two of them may then be chosen otherwise, and each choice leads to others: places
    here are those of a grid so coarse that rounding does not show.

    Attributes:
        places: Points in this frame [m], shape [n, 3].
        order: Index of each in the cloud, shape [n].
        middle: The frame's origin [m], shape [3].
        axes: The frame's axes as columns, shape [3, 3].
    """

    places: np.ndarray
    order: np.ndarray
    middle: np.ndarray
    axes: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> "OwnFrame":
        """The frame of points [m], shape [n, 3]."""
        order = own_order(points)
        middle = points[order].mean(axis=0)
        offset = points[order] - middle
        axes = own_axes(offset)
        places = offset @ axes
        step = 2.0**np.floor(np.log2(max(_STEP * np.linalg.norm(np.ptp(places, axis=0)), 1e-300)))
        return cls(np.round(places / step) * step, order, middle, axes)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return places in this frame of points, shape [..., 3]."""
        return (points - self.middle) @ self.axes

    def outside(self, places: np.ndarray) -> np.ndarray:
        """Return points of places in this frame, shape [..., 3]."""
        return places @ self.axes.T + self.middle


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
