"""What a sensor does to the points of a branch: it smooths them, and scatters them around it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import i0e, i1e

from limber.geometry.skeleton.radii.fit_kernels import mean_on_circle
from limber.geometry.skeleton.radii.visible_sides import SeenSides, sides_of
from limber.geometry.skeleton.skeleton import Skeleton

# How far a sensor's smoothing drew thin branches inwards, from the number of their points.
#
# A sensor that averages over neighbouring places, as stereo matching and the fusion of frames do,
# moves a curved surface towards its axis: a radius R is measured as R exp(-c (s / R)^2), with the
# spacing s of the points. Positions alone do not show this: the points of a smoothed twig lie on a
# thinner twig. But smoothing loses no point. Points are about evenly spread over the skin, so where
# thin branches have more points on an area than thick ones, their skin has shrunk.
#
# Often they hardly tell. Then a part is undone, and what is left open is an error of all radii of
# the scan together. How wood grows does not tell: over forks, where the pipe model foresees radii,
# the likelihoods of no and of most smoothing differed by less than two times on 16 of 19 scans.

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
    """What a sensor does to radii: the number c above, its standard deviation, and the points'
    spacing [m]."""

    shrink: float
    sigma: float
    spacing: float

    def undone(self, skeleton: Skeleton, covariance: np.ndarray) -> tuple[Skeleton, np.ndarray]:
        """The skeleton with radii before the smoothing of its sensor, and the covariance [n, 4, 4]
        of each node's position and radius [m^2]."""
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
    """Estimate how far a sensor's smoothing drew branches inwards, from their radii [n] [m] without
    scatter and the points on each node [n], which are ``spacing`` [m] apart."""
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


# Points scattered around a circle: the true position of each, given their scatter.
#
# A point's distance from the axis overestimates the radius where noise is not small against it.
# Points of a full circle lie too far out on average, and a fit to the half that one camera saw
# comes out a fifth too thin at a noise of half the radius. Both follow from taking the nearest
# position on the circle for the true one. The likelihood of the structural model instead averages
# over all positions that a point may come from, weighted by how much of each side was seen
# (Chernov: Circular and Linear Regression, 2010, chapter 6, has the models). Its gradient needs
# only the mean direction of these positions.

# Square of radius over noise from which positions are known to within 5 degrees; and to within one
# degree, where only one side was seen and its edges determine the radius.
_SHARP, _SHARP_SIDE = 150.0, 2500.0
_SIGHT_LEAST = 0.75
# Factor c in 1 + c (noise / radius)^2: the variance of a circle's fitted radius over that from
# sharp points. From Fisher's information of points with open positions, at 0.3 to 3 noises a
# radius, all around a circle and on half of one.
_OPEN_PART, _OPEN_SIDE = 1.0, 2.2
_RADII = np.geomspace(0.05, 12.0, 48)  # radii in standard deviations of the noise
_DISTANCES = 300


def position_uncertainty(seen: SeenSides, radius: np.ndarray, noise: float) -> np.ndarray:
    """Factor on a radius's standard deviation against points with known positions, shape [n]."""
    if seen.along_sight:
        return np.ones_like(radius)
    open_part = _OPEN_SIDE if seen.one_sided else _OPEN_PART
    return np.sqrt(1 + open_part * (noise / np.maximum(radius, 1e-300))**2)


@dataclass(frozen=True)
class TargetDistances:
    """Mean distance from the axis at which points should lie [m], shape [m] each, for the equations
    that move the axis and for those that move the radius."""

    axis: np.ndarray
    radius: np.ndarray


def weighted_target_distances(radius: np.ndarray, noise: float,
                              limit: Callable[[np.ndarray], np.ndarray],
                              ) -> tuple[TargetDistances, TargetDistances]:
    """Distances at which points should lie if those farther off count less, to 0 at the residual
    ``limit`` [m], a function of radii: where mean positions are taken for true, and the nearest."""
    # Noise puts more points outside a thin branch than inside, and farther. Falling weights
    # therefore reduce its radius: at one noise it came out at half, at two noises at nine tenths.
    # So the target is the weighted mean where the radius is right (consistency of M-estimates,
    # after Fisher). It holds for each position on the circle, whatever sides were seen.
    thick = _RADII[:, None]
    reach = limit(_RADII * noise)[:, None] / noise
    residual = reach * np.linspace(-1, 1, _DISTANCES)
    distance = np.maximum(thick + residual, 0.0)
    bessel = i0e(distance * thick)
    share = (1 - (residual / reach)**2)**2 * distance * bessel * np.exp(-residual**2 / 2)
    toward = i1e(distance * thick) / bessel  # mean cosine of the angle to the true position
    outward = (share * toward * distance).sum(axis=1)
    total = share.sum(axis=1)
    mean, near = outward / total, (share * distance).sum(axis=1) / total
    along = outward / (share * toward).sum(axis=1)

    def of(target: np.ndarray) -> np.ndarray:
        past = np.maximum(radius / (noise * _RADII[-1]), 1.0)
        return radius + noise * np.interp(radius / noise, _RADII, target - _RADII) / past

    return TargetDistances(of(mean), of(mean)), TargetDistances(of(along), of(near))


def held_across(out: np.ndarray, axis: np.ndarray, positions: np.ndarray, stout: np.ndarray,
                ) -> np.ndarray:
    """How firmly points hold the axis across their direction, as vectors [m, 3]: where noise hides
    their position on the circle, or the seen side ends. ``stout``: (radius / noise)^2."""
    # Without these terms, steps went twice as far as they should and back again: one-sided radii
    # came out right or a sixth too thin by turns.
    known = np.clip(1 - stout * (1 - np.einsum("mj,mj->m", positions, positions)), 0.0, 1.0)
    # A position that is taken as certain is not searched for.
    known[np.einsum("mj,mj->m", positions, out) >= 1 - 1e-12] = 0.0
    return np.sqrt(known)[:, None] * np.cross(axis, out)


def mean_positions(out: np.ndarray, axis: np.ndarray, sharpness: np.ndarray, stout: np.ndarray,
                   seen: SeenSides) -> np.ndarray:
    """Mean direction [m, 3] from the axis to points' true positions, below 1 where uncertain.
    ``sharpness`` is radius times distance / noise^2, ``stout`` is (radius / noise)^2."""
    mean = out * np.where(sharpness > 1, 1 - 0.5 / np.maximum(sharpness, 1.0), 0.5)[:, None]
    if seen.along_sight:
        # Scatter along the sight does not widen a silhouette: its effect on the radius is bounded.
        return out * np.clip(1 - 0.5 / np.maximum(sharpness, 1e-9), _SIGHT_LEAST, 1.0)[:, None]
    # By the radius alone: if also chosen by distance, near points would count differently from far
    # ones.
    blurred = np.flatnonzero(stout < (_SHARP_SIDE if seen.one_sided else _SHARP))
    side, cross = sides_of(axis[blurred], seen.view)
    cosine, sine = (np.einsum("mj,mj->m", out[blurred], axis_part) for axis_part in (side, cross))
    size = np.maximum(np.hypot(cosine, sine), 1e-300)
    circle_mean = mean_on_circle(cosine / size, sine / size, sharpness[blurred], seen.share)
    mean[blurred] = circle_mean[:, :1] * side + circle_mean[:, 1:] * cross
    return mean
