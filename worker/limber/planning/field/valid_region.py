"""The region in which a fitted field is trusted.

Radial functions extrapolate freely, and wrongly. A point is trusted inside the convex hull of the
accepted samples, unless a pose that the branch model refused is nearer than any accepted one. The
samples lie along a curved shell, whose flat facets would cut off the very poses that gentle paths
take: the hull is taken in coordinates that flatten it
(:mod:`limber.planning.field.chart`).
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from limber.core.errors import WorkError
from limber.core.numerics.compiled import compiled
from limber.planning.field.chart import Chart, mapped

_EDGE = 1e-9  # [m] a sample on the hull belongs to it despite rounding
_OUTLINE = 24  # points per side of the grid that outlines the region


@dataclass(frozen=True)
class TrustRegion:
    """Where a field is trusted: within hull planes [k, 4], ``n . y + c <= 0`` in the plain chart,
    and nearer to accepted than rejected poses. ``low``, ``high`` and ``outline`` bound it."""

    planes: np.ndarray
    accepted: np.ndarray
    rejected: np.ndarray
    chart: Chart
    low: np.ndarray
    high: np.ndarray
    outline: np.ndarray

    @classmethod
    def of(cls, accepted: np.ndarray, rejected: np.ndarray, pivot: np.ndarray | None = None,
           radius: float = 0.0) -> "TrustRegion":
        """Make the region of samples, the rest pose first, along the sphere if one is given.
        WorkError if the samples span no volume."""
        accepted = np.ascontiguousarray(accepted, float)
        rejected = np.ascontiguousarray(rejected, float).reshape(-1, 3)
        chart = Chart.about(pivot, radius, accepted[0])
        flat = chart.map(accepted)
        try:
            planes = np.unique(ConvexHull(flat).equations.round(12), axis=0)
        except (QhullError, ValueError) as error:
            raise WorkError(
                f"{len(accepted)} accepted grasp poses span no volume.",
                "The energy is known only between them.",
                "Sample more poses, or use a larger deflection.") from error
        outline = _outline(flat, planes, chart) if chart.radius > 0.0 else accepted
        return cls(np.ascontiguousarray(planes), accepted, rejected, chart,
                   outline.min(axis=0), outline.max(axis=0), outline)

    @property
    def arrays(self) -> tuple:
        """Arguments of :func:`trusted_at` after the point."""
        return self.chart.arrays, self.planes, self.accepted, self.rejected

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return whether each of ``points`` [n, 3] is trusted, bool [n]."""
        return _contain(_rows(points), self.arrays)

    def height(self, points: np.ndarray) -> np.ndarray:
        """Return how far ``points`` [n, 3] are above the hull's highest plane [m], [n]. In
        flattened coordinates, negative inside."""
        return _heights(self.chart.map(points), self.planes)[0]

    def surely_outside(self, centres: np.ndarray, halves: np.ndarray) -> np.ndarray:
        """Return which boxes with half edges as rows [3, 3] hold no trusted point, bool [n]. They
        are above the plane that is highest at their centre, to second order, or nearer to one
        refused pose than to any accepted one (exact, as boundaries are flat)."""
        reach = float(np.linalg.norm(halves))
        heights, slopes = self.height_and_slope(centres)
        least = heights - np.abs(slopes @ halves.T).sum(axis=1)
        outside = least - 0.5 * reach**2 * self.chart.bend(centres, reach) > _EDGE
        if len(self.rejected):
            outside |= _surely_refused(centres, halves, self.accepted, self.rejected)
        return outside

    def plane_least(self, middles: np.ndarray, halves: np.ndarray) -> np.ndarray:
        """Return how far boxes about ``middles`` [n, 3] in flattened coordinates, with half edges
        ``halves`` [3] along them, are above the plane that is highest at their middle [m], [n]."""
        heights, top = _heights(_rows(middles), self.planes)
        return heights - np.abs(self.planes[top, :3]) @ halves

    def height_and_slope(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return heights [m], shape [n], and their gradients to the point, [n, 3]."""
        heights, top = _heights(self.chart.map(_rows(points)), self.planes)
        return heights, self.chart.pull_back(points, self.planes[top, :3])

    def is_face(self) -> np.ndarray:
        """Return which accepted samples lie on the hull's face, bool [m]."""
        return self.height(self.accepted) > -1e-7

    def draw(self, count: int, generator: np.random.Generator) -> np.ndarray:
        """Return ``count`` trusted points, uniformly distributed, shape [count, 3]."""
        found: list[np.ndarray] = []
        missing = count
        while missing > 0:
            points = generator.uniform(self.low, self.high, (4 * count + 16, len(self.low)))
            points = points[self.contains(points)][:missing]
            found.append(points)
            missing -= len(points)
        return np.concatenate(found)


def _outline(flat: np.ndarray, planes: np.ndarray, chart: Chart) -> np.ndarray:
    """Points [n, 3] whose bounding box along any axes holds the region: a grid over the hull's box,
    and near the hull corners of the largest box that a cell becomes when mapped back."""
    low, high = flat.min(axis=0), flat.max(axis=0)
    ticks = [np.linspace(a, b, _OUTLINE) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    half = 0.5 * float(np.linalg.norm((high - low) / (_OUTLINE - 1)))
    near = grid[_heights(grid, planes)[0] <= half]
    # Mapped back, a length grows by r / R at most.
    reach = half * max(1.0, 1.0 + (high[2] + half) / chart.radius)
    sides = reach * np.concatenate([np.eye(3), -np.eye(3)]) * np.sqrt(3.0)
    points = chart.curved(near)
    hull = points[ConvexHull(points).vertices]
    return (hull[:, None] + sides[None]).reshape(-1, 3)


def _rows(points: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(points, float).reshape(-1, 3)


@compiled
def trusted_at(point, region):
    """Return whether ``point`` [3] is in the region; see :attr:`TrustRegion.arrays`."""
    chart, planes, accepted, rejected = region
    flat = mapped(point, *chart)
    for i in range(len(planes)):
        height = planes[i, 3]
        for k in range(3):
            height += planes[i, k] * flat[k]
        if height > _EDGE:
            return False
    if len(rejected) == 0:
        return True
    return _nearest(point, accepted) <= _nearest(point, rejected)


@compiled
def _nearest(point, others):
    return np.sum((point - others[_nearest_number(point, others)]) ** 2)


@compiled
def nearest_of(points, others):
    """Return the distance of ``points`` [n, 3] to the nearest of ``others`` [m, 3], shape [n], and
    the unit vectors from it, shape [n, 3]."""
    distance, away = np.empty(len(points)), np.empty_like(points)
    for n in range(len(points)):
        number = _nearest_number(points[n], others)
        distance[n] = np.sqrt(np.sum((points[n] - others[number]) ** 2))
        away[n] = (points[n] - others[number]) / max(distance[n], 1e-12)
    return distance, away


@compiled
def _surely_refused(centres, halves, accepted, rejected):
    """Return which boxes are nearer to one refused pose than to any accepted one."""
    found = np.zeros(len(centres), np.bool_)
    for n in range(len(centres)):
        refused = _nearest_number(centres[n], rejected)
        whole = True
        for i in range(len(accepted)):
            # |x - a|^2 - |x - r|^2 is linear in x: least at a corner.
            ahead = 0.0
            for axis in range(3):
                along = 0.0
                for k in range(3):
                    normal = 2.0 * (rejected[refused, k] - accepted[i, k])
                    along += normal * halves[axis, k]
                ahead -= np.abs(along)
                middle = 0.5 * (rejected[refused, axis] + accepted[i, axis])
                ahead += 2.0 * (rejected[refused, axis] - accepted[i, axis]) * (
                    centres[n, axis] - middle)
            if ahead <= 0.0:
                whole = False
                break
        found[n] = whole
    return found


@compiled
def _nearest_number(point, others):
    best, number = np.inf, 0
    for i in range(len(others)):
        squared = 0.0
        for k in range(len(point)):
            squared += (point[k] - others[i, k]) ** 2
        if squared < best:
            best, number = squared, i
    return number


@compiled
def _heights(points, planes):
    """Return the height of ``points`` above the plane highest there, and which plane that is."""
    dimension = points.shape[1]
    out = np.full(len(points), -np.inf)
    top = np.zeros(len(points), np.int64)
    for n in range(len(points)):
        for i in range(len(planes)):
            height = planes[i, dimension]
            for k in range(dimension):
                height += planes[i, k] * points[n, k]
            if height > out[n]:
                out[n], top[n] = height, i
    return out, top


@compiled
def _contain(points, region):
    inside = np.empty(len(points), np.bool_)
    for i in range(len(points)):
        inside[i] = trusted_at(points[i], region)
    return inside
