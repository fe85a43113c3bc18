"""Branches seen by one sensor: radii by their width across its sight, if its rays made the scan."""

import numpy as np
import pytest

from limber.geometry.skeleton.radii.axis_fit import AxisFit, fit_axes
from limber.geometry.skeleton.radii.projected_widths import by_projected_widths, sight_field
from limber.geometry.skeleton.radii.sampling_evidence import fit_of_rays
from limber.geometry.skeleton.skeleton import MEASURED, Skeleton

_RADIUS, _LENGTH = 0.006, 0.5  # [m]
_EYE = np.array([2.0, 0.4, 0.9])  # [m]
_NOISE = 0.0015  # [m]


def _axes(offset: float) -> Skeleton:
    """A stem and a twig that leaves it sideways, ``offset`` [m] towards the sensor."""
    stem = np.stack([np.full(60, offset), np.zeros(60), np.linspace(0, _LENGTH, 60)], axis=1)
    way = np.linspace(0, 0.2, 31)[1:, None]
    twig = stem[30] + way * np.array([0.0, 0.8, 0.6])
    parent = np.r_[np.arange(-1, 59), 30, np.arange(60, 89)]
    return Skeleton.from_edges(np.vstack([stem, twig]), parent, np.full(90, 0.8 * _RADIUS))


def _rays(rng: np.random.Generator) -> np.ndarray:
    """Evenly spaced across the sight of ``_EYE``, with errors along it."""
    points = []
    for start, end in (([0, 0, 0], [0, 0, _LENGTH]), ([0, 0, 0.2542], [0, 0.16, 0.3742])):
        start, end = np.array(start, float), np.array(end, float)
        length = np.linalg.norm(end - start)
        count = int(2 * _RADIUS * length / 0.0018**2)
        foot = start + rng.uniform(0, 1, count)[:, None] * (end - start)
        axis = (end - start) / length
        sight = _EYE - foot
        side = np.cross(axis, sight)
        side /= np.linalg.norm(side, axis=1)[:, None]
        across = rng.uniform(-1, 1, count)[:, None]
        front = np.cross(side, axis)
        points.append(foot + _RADIUS * (across * side + np.sqrt(1 - across**2) * front))
    points = np.vstack(points)
    sight = _EYE - points
    sight /= np.linalg.norm(sight, axis=1)[:, None]
    return points + rng.normal(0, _NOISE, len(points))[:, None] * sight


def _skin(rng: np.random.Generator, half: float) -> np.ndarray:
    """Evenly over the skin, up to ``half`` [rad] from the sight, with errors in all directions."""
    angle, height = rng.uniform(-half, half, 2000), rng.uniform(0, _LENGTH, 2000)
    points = np.stack([_RADIUS * np.cos(angle), _RADIUS * np.sin(angle), height], axis=1)
    return points + rng.normal(0, _NOISE, points.shape)


@pytest.fixture(scope="module")
def rays() -> tuple[AxisFit, np.ndarray]:
    points = _rays(np.random.default_rng(3))
    return fit_axes(_axes(0.3 * _RADIUS), points), points


def test_rays_show_the_radius_across_their_sight(rays: tuple[AxisFit, np.ndarray]) -> None:
    """A circle by distances is an eighth too thin or more; the widths are right, on their axes."""
    fit, points = rays
    assert np.median(fit.skeleton.radius) < 0.88 * _RADIUS
    found, _ = by_projected_widths(fit.skeleton, points)
    assert np.median(found.radius) == pytest.approx(_RADIUS, rel=0.03)
    off = np.abs(found.radius - _RADIUS) / found.radius_sigma
    assert 0.8 < (off < 1.96).mean()
    stem = found.branch == 0
    assert np.median(np.linalg.norm(found.nodes[stem, :2], axis=1)) < 0.15 * _RADIUS


def test_the_sensor_is_found_from_the_seen_sides(rays: tuple[AxisFit, np.ndarray]) -> None:
    """Towards it within 10 degrees, where two axes of different directions have points."""
    _, points = rays
    places = np.array([[0, 0, 0.1], [0, 0.15, 0.35]])
    true = (_EYE - places) / np.linalg.norm(_EYE - places, axis=1)[:, None]
    cosine = np.einsum("ij,ij->i", sight_field(_axes(0.0), points).at(places), true)
    assert (cosine > np.cos(np.radians(10))).all()


def test_rays_are_taken_for_rays_and_skin_for_skin(rays: tuple[AxisFit, np.ndarray]) -> None:
    """By their likelihood; a camera's are known to be rays."""
    fit, points = rays
    told = fit_of_rays(fit, points, certain=False)
    assert told is not None and told.seen.along_sight
    assert np.median(told.skeleton.radius) == pytest.approx(_RADIUS, rel=0.03)
    straight = Skeleton.from_edges(*(getattr(_axes(0.3 * _RADIUS), name)[:60] for name in (
        "nodes", "parent", "radius")))
    for half in (np.radians(81), np.pi):
        skin = _skin(np.random.default_rng(4), half)
        fit = fit_axes(straight, skin)
        assert fit_of_rays(fit, skin, certain=False) is None
        assert fit_of_rays(fit, skin, certain=True) is not None


def test_a_run_without_points_keeps_its_radius() -> None:
    """Where nothing shows a width, nothing is claimed to be measured by it."""
    points = _rays(np.random.default_rng(5))
    stem = points[np.abs(points[:, 1]) < 2 * _RADIUS]
    start = _axes(0.0)
    bare = np.flatnonzero((start.branch == 1) & (start.nodes[:, 1] > 0.05))
    found, _ = by_projected_widths(start, stem)
    assert np.isfinite(found.nodes).all() and (found.radius > 0).all()
    assert (found.radius_state[found.branch == 0] == MEASURED).mean() > 0.9
    assert found.radius[bare] == pytest.approx(start.radius[bare])


def test_widths_that_show_nothing_change_little() -> None:
    """Points on the axis have no width, and far too few no sensor: no radius vanishes."""
    start = _axes(0.0)
    line = start.nodes[np.repeat(np.arange(40), 20)]
    for points in (line, line[:3] + [0.001, 0, 0]):
        found, _ = by_projected_widths(start, points)
        assert (found.radius >= start.radius / 3.001).all() and np.isfinite(found.nodes).all()
