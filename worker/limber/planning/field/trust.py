"""Where a field that was fitted to samples may be believed.

Radial functions extrapolate freely, and wrongly. A point is trusted inside the convex hull of the
accepted samples, unless a pose that the branch model refused lies nearer than any it accepted.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from limber.compiled import compiled
from limber.errors import WorkError

_EDGE = 1e-9  # [m] a sample on the hull belongs to it in spite of rounding


@dataclass(frozen=True)
class TrustRegion:
    """Attributes: ``planes`` [k, d + 1] with ``n . x + c <= 0`` inside, ``accepted`` [m, d] and
    ``rejected`` [q, d] sample positions [m]."""

    planes: np.ndarray
    accepted: np.ndarray
    rejected: np.ndarray

    @classmethod
    def of(cls, accepted: np.ndarray, rejected: np.ndarray) -> "TrustRegion":
        """Make the region of samples; raises WorkError if they span no volume."""
        accepted = np.ascontiguousarray(accepted, float)
        rejected = np.ascontiguousarray(rejected, float).reshape(-1, accepted.shape[1])
        try:
            planes = np.unique(ConvexHull(accepted).equations.round(12), axis=0)
        except (QhullError, ValueError) as error:
            raise WorkError(
                f"{len(accepted)} accepted grasp poses span no volume.",
                "The energy is known only between them.",
                "Sample more poses, or a larger deflection.") from error
        return cls(np.ascontiguousarray(planes), accepted, rejected)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return whether each of ``points`` [n, d] is trusted, bool [n]."""
        return _contain(np.ascontiguousarray(points, float).reshape(-1, self.accepted.shape[1]),
                        self.planes, self.accepted, self.rejected)

    def height(self, points: np.ndarray) -> np.ndarray:
        """Return how far ``points`` [n, d] are above the hull's highest plane [m], [n].

        Negative inside; nowhere does it grow faster than a metre a metre.
        """
        return _heights(np.ascontiguousarray(points, float).reshape(-1, self.accepted.shape[1]),
                        self.planes)

    @property
    def low(self) -> np.ndarray:
        """Lower corner of the bounding box [m], shape [d]."""
        return self.accepted.min(axis=0)

    @property
    def high(self) -> np.ndarray:
        """Upper corner of the bounding box [m], shape [d]."""
        return self.accepted.max(axis=0)

    def draw(self, count: int, generator: np.random.Generator) -> np.ndarray:
        """Return ``count`` trusted points, uniformly distributed, shape [count, d]."""
        found: list[np.ndarray] = []
        missing = count
        while missing > 0:
            points = generator.uniform(self.low, self.high, (4 * count + 16, len(self.low)))
            points = points[self.contains(points)][:missing]
            found.append(points)
            missing -= len(points)
        return np.concatenate(found)


@compiled
def trusted_at(point, planes, accepted, rejected):
    """Return whether ``point`` [d] is in the region."""
    dimension = len(point)
    for i in range(len(planes)):
        height = planes[i, dimension]
        for k in range(dimension):
            height += planes[i, k] * point[k]
        if height > _EDGE:
            return False
    if len(rejected) == 0:
        return True
    return _nearest(point, accepted) <= _nearest(point, rejected)


@compiled
def _nearest(point, others):
    best = np.inf
    for i in range(len(others)):
        squared = 0.0
        for k in range(len(point)):
            squared += (point[k] - others[i, k]) ** 2
        best = min(best, squared)
    return best


@compiled
def _heights(points, planes):
    dimension = points.shape[1]
    out = np.full(len(points), -np.inf)
    for n in range(len(points)):
        for i in range(len(planes)):
            height = planes[i, dimension]
            for k in range(dimension):
                height += planes[i, k] * points[n, k]
            out[n] = max(out[n], height)
    return out


@compiled
def _contain(points, planes, accepted, rejected):
    inside = np.empty(len(points), np.bool_)
    for i in range(len(points)):
        inside[i] = trusted_at(points[i], planes, accepted, rejected)
    return inside
