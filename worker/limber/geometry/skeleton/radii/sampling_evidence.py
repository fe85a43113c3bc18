"""Which of two models of a scan its points support: how a sensor spaces them, and how it errs.

Even over the skin and scattered equally in all directions, as in merged scans; or even across one
sensor's sight and scattered along it, as a scanner's or a camera's rays are. Both are likelihoods
of the same points in the branches' cross-sections, each about its own axes and radii.
"""

from dataclasses import replace

import numpy as np

from limber.geometry.cloud.single_view import View
from limber.geometry.skeleton.radii.axis_fit import AxisFit, robust_sigma
from limber.geometry.skeleton.radii.fit_kernels import nearest_cylinders
from limber.geometry.skeleton.radii.projected_widths import (
    SightField,
    by_projected_widths,
    cross_sections,
)
from limber.geometry.skeleton.radii.visible_sides import PLACES, SeenSides
from limber.geometry.skeleton.skeleton import Skeleton

_SAMPLE = 1500  # points that tell
_PLACES = 48  # on a cross-section, of which each is weighed
_THINNER = (0.65, 0.75, 0.85, 1.0)  # than its width across the sight, a branch with scatter there
_GRAZING_LIMIT = np.deg2rad(81.0)
_NOISES = (0.7, 1.0, 1.4)  # times the noise found: the best of each model counts
_BLURS = (0.05, 0.1, 0.2)  # across the sight, in radii
_GRAZING = (0.0, 0.5, 1.0)  # powers of the incidence's cosine by which errors grow
_STRAY = 0.02  # fraction of points that are anywhere within some radii
_AROUND = 20.0  # area of that [radius^2]
_ALIKE = 3.0  # points whose errors are correlated, so that they count as one


def rays_over_skin(fit: AxisFit, other: Skeleton, field: SightField, points: np.ndarray) -> float:
    """Logarithm of how much likelier one sensor's rays are than points all over the skin. ``fit``
    is by the points' distances, ``other`` by their width across the sight."""
    some = points[::max(len(points) // (2 * _SAMPLE), 1)]
    skin, rays = (cross_sections(skeleton, some, field) for skeleton in (fit.skeleton, other))
    # Thin branches show less of it: the thicker half by either model.
    good = np.isfinite(skin[0]) & np.isfinite(rays[0])
    if good.sum() < _PLACES:
        return 0.0
    thick = skin[2] * rays[2]
    good &= thick >= np.median(thick[good])
    skin, rays = (tuple(column[good] for column in each) for each in (skin, rays))
    limit = fit.seen.limit if fit.seen.one_sided else _GRAZING_LIMIT
    over_skin = max(_of_skin(*skin, limit if fit.seen.one_sided else np.pi, fit.noise), *(
        _of_skin(*_thinner(*rays, share, limit), limit, fit.noise) for share in _THINNER))
    return (_of_rays(*rays) - over_skin) / _ALIKE


def _thinner(beside: np.ndarray, depth: np.ndarray, radius: np.ndarray, share: float,
             limit: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The points about thinner branches, as deep as the skin's half up to ``limit`` [rad] has them.
    The fit by distances may have failed: its model is judged by its best."""
    thin = share * radius
    return beside, depth - radius * np.median(depth / radius) + thin * np.cos(limit / 2), thin


def _of_skin(beside: np.ndarray, depth: np.ndarray, radius: np.ndarray, limit: float, noise: float,
             ) -> float:
    """Log-likelihood of points evenly over the skin up to ``limit`` [rad] from the sight."""
    angle = limit * (2 * (np.arange(_PLACES) + 0.5) / _PLACES - 1)
    best = -np.inf
    for share in _NOISES:
        spread = np.full((len(radius), 1), share * max(noise, 1e-12))
        best = max(best, _log_likelihood(beside, depth, radius, np.sin(angle), np.cos(angle),
                                         spread, spread))
    return best


def _of_rays(beside: np.ndarray, depth: np.ndarray, radius: np.ndarray) -> float:
    """Log-likelihood of points evenly across the sight, with errors along it."""
    across = 2 * (np.arange(_PLACES) + 0.5) / _PLACES - 1
    rise = np.sqrt(1 - across**2)
    miss = depth - np.sqrt(np.maximum(radius**2 - beside**2, 0.0))
    noise = 1.4826 * float(np.median(np.abs(miss)))
    return max(_log_likelihood(
        beside, depth, radius, across, rise, blur * radius[:, None],
        np.maximum(share * noise / np.maximum(rise, 0.1)**power, 1e-12)[None])
               for blur in _BLURS for share in _NOISES for power in _GRAZING)


def _log_likelihood(beside: np.ndarray, depth: np.ndarray, radius: np.ndarray, across: np.ndarray,
                    rise: np.ndarray, blur: np.ndarray, noise: np.ndarray) -> float:
    """Log-likelihood of offsets [m] from places at ``across`` and ``rise`` [radii]."""
    miss = ((beside[:, None] - radius[:, None] * across) / blur)**2 + (
        (depth[:, None] - radius[:, None] * rise) / noise)**2
    density = (np.exp(-miss / 2) / (2 * np.pi * blur * noise)).mean(axis=1)
    stray = _STRAY / (_AROUND * radius**2)
    return float(np.log((1 - _STRAY) * density + stray).sum())


# The fit of axes and radii for one sensor's rays, where the points support that model.

_LIKELIER = 3.0  # logarithm: twenty times


def fit_of_rays(fit: AxisFit, points: np.ndarray, certain: bool, view: View | None = None,
                ) -> AxisFit | None:
    """Return the fit by the branches' widths across one sensor's sight. None if the points do not
    support it, unless rays are ``certain`` to have made them."""
    skeleton, field = by_projected_widths(fit.skeleton, points, view)
    if not certain and rays_over_skin(fit, skeleton, field, points) < _LIKELIER:
        return None
    segment, residual = nearest_cylinders(skeleton, points)
    return replace(fit, skeleton=skeleton, segment=segment, residual=residual,
                   noise=robust_sigma(residual, skeleton.radius[segment]),
                   seen=SeenSides(field.towards, np.ones(PLACES), along_sight=True))
