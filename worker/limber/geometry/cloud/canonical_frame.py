"""Order and axes of a cloud that do not depend on its file.

Choices point by point, or in cells of a grid, must not depend on the order or rotation of a file:
the same plant must give the same result.
"""

from dataclasses import dataclass

import numpy as np

_STEP = 1e-6  # fraction of the cloud's size: finer than any scanner resolves, coarser than rounding


@dataclass(frozen=True)
class OwnFrame:
    """A cloud's points in its own order and axes, from its middle, independent of its pose.

    If a file is moved, rotated or given in another unit, its numbers are rounded differently. A
    choice that compares two of them may then differ, and each choice affects others. So positions
    here are on a grid coarse enough to hide rounding.

    Attributes:
        coordinates: Points in this frame [m], shape [n, 3].
        order: Index of each point in the cloud, shape [n].
        middle: The frame's origin [m], shape [3].
        axes: The frame's axes as columns, shape [3, 3].
    """

    coordinates: np.ndarray
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
        coordinates = offset @ axes
        step = 2.0**np.floor(np.log2(max(_STEP * np.linalg.norm(np.ptp(coordinates, axis=0)),
                                         1e-300)))
        return cls(np.round(coordinates / step) * step, order, middle, axes)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return the positions of points in this frame, shape [..., 3]."""
        return (points - self.middle) @ self.axes

    def outside(self, coordinates: np.ndarray) -> np.ndarray:
        """Return the points at positions of this frame, shape [..., 3]."""
        return coordinates @ self.axes.T + self.middle


def own_order(points: np.ndarray) -> np.ndarray:
    """Return indices of points in an order that depends only on their positions, shape [n].

    If ordered only by distance from the middle, regions grown from the first points would start
    there.

    Args:
        points: Positions, shape [n, 3].
    """
    order = np.argsort(np.linalg.norm(points - points.mean(axis=0), axis=1), kind="stable")
    return order[np.random.default_rng(0).permutation(len(points))]


def own_axes(points: np.ndarray) -> np.ndarray:
    """The directions in which a cloud extends, longest first, as columns, shape [3, 3].

    Right-handed; the first two point towards the longer tails of the cloud.
    """
    offset = points - points.mean(axis=0)
    axes = np.linalg.eigh(offset.T @ offset)[1][:, ::-1]
    axes = axes * np.where(((offset @ axes)**3).sum(axis=0) < 0, -1.0, 1.0)
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return axes
