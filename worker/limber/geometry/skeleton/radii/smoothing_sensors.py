"""How far a sensor's smoothing drew thin branches inwards, from the number of their points.

A sensor that averages over neighbouring places, as stereo matching and the fusion of frames do,
moves a curved surface towards its axis: a radius R is measured as R exp(-c (s / R)^2), with the
spacing s of the points. Positions alone do not show this: the points of a smoothed twig lie on a
thinner twig. But smoothing loses no point. Points are about evenly spread over the skin, so where
thin branches have more points on an area than thick ones, their skin has shrunk.

Often they hardly tell. Then a part is undone, and what is left open is an error of all radii of the
scan together. How wood grows does not tell: over forks, where the pipe model foresees radii, the
likelihoods of no and of most smoothing differed by less than two times on 16 of 19 scans.
"""

from dataclasses import dataclass, replace

import numpy as np

from limber.geometry.skeleton.skeleton import Skeleton

# Prior probability that a sensor smooths: of those that see a plant from all around (stations, hand
# scanners, photogrammetry), one in three does.
_SMOOTHED = 1 / 3
_MOST, _STEPS = 0.4, 41  # largest c, and values of it
_POWER_SIGMA = 0.1  # deviation of the power of the radius by which density on the skin may differ
_POINTS, _LEAST = 12, 12  # points of a stretch; thick stretches that tell
_STOUT = 1 / 3  # fraction of the points on these, at least
_ALIKE = 3.0  # stretches whose density is alike, so that they count as one
_FREEDOM, _ROUNDS = 4.0, 12  # Student's distribution of a stretch's density, and its fit
_TURNS = 8  # of Newton's method


@dataclass(frozen=True)
class Smoothing:
    """What a sensor does to radii.

    Attributes:
        shrink: The number c above.
        sigma: Its standard deviation.
        spacing: Spacing of the points [m].
    """

    shrink: float
    sigma: float
    spacing: float

    def undone(self, skeleton: Skeleton, covariance: np.ndarray) -> tuple[Skeleton, np.ndarray]:
        """The skeleton with radii before the smoothing of its sensor, and its covariance [m^2].

        Args:
            skeleton: With radii as measured.
            covariance: Of each node's position and radius [m^2], shape [n, 4, 4].
        """
        radius = _undone(skeleton.radius, self.shrink, self.spacing)
        change = radius / skeleton.radius * self._slope(radius)
        scale = np.ones((len(radius), 4))
        scale[:, 3] = change
        return (replace(skeleton, radius=radius, radius_sigma=change * skeleton.radius_sigma),
                covariance * scale[:, :, None] * scale[:, None, :])

    def drawn_in(self, radius: np.ndarray) -> np.ndarray:
        """True radii [m] as the sensor measures them [m], shape [n]."""
        return radius * np.exp(-self.shrink * (self.spacing / radius)**2)

    def uncertainty(self, radius: np.ndarray) -> np.ndarray:
        """Standard deviation of the logarithm of true radii [m], shape [n]."""
        return self.sigma * (self.spacing / radius)**2 * self._slope(radius)

    def _slope(self, radius: np.ndarray) -> np.ndarray:
        """Change of the logarithm of true radii [m] with that of measured ones, shape [n]."""
        return 1 / (1 + 2 * self.shrink * (self.spacing / radius)**2)


def sensor_smoothing(skeleton: Skeleton, radius: np.ndarray, count: np.ndarray, spacing: float,
                     ) -> Smoothing:
    """Estimate how far a sensor's smoothing drew the branches inwards.

    Args:
        skeleton: Fitted.
        radius: Its radii [m] without their scatter, shape [n].
        count: Number of points on each node, shape [n].
        spacing: Spacing of the points [m].
    """
    stretch = _stretches(skeleton, count)
    points, length = np.bincount(stretch, count), np.bincount(stretch, skeleton.steps)
    thick = np.exp(np.bincount(stretch, np.log(radius)) / np.maximum(np.bincount(stretch), 1))
    told = (points >= _POINTS) & (length > 0)
    # The density on the skin is that of branches that hardly shrink; without them it is not known.
    stout = told & (thick > spacing)
    if stout.sum() < _LEAST or points[stout].sum() < _STOUT * points[told].sum():
        return Smoothing(0.0, 0.0, spacing)
    dense = np.log(points[told] / length[told])
    shrink = np.linspace(0.0, _MOST, _STEPS)
    fit = np.array([_likelihood(dense, np.log(_undone(thick[told], each, spacing)))
                    for each in shrink]) / _ALIKE
    share = np.exp(fit - fit.max()) * np.where(
        shrink == 0, 1 - _SMOOTHED, _SMOOTHED / (_STEPS - 1))
    share /= share.sum()
    mean = float(share @ shrink)
    return Smoothing(mean, float(np.sqrt(share @ (shrink - mean)**2)), spacing)


def _undone(radius: np.ndarray, shrink: float, spacing: float) -> np.ndarray:
    """The root R [m] of R exp(-shrink (spacing / R)^2) = radius [m], shape [n]."""
    if shrink == 0:
        return radius
    # In q = (spacing / R)^2: ln q / 2 + shrink q = ln(spacing / radius), which is concave in q.
    start = (spacing / radius)**2
    goal, q = np.log(spacing / radius), start / (1 + 2 * shrink * start)
    for _ in range(_TURNS):
        step = (goal - np.log(q) / 2 - shrink * q) / (0.5 / q + shrink)
        q = np.maximum(q + step, 0.1 * q)
    return spacing / np.sqrt(q)


def _stretches(skeleton: Skeleton, count: np.ndarray) -> np.ndarray:
    """A number for each node: neighbouring nodes of a run that have enough points, shape [n]."""
    stretch, last = np.zeros(skeleton.node_count, np.int64), 0
    for own in skeleton.own_runs():
        total = np.cumsum(count[own])
        stretch[own] = last + (total - count[own]) // _POINTS
        last = int(stretch[own].max()) + 1
    return stretch


def _likelihood(dense: np.ndarray, thick: np.ndarray) -> float:
    """Log-likelihood of points per length, given radii (logarithms both), shape [k]."""
    y, x = dense - thick, thick - thick.mean()
    weight, scatter, mean, power = np.ones(len(y)), float(np.var(y)) + 1e-6, 0.0, 0.0
    for _ in range(_ROUNDS):
        total = weight.sum()
        held = scatter / _POWER_SIGMA**2
        middle, off = weight @ x / total, weight @ y / total
        power = float(weight * (x - middle) @ (y - off)) / (
            float(weight @ (x - middle)**2) + held * _ALIKE)
        mean = off - power * middle
        square = (y - mean - power * x)**2
        scatter = float(weight @ square) / len(y) + 1e-6
        weight = (_FREEDOM + 1) / (_FREEDOM + square / scatter)
    return float(-(_FREEDOM + 1) / 2 * np.log1p(square / scatter / _FREEDOM).sum()
                 - len(y) / 2 * np.log(scatter) - _ALIKE * power**2 / (2 * _POWER_SIGMA**2))
