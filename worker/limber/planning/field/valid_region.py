"""The region in which a fitted field is trusted.

Radial functions extrapolate freely, and wrongly. A point is trusted inside the convex hull of the
accepted samples, unless a pose that the branch model refused is nearer than any accepted one. The
samples lie along a curved shell, whose flat facets would cut off the very poses that gentle paths
take: the hull is taken in coordinates that flatten it
(:mod:`limber.planning.field.chart`).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from limber.core.errors import WorkError
from limber.kernels import Kernel, for_kernels
from limber.planning.field.chart import FAR, Chart, by_column

_POINTS = "points float64[points, 3]"
_trusted = Kernel("points_trusted", _POINTS, "region float64[region]", "out trusted bool[points]")
_above = Kernel("heights_above", _POINTS, "planes float64[planes, 4]",
                "out heights float64[points]", "out top int64[points]")
_nearest = Kernel("nearest_others_of", _POINTS, "others float64[others, 3]",
                  "out distance float64[points]", "out away float64[points, 3]")
_refused = Kernel("boxes_refused", "centres float64[boxes, 3]", "halves float64[3, 3]",
                  "accepted float64[accepted, 3]", "rejected float64[rejected, 3]",
                  "out refused bool[boxes]")

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

    @cached_property
    def numbers(self) -> np.ndarray:
        """What the kernels read, shape [n]."""
        planes, *sets = by_column(self.planes, -np.inf), *(
            by_column(one, FAR) for one in (self.accepted, self.rejected))
        return np.hstack([self.chart.numbers, _EDGE, *(each.shape[1] for each in (planes, *sets)),
                          *(each.ravel() for each in (planes, *sets))])

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return whether each of ``points`` [n, 3] is trusted, bool [n]."""
        points = _rows(points)
        trusted = np.empty(len(points), bool)
        _trusted(points, self.numbers, trusted)
        return trusted

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
            refused = np.empty(len(centres), bool)
            _refused.of(centres, halves, self.accepted, self.rejected, refused)
            outside |= refused
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
    return for_kernels(points).reshape(-1, 3)


def nearest_of(points: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance of ``points`` [n, 3] to the nearest of ``others`` [m, 3], shape [n], and
    the unit vectors from it, shape [n, 3]."""
    distance, away = np.empty(len(points)), np.empty((len(points), 3))
    _nearest.of(points, others, distance, away)
    return distance, away


def _heights(points: np.ndarray, planes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the height of ``points`` above the plane highest there, and which plane that is."""
    heights, top = np.empty(len(points)), np.empty(len(points), np.int64)
    _above.of(points, planes, heights, top)
    return heights, top
