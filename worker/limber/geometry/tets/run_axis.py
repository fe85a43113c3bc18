"""A run's axis as a curve of its length."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.sweep import arc_lengths


@dataclass
class RunAxis:
    """One run's axis.

    Attributes:
        points: Its nodes [m], shape [n, 3].
        radius: Radii there [m], shape [n].
        along: Length up to each [m], shape [n].
    """

    points: np.ndarray
    radius: np.ndarray
    along: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton, run: int) -> "RunAxis":
        """The axis of a run from its fork on, with the twig's own radius there."""
        points, radius = skeleton.curve(run)
        return cls(points, radius, arc_lengths(points))

    @property
    def length(self) -> float:
        """[m]."""
        return float(self.along[-1])

    def straight_until(self, reach: float) -> "RunAxis":
        """The axis with its first ``reach`` [m] straightened."""
        kept = self.along >= min(reach, 0.5 * self.length)
        kept[0] = True
        points = self.points[kept]
        return RunAxis(points, self.radius[kept], arc_lengths(points))

    def at(self, where: np.ndarray | float) -> np.ndarray:
        """Positions [m], shape [..., 3], at lengths along it [m]."""
        return np.stack([np.interp(where, self.along, self.points[:, k]) for k in range(3)],
                        axis=-1)

    def radius_at(self, where: np.ndarray | float) -> np.ndarray:
        """Radii [m] at lengths along it [m]."""
        return np.interp(where, self.along, self.radius)

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance of points from the axis [m], and position of the foot along it [m]."""
        where = np.linspace(0, self.length, max(8 * len(self.points), 50))
        distance, index = cKDTree(self.at(where)).query(points)
        return distance, where[index]
