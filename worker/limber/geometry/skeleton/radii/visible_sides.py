"""Sides of the branches that a scan shows: all around, or one side up to a grazing limit."""

from dataclasses import dataclass

import numpy as np
from scipy.special import i0e

from limber.core.numerics.rigid import any_normal
from limber.geometry.skeleton.radii.fit_kernels import Match, reach_on_circle
from limber.geometry.skeleton.skeleton import Skeleton
from limber.kernels import Kernel

PLACES = 180  # positions on the circle, each with a weight
_CLEAR = 12.0  # concentration from which a point shows the sides that were seen
_ONE_SIDED = 0.3  # length of the mean normal above which only one side may have been seen
_BEHIND = np.deg2rad(115.0)  # angle to the viewer above which a side was not seen
_FEW = 0.12  # fraction of points that noise can put there
_FRONT, _EDGE = np.deg2rad(40.0), np.deg2rad(65.0)
_ALONG = 0.65  # scatter at the edges over that in front below which it is along the line of sight
# Beyond about this angle, no sensor sees a surface. Its exact value affects a radius where noise
# hides the arc's ends. Fitted circles with a limit 4 to 19 degrees off came out 0.8 to 1.1 % off
# per degree for noise over 0.12 of the radius, and proportionally less below.
_GRAZING, _GRAZING_SIGMA = np.deg2rad(81.0), np.deg2rad(4.0)
_GRAZING_MOVES, _ARC_HIDDEN = 0.55, 0.12  # fraction of the radius per radian; noise over radius
_LEAST_SEEN = 0.01
_RING_LOST = 12.0  # square of radius over noise below which a ring's centre is not seen as empty
_FLAT = 0.10  # relative difference of scatter across and along the line of sight of one side
_FLAT_SURE = 4.0  # standard deviations
# Third moment of an arc, of cos over its half-angle with sin squared, in cubes of the radius. Half
# of it distinguishes an arc from a shape that is flat but not bent, such as an elliptic stem.
_BENT, _BENT_LEAST, _BENT_SURE = 0.0913, 0.5, 2.0
_DIRECTIONS, _SAMPLE = 120, 2000
_ANGLE = 2 * np.pi * (np.arange(PLACES) + 0.5) / PLACES
_TELL = 20_000  # points used for the viewer's direction and the limit; more add nothing
_ASIDE = 0.5  # sine of the angle between axis and line of sight above which a point is used
_VIEW_SIGMA = np.deg2rad(12.0)  # standard deviation of the mean normal from the line of sight
_TURNS, _TURN = 4, 0.15  # direction steps in a round; largest step [rad]
_EASE = 0.6  # fraction of a step of the limit; axes and radii of the next round follow it
_FURTHER = np.deg2rad(3.0)  # largest extension: beyond the last point few scores limit it
# The points' angles fit the model worse than by chance, and their errors are correlated: this many
# of them carry as much information as one independent point.
_MISFIT = 3.0
# Radii to either side whose points show how evenly a side is seen; a radius counts as at least this
# many noises.
_WINDOW, _NOISY_WINDOW = 4.0, 2.0
_TELLING = 80  # points that must lie there
_ASKEW, _NARROW = 0.25, 0.33  # mean sine from the line of sight, and its square


@dataclass(frozen=True)
class SeenSides:
    """From which side the branches were seen.

    Attributes:
        view: Mean outward normal of the points: towards the camera where there was one, shape [3].
        share: Density of points over the positions of a cross-section, counted from the side that
            faces ``view``, shape [places].
        along_sight: Points scatter only along ``view``, as a depth camera's do.
        limit: Angle around the axis from ``view`` to the end of the side that was seen [rad].
    """

    view: np.ndarray
    share: np.ndarray
    along_sight: bool = False
    limit: float = np.pi
    limit_sigma: float = 0.0

    @property
    def one_sided(self) -> bool:
        """Whether some positions of a cross-section were not seen."""
        return bool(self.share.min() < 1.0)


SCATTERED_ALONG_SIGHT = SeenSides(np.array([0.0, 0.0, 1.0]), np.ones(PLACES), along_sight=True)
"""The sides seen by a depth camera; its direction does not affect positions then."""


def seen_sides(out: np.ndarray, axis: np.ndarray, residual: np.ndarray, sharpness: np.ndarray,
               stout: np.ndarray, weight: np.ndarray) -> SeenSides:
    """Determine whether points show branches from all around or from one side. ``sharpness`` is
    radius times distance over noise^2, ``stout`` (radius / noise)^2."""
    # A depth camera's readings scatter along its sight and show where a silhouette ends: all of
    # their positions are known. Estimated as a density, the seen sides would grow with the noise
    # that blurs them: a thin ring with points all around it looks like half of a thicker one. Where
    # noise fills the ring, an axis in the middle of half a circle also has points all around it.
    # There the cross-section's scatter decides: for a full circle it is equal in all directions.
    around = SeenSides(np.array([0.0, 0.0, 1.0]), np.ones(PLACES))
    clear = np.flatnonzero((sharpness > min(_CLEAR, float(np.quantile(sharpness, 0.7))))
                           & (weight > 0))
    view = out[clear].mean(axis=0) if len(clear) else np.zeros(3)
    size = float(np.linalg.norm(view))
    if size < _ONE_SIDED:
        return _flat_side(out, axis, sharpness, stout, weight) or around
    side, _ = sides_of(axis[clear], view / size)
    facing = np.einsum("mj,mj->m", out[clear], side)
    if np.mean(facing < np.cos(_BEHIND)) > _FEW:
        return _flat_side(out, axis, sharpness, stout, weight) or around
    front, edge = (np.abs(residual[clear[chosen]]) for chosen in (
        facing > np.cos(_FRONT), facing < np.cos(_EDGE)))
    if len(front) and len(edge) and np.median(edge) < _ALONG * np.median(front):
        return SeenSides(view / size, around.share, along_sight=True)
    return _one_side(view / size)


def _one_side(view: np.ndarray, limit: float = _GRAZING, sigma: float = _GRAZING_SIGMA,
              ) -> SeenSides:
    angle = np.minimum(_ANGLE, 2 * np.pi - _ANGLE)
    width = 2 * np.pi / PLACES
    share = np.clip((limit - angle) / width + 0.5, _LEAST_SEEN, 1.0)
    return SeenSides(view, share, limit=limit, limit_sigma=sigma)


def _flat_side(out: np.ndarray, axis: np.ndarray, sharpness: np.ndarray, stout: np.ndarray,
               weight: np.ndarray) -> SeenSides | None:
    """One side, if noise fills the rings and points scatter less along one sight than across it: at
    84 degrees 0.08 radius^2, the variance of cos, and 0.46, that of sin. Noise adds equally to
    both, and nothing to the third moment, which a flat stem lacks."""
    near = np.flatnonzero(weight > 0)
    if len(near) == 0:
        return None
    thick = near[stout[near] >= np.median(stout[near])]
    if np.median(stout[thick]) > _RING_LOST:
        return None
    thick = thick[::max(len(thick) // _SAMPLE, 1)]
    # In units of the noise: distance = sharpness / (radius / noise).
    offset = out[thick] * (sharpness[thick] / np.sqrt(stout[thick]))[:, None]
    views = _half_sphere()
    mean, sure, share = flatness(axis[thick], offset, views)
    share[(share <= _FLAT) | (mean <= _FLAT_SURE * sure)] = 0.0
    if not share.any():
        return None
    view = views[int(np.argmax(share))]
    along, across = (np.einsum("mj,mj->m", offset, one) for one in sides_of(axis[thick], view))
    # An arc's ends lie back from the viewer.
    bent = (along - along.mean()) * (across**2 - np.mean(across**2))
    least = _BENT_LEAST * _BENT * float(np.mean(stout[thick]**1.5))
    if abs(bent.mean()) + _BENT_SURE * bent.std() / np.sqrt(len(bent)) < least:
        return None
    return _one_side(view if bent.mean() < 0 else -view)


_flatness = Kernel(
    "flatness", "axis float64[points, 3]", "offset float64[points, 3]", "views float64[views, 3]",
    "out mean float64[views]", "out sure float64[views]", "out share float64[views]")


def flatness(axis: np.ndarray, offset: np.ndarray, views: np.ndarray,
              ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """By how much the squares of offsets [m, 3] across their axes [m, 3] are larger across each of
    k views [k, 3] than along it: their mean, its standard deviation, and its fraction, [k] each."""
    found = np.empty(len(views)), np.empty(len(views)), np.empty(len(views))
    _flatness.of(axis, offset, views, *found)
    return found


def _half_sphere() -> np.ndarray:
    """Directions evenly over half a sphere (Fibonacci's lattice), shape [directions, 3]."""
    index = np.arange(_DIRECTIONS) + 0.5
    height = index / _DIRECTIONS
    turn = np.pi * (1 + np.sqrt(5)) * index
    flat = np.sqrt(1 - height**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)


def fit_seen_side(out: np.ndarray, axis: np.ndarray, sharpness: np.ndarray, weight: np.ndarray,
                  mean: np.ndarray, first: SeenSides, limit_free: bool = True) -> SeenSides:
    """Estimate sight and limit of one seen side from the points' angles by Fisher scoring; the
    limit takes a step a call, if ``limit_free``. ``sharpness`` is radius times distance /
    noise^2."""
    # The mean normal is off where a scan has holes or branches lean (by 23 degrees at most in
    # generated ones), and the last grazing angle depends on the sensor. For a point at a given
    # distance, the angle is that of its true position, blurred by a von Mises distribution: the
    # density over the seen side determines both. The mean normal is the sight's prior: with
    # parallel axes, no angle shows a turn along them.
    use = np.flatnonzero(weight > 0)
    use = use[::max(len(use) // _TELL, 1)]
    out, axis, sharpness, weight = out[use], axis[use], sharpness[use], weight[use]
    if not weight.sum() > 0:
        return first
    bessel, view = i0e(sharpness), first.view
    prior = _VIEW_SIGMA**-2 * np.eye(2)
    for _ in range(_TURNS):
        score, information = _score_and_information(out, axis, sharpness, bessel, weight, view,
                                                    first.limit)
        score[:2] += _across(view).T @ mean / _VIEW_SIGMA**2
        turns = np.linalg.solve(information[:2, :2] + prior, score[:2])
        turns *= min(1.0, _TURN / max(float(np.linalg.norm(turns)), 1e-300))
        view = view + _across(view) @ turns
        view = view / np.linalg.norm(view)
    if not limit_free:
        return _one_side(view, first.limit, first.limit_sigma)
    score, information = _score_and_information(out, axis, sharpness, bessel, weight, view,
                                                first.limit)
    held = np.linalg.solve(information[:2, :2] + prior, information[:2, 2])
    known = max(float(information[2, 2] - information[:2, 2] @ held), 0.0)
    precision = known + _GRAZING_SIGMA**-2
    step = (score[2] - score[:2] @ held
            - (first.limit - _GRAZING) / _GRAZING_SIGMA**2) / precision
    limit = first.limit + float(np.clip(_EASE * step, -_FURTHER, _FURTHER))
    return _one_side(view, limit, precision**-0.5)


def _score_and_information(out: np.ndarray, axis: np.ndarray, sharpness: np.ndarray,
                           bessel: np.ndarray,
                           weight: np.ndarray, view: np.ndarray, limit: float) -> tuple[np.ndarray,
                                                                                        np.ndarray]:
    """Score and information of the points in the two turns of the view and the limit."""
    side, cross = sides_of(axis, view)
    aside = np.einsum("mj,mj->m", side, np.broadcast_to(view, side.shape))
    angle = np.arctan2(np.einsum("mj,mj->m", out, cross), np.einsum("mj,mj->m", out, side))
    _, by_angle, by_limit = reach_on_circle(angle, sharpness, bessel, limit, _LEAST_SEEN)
    by_limit -= (1 - _LEAST_SEEN) / (limit * (1 - _LEAST_SEEN) + np.pi * _LEAST_SEEN)
    turned = cross @ _across(view) / np.maximum(aside, _ASIDE)[:, None]
    own = np.column_stack([-by_angle[:, None] * turned, by_limit])
    counts = weight * (aside > _ASIDE) / _MISFIT
    return counts @ own, (counts[:, None] * own).T @ own


def _across(view: np.ndarray) -> np.ndarray:
    """Two unit vectors orthogonal to the view and to each other, shape [3, 2]."""
    other = any_normal(view)
    return np.stack([other, np.cross(view, other)], axis=1)


def side_uncertainty(seen: SeenSides, radius: np.ndarray, noise: float) -> np.ndarray:
    """Standard deviation of radii [m] from the uncertain end of the seen side, shape [n]."""
    if not seen.one_sided:
        return np.zeros_like(radius)
    hidden = np.minimum(noise / np.maximum(radius, 1e-300) / _ARC_HIDDEN, 1.0)
    return _GRAZING_MOVES * seen.limit_sigma * hidden * radius


def across_sight(out: np.ndarray, axis: np.ndarray, seen: SeenSides) -> np.ndarray:
    """Sine of the angle around the axis between points and the viewer of one side, shape [m]."""
    return np.einsum("mj,mj->m", out, sides_of(axis, seen.view)[1])


def sides_of(axis: np.ndarray, view: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors across each axis: towards the viewer, and across both, shape [m, 3] each."""
    side = view - (axis @ view)[:, None] * axis
    size = np.linalg.norm(side, axis=1)
    other = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
    other = other - np.einsum("mj,mj->m", other, axis)[:, None] * axis
    side = np.where((size > 1e-6)[:, None], side, other)
    side /= np.linalg.norm(side, axis=1)[:, None]
    return side, np.cross(axis, side)


def evenly_seen(skeleton: Skeleton, nodes: np.ndarray, radius: np.ndarray, match: Match,
                weight: np.ndarray, across: np.ndarray, noise: float) -> np.ndarray:
    """Mask [n] of the nodes with enough points around them that show all of the seen side."""
    # Weights by the sides that were seen make a cylinder as thin as a strip is wide, where the rest
    # is hidden or points are few. Started from the truth, twigs with under 7 points a radius of
    # length shrank to 0.8 of theirs, and hidden stems to a third. There the nearest positions are
    # the better estimate (0.95). Where noise is as wide as the branch, they carry little
    # information, and points from farther along are used.
    sums = np.stack([np.bincount(match.segment, weight * value, len(nodes))
                     for value in (np.ones(len(across)), across, across**2)], axis=1)
    even = np.zeros(len(nodes), bool)
    for own in skeleton.own_runs():
        step = np.linalg.norm(nodes[own] - nodes[np.maximum(skeleton.parent[own], 0)], axis=1)
        along, total = np.cumsum(step), np.vstack([np.zeros(3), np.cumsum(sums[own], axis=0)])
        reach = _WINDOW * np.maximum(radius[own], _NOISY_WINDOW * noise)
        first = np.searchsorted(along, along - reach, "left")
        last = np.searchsorted(along, along + reach, "right")
        count, mean, square = (total[last] - total[first]).T
        even[own] = (count > _TELLING) & (np.abs(mean) < _ASKEW * count) & (
            square > _NARROW * count)
    return even
