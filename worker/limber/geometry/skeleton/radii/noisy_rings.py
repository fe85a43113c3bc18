"""Points scattered around a circle: where on it each one belongs, given how far they scatter.

A point's distance from the axis says too much of the radius where noise is no longer small against
it: points of a full circle lie too far out on average, and a fit to the half that one camera saw
comes out a fifth too thin at a noise of half the radius. Both follow from taking the nearest place
on the circle for the true one. The likelihood of the structural model instead averages over all
places that a point may come from, weighted by how much of each side was seen (Chernov: Circular and
Linear Regression, 2010, chapter 6, has the models); its gradient needs the mean direction of these
places alone."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import i0e, i1e

from limber.geometry.skeleton.radii.fit_kernels import mean_on_circle

_PLACES = 180  # on the circle, of which each is weighed
# Square of radius over noise from which places are known to within 5 degrees; and where one side
# alone was seen, and its edges tell the radius, to within one.
_SHARP, _SHARP_SIDE = 150.0, 2500.0
_CLEAR = 12.0  # concentration from which a point tells which sides were seen
_ONE_SIDED = 0.3  # length of the mean normal, from which one side may be all that was seen
_BEHIND = np.deg2rad(115.0)  # angle to the viewer from which a side was not seen
_FEW = 0.12  # share of points there that noise can put
_FRONT, _EDGE = np.deg2rad(40.0), np.deg2rad(65.0)
_ALONG = 0.65  # scatter at the edges over that in front, under which it is along the sight alone
_SIGHT_LEAST = 0.75
# Beyond about that no sensor sees a surface. Which it is moves a radius where noise hides the arc's
# ends: fitted circles whose limit was another by 4 to 19 degrees came out 0.8 to 1.1 % off a degree
# for noise over 0.12 of the radius, and in proportion less below.
_GRAZING, _GRAZING_SIGMA = np.deg2rad(81.0), np.deg2rad(4.0)
_GRAZING_MOVES, _ARC_HIDDEN = 0.55, 0.12  # share of the radius a radian; noise over radius
_LEAST_SEEN = 0.01
# Of a circle's fitted radius, the variance over that which sharp points leave is 1 + so many times
# (noise / radius)^2: Fisher's information of points with open places, at 0.3 to 3 noises a radius,
# all around a circle and on half of one.
_OPEN_PLACES, _OPEN_SIDE = 1.0, 2.2
_RING_LOST = 12.0  # square of radius over noise, under which a ring's middle is not seen empty
_FLAT = 0.10  # relative difference of scatter across and along the sight that is one side's
_FLAT_SURE = 4.0  # standard deviations
# Third moment of an arc, of cos over its half-angle with sin squared, in cubes of the radius; half
# of it tells an arc from what is flat but not bent, as an elliptic stem is.
_BENT, _BENT_LEAST, _BENT_SURE = 0.0913, 0.5, 2.0
_DIRECTIONS, _SAMPLE = 120, 2000
_RADII = np.geomspace(0.05, 12.0, 48)  # in standard deviations of the noise, up to where it tells
_DISTANCES = 300
_ANGLE = 2 * np.pi * (np.arange(_PLACES) + 0.5) / _PLACES


@dataclass(frozen=True)
class SeenSides:
    """From which side the branches were seen.

    Attributes:
        view: Mean outward normal of the points: towards the camera where there was one, shape [3].
        share: Density of points over the places of a cross-section, from the side that faces
            ``view`` around, shape [places].
        along_sight: Points scatter along ``view`` alone, as a depth camera's do.
    """

    view: np.ndarray
    share: np.ndarray
    along_sight: bool = False

    @property
    def one_sided(self) -> bool:
        """Whether some places of a cross-section were not seen."""
        return bool(self.share.min() < 1.0)


SCATTERED_ALONG_SIGHT = SeenSides(np.array([0.0, 0.0, 1.0]), np.ones(_PLACES), along_sight=True)
"""What a depth camera is known to have seen; from where does not matter to places then."""


def seen_sides(out: np.ndarray, axis: np.ndarray, residual: np.ndarray, sharpness: np.ndarray,
               stout: np.ndarray, weight: np.ndarray) -> SeenSides:
    """Tell whether points show branches from all around or from one side.

    A depth camera's readings scatter along its sight, and say where a silhouette ends: none of
    their places is open.

    Estimated as a density, the sides that were seen would grow with the noise that blurs them: a
    thin ring with points all around it looks like half of a thicker one. So it is one of the two.
    Where noise fills the ring, an axis in the middle of half a circle has points all around it too;
    there the cross-section's scatter decides, which is as wide in all directions of a full one.

    Args:
        out: Unit vectors from the axis to the points, shape [m, 3].
        axis: Unit vectors along the axis at each, shape [m, 3].
        residual: Distance of each point from its cylinder [m], shape [m].
        sharpness: Radius times distance over the noise's square, shape [m].
        stout: Square of radius over noise, shape [m].
        weight: How far each counts, shape [m].
    """
    around = SeenSides(np.array([0.0, 0.0, 1.0]), np.ones(_PLACES))
    clear = np.flatnonzero((sharpness > min(_CLEAR, float(np.quantile(sharpness, 0.7))))
                           & (weight > 0))
    view = out[clear].mean(axis=0) if len(clear) else np.zeros(3)
    size = float(np.linalg.norm(view))
    if size < _ONE_SIDED:
        return _flat_side(out, axis, sharpness, stout, weight) or around
    side, _ = _sides(axis[clear], view / size)
    facing = np.einsum("mj,mj->m", out[clear], side)
    if np.mean(facing < np.cos(_BEHIND)) > _FEW:
        return _flat_side(out, axis, sharpness, stout, weight) or around
    front, edge = (np.abs(residual[clear[chosen]]) for chosen in (
        facing > np.cos(_FRONT), facing < np.cos(_EDGE)))
    if len(front) and len(edge) and np.median(edge) < _ALONG * np.median(front):
        return SeenSides(view / size, around.share, along_sight=True)
    return _one_side(view / size)


def _one_side(view: np.ndarray) -> SeenSides:
    angle = np.minimum(_ANGLE, 2 * np.pi - _ANGLE)
    width = 2 * np.pi / _PLACES
    return SeenSides(view, np.clip((_GRAZING - angle) / width + 0.5, _LEAST_SEEN, 1.0))


def _flat_side(out: np.ndarray, axis: np.ndarray, sharpness: np.ndarray, stout: np.ndarray,
               weight: np.ndarray) -> SeenSides | None:
    """One side, if noise fills the rings and points scatter less along one sight than across it.

    Of an arc of half-angle g, the variance along the sight is that of cos over (-g, g), 0.08 of
    the radius's square at 84 degrees, and across it that of sin, 0.46. Noise adds to both alike,
    and nothing to the third moment, which a flat stem seen from all around does not have.
    """
    near = np.flatnonzero(weight > 0)
    if len(near) == 0:
        return None
    thick = near[stout[near] >= np.median(stout[near])]
    if np.median(stout[thick]) > _RING_LOST:
        return None
    thick = thick[::max(len(thick) // _SAMPLE, 1)]
    # In units of the noise: distance = sharpness / (radius / noise).
    offset = out[thick] * (sharpness[thick] / np.sqrt(stout[thick]))[:, None]
    best, flat = None, 0.0
    for view in _half_sphere():
        side, cross = _sides(axis[thick], view)
        along, across = (np.einsum("mj,mj->m", offset, one) for one in (side, cross))
        difference = across**2 - along**2
        share = float(difference.mean() / (across**2 + along**2).mean())
        if share > max(flat, _FLAT) and difference.mean() > _FLAT_SURE * difference.std() / np.sqrt(
                len(thick)):
            best, flat = (view, along, across), share
    if best is None:
        return None
    view, along, across = best
    # An arc's ends lie back from the viewer.
    bent = (along - along.mean()) * (across**2 - np.mean(across**2))
    wanted = _BENT_LEAST * _BENT * float(np.mean(stout[thick]**1.5))
    if abs(bent.mean()) + _BENT_SURE * bent.std() / np.sqrt(len(bent)) < wanted:
        return None
    return _one_side(view if bent.mean() < 0 else -view)


def _half_sphere() -> np.ndarray:
    """Directions evenly over half a sphere (Fibonacci's lattice), shape [directions, 3]."""
    place = np.arange(_DIRECTIONS) + 0.5
    height = place / _DIRECTIONS
    turn = np.pi * (1 + np.sqrt(5)) * place
    flat = np.sqrt(1 - height**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)


def side_doubt(seen: SeenSides, radius: np.ndarray, noise: float) -> np.ndarray:
    """Standard deviation of radii [m] from not knowing where the seen side ends, shape [n]."""
    if not seen.one_sided:
        return np.zeros_like(radius)
    hidden = np.minimum(noise / np.maximum(radius, 1e-300) / _ARC_HIDDEN, 1.0)
    return _GRAZING_MOVES * _GRAZING_SIGMA * hidden * radius


def place_doubt(seen: SeenSides, radius: np.ndarray, noise: float) -> np.ndarray:
    """Times as large as of points with known places a radius's standard deviation is, shape [n]."""
    if seen.along_sight:
        return np.ones_like(radius)
    open_places = _OPEN_SIDE if seen.one_sided else _OPEN_PLACES
    return np.sqrt(1 + open_places * (noise / np.maximum(radius, 1e-300))**2)


@dataclass(frozen=True)
class Aims:
    """How far from the axis points should lie on average [m], shape [m] each.

    Attributes:
        axis: As what moves the axis has them.
        radius: As what moves the radius has them.
    """

    axis: np.ndarray
    radius: np.ndarray


def weighted_aims(radius: np.ndarray, noise: float,
                  limit: Callable[[np.ndarray], np.ndarray]) -> tuple[Aims, Aims]:
    """How far out points should lie of whom the farther ones count less.

    Noise puts more points outside of a thin branch than inside, and farther: weights that fall with
    the distance from the surface take so much from its radius that at one noise it came out at half
    of it, and at two noises at nine tenths. What is asked of points is therefore what they come to
    with those weights where the radius is right (the consistency of M-estimates, after Fisher).
    Whichever sides were seen, that is the same: it holds for each place on the circle by itself.

    Args:
        radius: True one of each point [m], shape [m].
        noise: Standard deviation of the points [m].
        limit: Residual [m] from which a point has no weight (Tukey's biweight), of radii [m].

    Returns:
        Where mean places are taken for the true ones, and where the nearest are.
    """
    thick = _RADII[:, None]
    reach = limit(_RADII * noise)[:, None] / noise
    residual = reach * np.linspace(-1, 1, _DISTANCES)
    distance = np.maximum(thick + residual, 0.0)
    bessel = i0e(distance * thick)
    share = (1 - (residual / reach)**2)**2 * distance * bessel * np.exp(-residual**2 / 2)
    toward = i1e(distance * thick) / bessel  # mean cosine of the angle to the true place
    outward = (share * toward * distance).sum(axis=1)
    total = share.sum(axis=1)
    mean, near = outward / total, (share * distance).sum(axis=1) / total
    along = outward / (share * toward).sum(axis=1)

    def of(aim: np.ndarray) -> np.ndarray:
        past = np.maximum(radius / (noise * _RADII[-1]), 1.0)
        return radius + noise * np.interp(radius / noise, _RADII, aim - _RADII) / past

    return Aims(of(mean), of(mean)), Aims(of(along), of(near))


def held_across(out: np.ndarray, axis: np.ndarray, place: np.ndarray, stout: np.ndarray,
                ) -> np.ndarray:
    """How firmly points hold the axis across their own direction, as vectors, shape [m, 3].

    A point whose place is known along the circle says nothing of that; where noise hides it, or
    the seen side ends, it does. Left out of the equations, their steps went twice as far as they
    should and back again: one-sided radii came out right or a sixth too thin by turns.

    Args:
        out: Unit vectors from the axis to the points, shape [m, 3].
        axis: Unit vectors along the axis at each, shape [m, 3].
        place: Mean direction of each point's true place, shape [m, 3].
        stout: Square of radius over noise, shape [m].
    """
    known = np.clip(1 - stout * (1 - np.einsum("mj,mj->m", place, place)), 0.0, 1.0)
    # A place that is taken for certain is one that is not looked for.
    known[np.einsum("mj,mj->m", place, out) >= 1 - 1e-12] = 0.0
    return np.sqrt(known)[:, None] * np.cross(axis, out)


def mean_places(out: np.ndarray, axis: np.ndarray, sharpness: np.ndarray, stout: np.ndarray,
                seen: SeenSides) -> np.ndarray:
    """Return the mean direction from the axis to each point's true place, shape [m, 3].

    Shorter than 1 by how much the place is open.

    Args:
        out: Unit vectors from the axis to the points, shape [m, 3].
        axis: Unit vectors along the axis at each, shape [m, 3].
        sharpness: Radius times distance over the noise's square, shape [m].
        stout: Square of radius over noise, shape [m].
        seen: What was seen.
    """
    mean = out * np.where(sharpness > 1, 1 - 0.5 / np.maximum(sharpness, 1.0), 0.5)[:, None]
    if seen.along_sight:
        # Scatter along the sight widens no silhouette: what it adds to the radius is bounded.
        return out * np.clip(1 - 0.5 / np.maximum(sharpness, 1e-9), _SIGHT_LEAST, 1.0)[:, None]
    # By the radius alone: chosen by their distance too, near points would count otherwise than far.
    blurred = np.flatnonzero(stout < (_SHARP_SIDE if seen.one_sided else _SHARP))
    side, cross = _sides(axis[blurred], seen.view)
    cosine, sine = (np.einsum("mj,mj->m", out[blurred], way) for way in (side, cross))
    size = np.maximum(np.hypot(cosine, sine), 1e-300)
    place = mean_on_circle(cosine / size, sine / size, sharpness[blurred], seen.share)
    mean[blurred] = place[:, :1] * side + place[:, 1:] * cross
    return mean


def across_sight(out: np.ndarray, axis: np.ndarray, seen: SeenSides) -> np.ndarray:
    """Sine of the angle around the axis between points and the viewer of one side, shape [m].

    Args:
        out: Unit vectors from the axis to the points, shape [m, 3].
        axis: Unit vectors along the axis at each, shape [m, 3].
        seen: What was seen.
    """
    return np.einsum("mj,mj->m", out, _sides(axis, seen.view)[1])


def _sides(axis: np.ndarray, view: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors across each axis: towards the viewer, and across both, shape [m, 3] each."""
    side = view - (axis @ view)[:, None] * axis
    size = np.linalg.norm(side, axis=1)
    other = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
    other = other - np.einsum("mj,mj->m", other, axis)[:, None] * axis
    side = np.where((size > 1e-6)[:, None], side, other)
    side /= np.linalg.norm(side, axis=1)[:, None]
    return side, np.cross(axis, side)
