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

import numpy as np

from limber.core.numerics.compiled import compiled
from limber.core.numerics.rigid import any_normal


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

    @property
    def arrays(self) -> tuple[np.ndarray, float, np.ndarray, float, float]:
        """Arguments of the compiled functions after the point."""
        return self.pivot, self.radius, self.axes, float(self.stretch), float(self.depth)

    def map(self, points: np.ndarray) -> np.ndarray:
        """Return chart coordinates [n, 3] of ``points`` [n, 3]."""
        return _mapped(np.ascontiguousarray(points, float).reshape(-1, 3), *self.arrays)

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
        return _turned(np.ascontiguousarray(points, float),
                       np.ascontiguousarray(gradients, float), forward, *self.arrays)

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


@compiled
def mapped(point, pivot, radius, axes, stretch, depth):
    """Return the chart coordinates of one point [3]."""
    if radius == 0.0:
        return point.copy()
    out = np.empty(3)
    for k in range(3):
        out[k] = 0.0
        for j in range(3):
            out[k] += axes[k, j] * (point[j] - pivot[j])
    rho = np.sqrt(out[0] * out[0] + out[1] * out[1])
    off = np.sqrt(rho * rho + out[2] * out[2]) - radius
    part = radius / out[2] if rho < 1e-12 else radius * np.arctan2(rho, out[2]) / rho
    out[0] *= part
    out[1] *= part
    out[2] = stretch * off / np.sqrt(np.sqrt(1.0 + (off / depth) ** 2))
    return out


@compiled
def _mapped(points, pivot, radius, axes, stretch, depth):
    out = np.empty_like(points)
    for i in range(len(points)):
        out[i] = mapped(points[i], pivot, radius, axes, stretch, depth)
    return out


@compiled
def _turned(points, gradients, forward, pivot, radius, axes, stretch, depth):
    out = np.zeros_like(gradients)
    local, own, other = np.empty(3), np.empty(3), np.empty(3)
    for n in range(len(points)):
        for k in range(3):
            local[k] = 0.0
            own[k] = gradients[n, k]
            for j in range(3):
                local[k] += axes[k, j] * (points[n, j] - pivot[j])
        if forward:
            for k in range(3):
                own[k] = 0.0
                for j in range(3):
                    own[k] += axes[k, j] * gradients[n, j]
        rho = max(np.sqrt(local[0] * local[0] + local[1] * local[1]), 1e-12)
        r = np.sqrt(rho * rho + local[2] * local[2])
        x, y, sine, cosine = local[0] / rho, local[1] / rho, rho / r, local[2] / r
        square = ((r - radius) / depth) ** 2
        meridian, parallel = radius / r, radius * np.arctan2(rho, local[2]) / rho
        outward = stretch * (1.0 + 0.5 * square) / (1.0 + square) ** 1.25
        # Components along the meridian, along the parallel and outward, at both ends.
        across = x * own[0] + y * own[1]
        aside = x * own[1] - y * own[0]
        if forward:
            along = (cosine * across - sine * own[2]) / meridian
            aside /= parallel
            other[2] = (sine * across + cosine * own[2]) / outward
            other[0], other[1] = x * along - y * aside, y * along + x * aside
            for k in range(3):
                out[n, k] = other[k]
            continue
        along, aside, off = across * meridian, aside * parallel, own[2] * outward
        out_across = cosine * along + sine * off
        other[0], other[1] = x * out_across - y * aside, y * out_across + x * aside
        other[2] = cosine * off - sine * along
        for k in range(3):
            for j in range(3):
                out[n, k] += axes[j, k] * other[j]
    return out


@compiled
def pulled_back_size(point, gradient, pivot, radius, axes, stretch, depth):
    """Return the magnitude of one gradient [3] taken back to the point's coordinates."""
    whole = np.sum(gradient * gradient)
    if radius == 0.0:
        return np.sqrt(whole)
    local = np.empty(3)
    for k in range(3):
        local[k] = 0.0
        for j in range(3):
            local[k] += axes[k, j] * (point[j] - pivot[j])
    rho = max(np.sqrt(local[0] * local[0] + local[1] * local[1]), 1e-12)
    r = np.sqrt(rho * rho + local[2] * local[2])
    square = ((r - radius) / depth) ** 2
    along = gradient[2] * stretch * (1.0 + 0.5 * square) / (1.0 + square) ** 1.25
    meridian = (gradient[0] * local[0] + gradient[1] * local[1]) / rho
    side = max(whole - gradient[2] * gradient[2] - meridian * meridian, 0.0)
    turn = radius * np.arctan2(rho, local[2]) / rho
    return np.sqrt(along * along + (meridian * radius / r) ** 2 + side * turn * turn)
