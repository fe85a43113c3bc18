"""Coordinates in which the energy of a branch is smoother: distance from the base, stretched.

A branch bends easily across and yields hardly along, so its energy changes several times faster
with the distance of the grasp from the base than with the direction. Radial functions know one
length scale only. They are therefore fitted in

    y = base + u (R + k (r - R)),    r = |x - base|,  u = (x - base) / r,

with ``R`` the distance at rest and ``k`` the stretch, chosen by held-out error: ``k = 1`` is no
change. On a generated branch (150 samples, 100 fresh poses) 2 took the error in the gentle valley
from 14 to 8 mJ and left it elsewhere.
"""

from dataclasses import dataclass

import numpy as np

from limber.compiled import compiled


@dataclass(frozen=True)
class Chart:
    """The map above; ``base`` [m] of shape [3], ``radius`` [m] and ``stretch``."""

    base: np.ndarray
    radius: float
    stretch: float = 1.0

    @property
    def arrays(self) -> tuple[np.ndarray, float, float]:
        """What the compiled functions take."""
        return np.asarray(self.base, float), float(self.radius), float(self.stretch)

    def map(self, points: np.ndarray) -> np.ndarray:
        """Return chart coordinates of ``points`` [n, 3]."""
        return _mapped(np.ascontiguousarray(points, float), *self.arrays)

    def pull_back(self, points: np.ndarray, gradients: np.ndarray) -> np.ndarray:
        """Return gradients to the point [n, 3] of those to the chart's coordinates [n, 3]."""
        along, across = self._factors(points)
        radial = self._radial_part(points, gradients)
        return across * gradients + (along - across) * radial

    def push_forward(self, points: np.ndarray, gradients: np.ndarray) -> np.ndarray:
        """Return gradients to the chart's coordinates of those to the point: the inverse."""
        along, across = self._factors(points)
        radial = self._radial_part(points, gradients)
        return gradients / across + (1.0 / along - 1.0 / across) * radial

    def _factors(self, points: np.ndarray) -> tuple[float, np.ndarray]:
        r = np.linalg.norm(points - self.base, axis=1, keepdims=True)
        r = np.maximum(r, 1e-9)
        return self.stretch, (self.radius + self.stretch * (r - self.radius)) / r

    def _radial_part(self, points: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        arm = points - self.base
        unit = arm / np.maximum(np.linalg.norm(arm, axis=1, keepdims=True), 1e-9)
        return unit * np.sum(unit * vectors, axis=1, keepdims=True)


@compiled
def mapped(point, base, radius, stretch):
    """Return the chart coordinates of one point [3]."""
    if stretch == 1.0:
        return point.copy()
    arm = point - base
    r = max(np.sqrt(np.sum(arm * arm)), 1e-9)
    return base + arm * ((radius + stretch * (r - radius)) / r)


@compiled
def _mapped(points, base, radius, stretch):
    out = np.empty_like(points)
    for i in range(len(points)):
        out[i] = mapped(points[i], base, radius, stretch)
    return out


@compiled
def pulled_back_size(point, gradient, base, radius, stretch):
    """Return the magnitude of one gradient [3] taken back to the point's coordinates."""
    if stretch == 1.0:
        return np.sqrt(np.sum(gradient * gradient))
    arm = point - base
    r = max(np.sqrt(np.sum(arm * arm)), 1e-9)
    across = (radius + stretch * (r - radius)) / r
    along = np.sum(arm * gradient) / r
    whole = np.sum(gradient * gradient)
    return np.sqrt(across * across * (whole - along * along) + stretch * stretch * along * along)
