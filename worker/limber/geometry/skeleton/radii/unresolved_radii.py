"""Radii that a scan does not resolve, combined with prior knowledge, and their intervals.

Where a branch is thinner than the points' spacing or their noise, its points give little
information on its radius. The typical shape of branches gives more: a twig is thinner than its
carrier and tapers. Both are weighted, and the interval has the resulting width.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.skeleton.skeleton import INTERPOLATED, LIMITED, UNRESOLVED, Skeleton

SPACINGS = 1.0
"""Diameter in point spacings, under which a radius is not resolved: too few points around it."""
_BESIDE = 4  # nodes on each side whose points show the spacing
_NOISES = 1.0  # the same, in standard deviations of the noise
_TWIG, _TAPER = 0.65, 0.4  # a twig's radius over its carrier's; its decrease to the tip
# Standard deviations of the radius's logarithm: prior, points too far apart, noise alone.
_PRIOR, _FIT, _FIT_NOISE = 0.35, 0.5, 0.25
# Fraction of the radius, over (noise / radius)^2: the noise itself is known to 4 %, and the radius
# of one side changes by 3.7 times that (of half a circle, the scatter is twice the square of the
# noise and 0.54 of the radius's).
_BIAS = 0.15
_MODEL = 0.012  # fraction of the radius; branches are not quite round
_ROUGH_SIGMA = 0.25  # fraction of a radius that was interpolated or limited
_UNRESOLVED_SIGMA = 0.5  # smallest fraction of an unresolved radius
# Standard deviation of the logarithm of an unresolved radius that came out below the expected one:
# such fits collapse. On generated scans they were 0.3 to 0.7 too thin.
_COLLAPSED = 1.2


def weighed(skeleton: Skeleton, spacing: np.ndarray, noise: float) -> Skeleton:
    """Return the skeleton with honest radii, intervals and states.

    Args:
        skeleton: Fitted.
        spacing: Spacing of the points around each node [m], shape [n].
        noise: Standard deviation of the points [m].
    """
    state, radius = skeleton.radius_state.copy(), skeleton.radius.copy()
    sigma = np.sqrt(skeleton.radius_sigma**2 + (_MODEL * radius)**2
                    + (_BIAS * np.minimum(noise / radius, 1.0)**2 * radius)**2)
    coarse = 2 * radius < SPACINGS * spacing
    vague = coarse | (radius < _NOISES * noise)
    loose = np.maximum(sigma / radius, np.where(coarse, _FIT, _FIT_NOISE))
    rough = np.isin(state, (LIMITED, INTERPOLATED))
    sigma = np.where(rough, np.maximum(sigma, _ROUGH_SIGMA * radius), sigma)
    for own in skeleton.own_runs():
        _blend(radius, sigma, state, own, int(skeleton.parent[own[0]]), vague, loose)
    return replace(skeleton, radius=radius, radius_sigma=sigma, radius_state=state)


def point_spacing(skeleton: Skeleton, points: np.ndarray, segment: np.ndarray, noise: float,
                  ) -> np.ndarray:
    """Mean distance of neighbouring points around each node, corrected for noise [m], shape [n]."""
    distance = cKDTree(points).query(points, k=min(5, len(points)))[0][:, 1:].mean(axis=1)
    total = np.bincount(segment, distance, skeleton.node_count)
    count = np.bincount(segment, minlength=skeleton.node_count).astype(float)
    near = np.full(skeleton.node_count, float(np.median(distance)))
    for own in skeleton.own_runs():
        # A node without points has the point spacing of its neighbours.
        around = np.ones(min(2 * _BESIDE + 1, len(own)))
        points_near = np.convolve(count[own], around, "same")
        known = points_near > 0
        near[own[known]] = np.convolve(total[own], around, "same")[known] / points_near[known]
    return np.sqrt(np.maximum(near**2 - noise**2, (0.5 * near)**2))


def _blend(radius: np.ndarray, sigma: np.ndarray, state: np.ndarray, own: np.ndarray, carrier: int,
           vague: np.ndarray, loose: np.ndarray) -> None:
    """Combine unresolved radii of a run with those that its carrier and resolved part suggest."""
    if not vague[own].any():
        return
    for node, expected in zip(own, _expected(radius, own, carrier, vague[own]), strict=True):
        if not vague[node]:
            continue
        fit = loose[node] if radius[node] > expected else max(loose[node], _COLLAPSED)
        weight = fit**-2, _PRIOR**-2
        radius[node] = np.exp(np.average([np.log(radius[node]), np.log(expected)], weights=weight))
        sigma[node] = radius[node] * max(_UNRESOLVED_SIGMA, sum(weight)**-0.5)
        state[node] = UNRESOLVED


def _expected(radius: np.ndarray, own: np.ndarray, carrier: int, vague: np.ndarray) -> np.ndarray:
    """Radius expected from an even taper from the next resolved node, or from the carrier [m]."""
    clear = np.flatnonzero(~vague)
    index = np.arange(len(own))
    if len(clear) == 0:
        start = _TWIG * radius[carrier] if carrier >= 0 else float(np.median(radius[own]))
        return start * (1 - _TAPER * index / len(own))
    before = clear[np.maximum(np.searchsorted(clear, index, side="right") - 1, 0)]
    return radius[own[before]] * (1 - _TAPER * (index - before) / len(own))
