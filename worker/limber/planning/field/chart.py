"""Coordinates in which a field over grasp positions is smooth, and its shell flat.

A branch bends easily across and hardly yields along. A free grasp moves on a shell
(:mod:`limber.planning.field.sampling`). A few millimetres off it, the energy changes as
much as over the whole reach: beyond the shell the branch is drawn taut, inside it bows out, and the
bow grows with the square root of the distance. Radial functions have a single length scale, and a
convex hull of samples on a curved shell cuts its facets off. Hence

    y = (R t e_1, R t e_2, k g(r - R)),    g(w) = w / (1 + (w / d)^2)^(1/4),

with ``r`` the distance from the shell's pivot, ``t`` the angle from the rest direction ``n``, ``e``
the unit vector across towards the point (the azimuthal projection of maps), ``k`` a stretch and
``d`` the depth beyond which depths count by their square root. Without a shell ``y`` is the point
itself.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from limber.core.numerics.rigid import any_normal
from limber.kernels import Kernel, for_kernels

_mapped = Kernel("chart_mapped", "points float64[points, 3]", "chart float64[15]",
                 "out flat float64[points, 3]")
_turned = Kernel("gradients_turned", "points float64[points, 3]", "gradients float64[points, 3]",
                 "chart float64[15]", "out turned float64[points, 3]", "forward int")
_LANES = 4  # samples that the kernels take at once
FAR = 1e60
"""The last coordinate of points that pad others for the kernels: never nearest, without weight."""


def by_column(rows: np.ndarray, beyond: float) -> np.ndarray:
    """Return ``rows`` [n, k] by columns, [k, padded n], as the kernels of a field have them: padded
    by rows of 0 whose last number is ``beyond``."""
    out = np.zeros((rows.shape[1], -(-len(rows) // _LANES) * _LANES))
    out[:, :len(rows)] = rows.T
    out[-1, len(rows):] = beyond
    return out


@dataclass(frozen=True)
class Chart:
    """The map above: ``pivot`` [3], ``radius`` [m] (0: no shell), unit rows ``axes`` [3, 3] (two
    across, then outward at rest), ``stretch`` and ``depth`` [m]."""

    pivot: np.ndarray
    radius: float
    axes: np.ndarray
    stretch: float = 1.0
    depth: float = np.inf

    @classmethod
    def about(cls, pivot: np.ndarray | None, radius: float, rest: np.ndarray) -> "Chart":
        """Return the chart of a sphere and the rest position [3] on it; no pivot: no shell."""
        arm = np.zeros(3) if pivot is None else np.asarray(rest, float) - pivot
        if radius <= 0.0 or not np.linalg.norm(arm) > 0.0:
            return cls(np.zeros(3), 0.0, np.eye(3))
        outward = arm / np.linalg.norm(arm)
        first = any_normal(outward)
        return cls(np.asarray(pivot, float), float(radius),
                   np.stack([first, np.cross(outward, first), outward]))

    @property
    def plain(self) -> "Chart":
        """The same without stretch: lengths along and off the shell are unchanged."""
        return replace(self, stretch=1.0, depth=np.inf)

    @cached_property
    def numbers(self) -> np.ndarray:
        """What the kernels read, shape [15]."""
        return np.hstack([self.pivot, self.radius, self.axes.ravel(), self.stretch, self.depth])

    def map(self, points: np.ndarray) -> np.ndarray:
        """Return chart coordinates [n, 3] of ``points`` [n, 3]."""
        points = for_kernels(points).reshape(-1, 3)
        flat = np.empty_like(points)
        _mapped(points, self.numbers, flat)
        return flat

    def curved(self, flat: np.ndarray) -> np.ndarray:
        """Return the points [n, 3] of coordinates [n, 3] of the plain chart."""
        if self.radius == 0.0:
            return flat
        angle = np.linalg.norm(flat[:, :2], axis=1) / self.radius
        part = np.sinc(angle / np.pi)[:, None] * flat[:, :2] / self.radius
        direction = np.column_stack([part, np.cos(angle)]) @ self.axes
        return self.pivot + (self.radius + flat[:, 2:]) * direction

    def pull_back(self, points: np.ndarray, gradients: np.ndarray) -> np.ndarray:
        """Return gradients to the point [n, 3], from those to the chart's coordinates [n, 3]."""
        return self._turned(points, gradients, False)

    def push_forward(self, points: np.ndarray, gradients: np.ndarray) -> np.ndarray:
        """Return gradients to the chart's coordinates from those to the point: the inverse."""
        return self._turned(points, gradients, True)

    def _turned(self, points: np.ndarray, gradients: np.ndarray, forward: bool) -> np.ndarray:
        if self.radius == 0.0:
            return gradients
        turned = np.empty(gradients.shape)
        _turned.of(points, gradients, self.numbers, turned, forward)
        return turned

    def growth(self, points: np.ndarray, reach: float) -> np.ndarray:
        """Return the largest change [n] of plain coordinates per metre within ``reach`` [m],
        infinite if pivot or opposite are within: singular values are 1, R / r, R t / (r sin t)."""
        if self.radius == 0.0:
            return np.ones(len(points))
        least, angle = self._within(points, reach)
        with np.errstate(divide="ignore", invalid="ignore"):
            most = self.radius / least * np.where(angle > 1e-6, angle / np.sin(angle), 1.0)
        return np.where(np.isnan(angle), np.inf, np.maximum(most, 1.0))

    def bend(self, points: np.ndarray, reach: float) -> np.ndarray:
        """Return the largest second derivative of plain coordinates along a line within ``reach``
        [m], [1/m], shape [n]; infinite as :meth:`growth`.

        For ``R t e`` along a straight line with the components ``a, b, c`` outward, along the
        meridian and the parallel (``a^2 + b^2 + c^2 = 1``) it is ``R / r^2`` times

            along e:   -2 a b - (t - sin t cos t) / sin^2 t  c^2
            across e:   2 b c (1 - t cot t) / sin t - 2 a c t / sin t,

        whose factors grow with ``t``; for ``r`` it is ``(b^2 + c^2) / r``. Each product of two
        components is at most a half.
        """
        if self.radius == 0.0:
            return np.zeros(len(points))
        least, angle = self._within(points, reach)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.maximum(angle, 1e-4)
            along = 1.0 + (t - np.sin(t) * np.cos(t)) / np.sin(t)**2
            across = (1.0 - t / np.tan(t)) / np.sin(t) + t / np.sin(t)
            most = np.hypot(self.radius / least**2 * np.hypot(along, across), 1.0 / least)
        return np.where(np.isnan(angle), np.inf, most)

    def _within(self, points: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the least distance from the pivot [m] and the largest angle from the outward axis
        [rad] within ``reach`` [m]; no angle (NaN) if the pivot or the point opposite is near."""
        local = (points - self.pivot) @ self.axes.T
        least = np.linalg.norm(local, axis=1) - reach
        safe = np.maximum(least, 1e-9)
        angle = np.arctan2(np.linalg.norm(local[:, :2], axis=1), local[:, 2])
        angle = np.minimum(angle + np.arcsin(np.minimum(reach / (safe + reach), 1.0)), np.pi)
        return safe, np.where((least <= 0.0) | (angle > 0.95 * np.pi), np.nan, angle)
