"""Axes and radii of all branches together: as measured, elsewhere as wood grows."""

from dataclasses import replace

import numpy as np
import pytest

from limber.geometry.skeleton.confidence import assessed
from limber.geometry.skeleton.radii.wood import ShapeEvidence, likeliest_shape
from limber.geometry.skeleton.skeleton import INTERPOLATED, LIMITED, MEASURED, UNRESOLVED, Skeleton

_STEM, _TWIG = 81, 40


def _plant(stem: np.ndarray | float = 0.008, twig: np.ndarray | float = 0.003,
           sigma: float = 0.02) -> Skeleton:
    """A stem of 0.4 m along z and a twig of 0.12 m from its middle, all measured."""
    z, x = np.linspace(0, 0.4, _STEM), np.linspace(0, 0.12, _TWIG + 1)[1:]
    nodes = np.vstack([np.stack([0 * z, 0 * z, z], axis=1),
                       np.stack([x, 0 * x, 0 * x + 0.2], axis=1)])
    parent = np.r_[np.arange(_STEM) - 1, 40, _STEM + np.arange(_TWIG - 1)]
    radius = np.r_[np.broadcast_to(stem, _STEM), np.broadcast_to(twig, _TWIG)]
    return Skeleton.from_edges(nodes, parent, radius, radius_sigma=sigma * radius,
                               radius_state=np.full(len(radius), MEASURED, np.int8))


def _told(plant: Skeleton, spacing: float = 0.001, noise: float = 0.0005, depth: float = 0.0,
          **more: object) -> Skeleton:
    """The likeliest shape; of an error of the radius, the axis has ``depth`` times that in y."""
    covariance = np.zeros((plant.node_count, 4, 4))
    way = np.array([0.0, depth, 0.0, 1.0])
    covariance += plant.radius_sigma[:, None, None]**2 * np.outer(way, way) + 1e-10 * np.eye(4)
    return likeliest_shape(plant, ShapeEvidence(
        covariance, np.full(plant.node_count, spacing), noise, **more))


def test_well_measured_radii_stay() -> None:
    """Also a twig far thinner than most are against their carrier."""
    for twig in (0.006, 0.003, 0.001):
        told = _told(_plant(twig=twig), 0.0003, 0.0001)
        np.testing.assert_allclose(told.radius, _plant(twig=twig).radius, rtol=0.05)
        assert (told.radius_state == MEASURED).all()
        assert (told.radius_sigma > 0.005 * told.radius).all()


def test_a_gap_gets_the_radius_between_and_a_wider_interval() -> None:
    """The middle of a gap is less sure than its ends."""
    stem = np.linspace(0.009, 0.006, _STEM)
    plant = _plant(np.where(np.isin(np.arange(_STEM), range(20, 50)), 4e-4, stem))
    state = np.where(plant.radius < 5e-4, INTERPOLATED, MEASURED).astype(np.int8)
    told = _told(replace(plant, radius_state=state))
    np.testing.assert_allclose(told.radius[:_STEM], stem, rtol=0.08)
    sigma = told.radius_sigma / told.radius
    assert sigma[35] > 1.5 * sigma[10] and (told.radius_state[20:50] == INTERPOLATED).all()


@pytest.mark.parametrize("fitted", [0.0004, 0.0015])
def test_an_unresolved_twig_follows_its_carrier(fitted: float) -> None:
    """Fits of a few points far apart come out anywhere: carrier and interval decide."""
    plant = _plant(twig=fitted, sigma=0.3)
    told = _told(plant, 0.008, 0.0005)
    twig = told.branch == 1
    assert (told.radius_state[twig] == UNRESOLVED).all()
    low, high = (told.radius[twig] * np.exp(way * 1.96 * (told.radius_sigma / told.radius)[twig])
                 for way in (-1, 1))
    assert (low < 0.001).all() and (high > 0.004).all()
    assert np.median(told.radius[twig]) < 0.006


def test_one_fit_that_failed_among_good_ones_moves_little() -> None:
    """A knot of 30 mm between radii of 8 mm does not thicken its neighbours."""
    radius = np.full(_STEM, 0.008)
    radius[40:43] = 0.03
    told = _told(_plant(radius))
    np.testing.assert_allclose(told.radius[:36], 0.008, rtol=0.06)
    assert told.radius[41] < 0.02


def test_a_bunch_at_the_end_of_a_stem_is_stated_and_not_believed() -> None:
    """Points of a bunch three times as wide as the stem; the stem's radius goes on."""
    rng = np.random.default_rng(0)
    z, angle = rng.uniform(0, 0.4, 6000), rng.uniform(0, 2 * np.pi, 6000)
    wide = np.where(z > 0.3, 0.024, 0.008)
    points = np.stack([wide * np.cos(angle), wide * np.sin(angle), z], axis=1)
    plant = _plant(np.where(np.linspace(0, 0.4, _STEM) > 0.3, 0.024, 0.008)).subset(
        np.arange(_STEM + _TWIG) < _STEM)
    told = assessed(plant, points, 0.0003)
    assert (told.radius_state[62:] == LIMITED).all() and told.radius[62:].max() < 0.012


def test_an_image_may_widen_its_branches_by_a_fraction_of_a_pixel() -> None:
    """The interval holds half a pixel less and a quarter more."""
    pixel = np.full(_STEM + _TWIG, 0.002)
    told = _told(_plant(), 0.0002, 0.0, pixel=pixel, one_sided=True)
    np.testing.assert_allclose(told.radius[:_STEM], 0.008, rtol=0.02)
    assert (1.96 * told.radius_sigma[:_STEM] > 0.45 * 0.002).all()
    coarse = _told(_plant(), 0.0002, 0.0, pixel=50 * pixel, one_sided=True)
    assert (coarse.radius > 0).all() and np.isfinite(coarse.radius_sigma).all()


def test_an_axis_goes_with_the_radius_that_the_points_leave_open() -> None:
    """A twig as thick as its stem gets thinner, and its seen side stays."""
    plant = _plant(twig=0.016, sigma=0.3)
    twig, y = plant.branch == 1, plant.nodes[:, 1]
    told = _told(plant, depth=-1.0)
    thinner = plant.radius - told.radius
    assert thinner[twig].min() > 0.002
    np.testing.assert_allclose((told.nodes[:, 1] - y)[twig], thinner[twig], rtol=0.35)
    assert np.abs((_told(plant).nodes[:, 1] - y)[twig]).max() < 1e-4


def test_a_scattered_axis_is_smoothed_and_a_bend_is_kept() -> None:
    """Scatter of half a radius is nearly halved; a bend stays within a fifth of a radius."""
    plant, rng = _plant(), np.random.default_rng(0)
    bend = 0.3 * plant.nodes[:, 2]**2 * (plant.branch == 0)
    off = 0.004 * rng.standard_normal(plant.node_count) * (plant.branch == 0)
    nodes = plant.nodes + np.outer(bend + off, [0, 1.0, 0])
    covariance = np.tile(np.diag([1, 1, 1, 1e-2])[None] * 0.004**2, (plant.node_count, 1, 1))
    told = likeliest_shape(replace(plant, nodes=nodes), ShapeEvidence(
        covariance, np.full(plant.node_count, 0.001), 0.0005))
    left = (told.nodes[:, 1] - bend)[:_STEM]
    assert np.std(left) < 0.6 * np.std(off[:_STEM]) and abs(np.mean(left)) < 0.0016


def test_nodes_at_one_place_have_no_direction_that_moves_them() -> None:
    """On a real scan a joint doubled a node, and the bend about it moved that by 290 mm."""
    plant = _plant()
    nodes = plant.nodes.copy()
    nodes[:_STEM, 1] += 1e-3 * np.sin(np.arange(_STEM))
    nodes[30] = nodes[29]
    state = plant.radius_state.copy()
    state[20:40] = INTERPOLATED
    told = _told(replace(plant.moved(nodes), radius_state=state))
    assert np.linalg.norm(told.nodes - nodes, axis=1).max() < 3e-3


@pytest.mark.parametrize("depth", [1.0, -1.0])
def test_how_an_axis_bends_does_not_decide_a_radius_that_is_hardly_known(depth: float) -> None:
    """Depth and radius of thin fits are one unknown: an axis 30 mm off made kilometres of it."""
    radius, sigma = np.full(_STEM, 0.004), np.full(_STEM + _TWIG, 8e-5)
    radius[:12], sigma[:12] = 0.0015, 0.0012
    plant = _plant(radius)
    nodes = plant.nodes.copy()
    nodes[:12, 1] -= 0.03 * np.linspace(1.0, 0.0, 12)**2
    told = _told(replace(plant.moved(nodes), radius_sigma=sigma), depth=depth)
    assert told.radius[:_STEM].max() < 0.0045 and told.radius[:12].min() > 0.0015


def test_errors_that_all_fits_share_widen_all_intervals() -> None:
    """Of a coarser scan, of registration, and of sections that one side shows."""
    plain = _told(_plant(), 0.0005, 0.0)
    for told, factor in ((_told(_plant(), 0.005, 0.0), 1.5),
                         (_told(_plant(), 0.0005, 0.0, common=0.0008), 1.5),
                         (_told(_plant(), 0.0005, 0.0, one_sided=True), 1.15)):
        assert (told.radius_sigma > factor * plain.radius_sigma)[5:_STEM - 5].all()


@pytest.mark.parametrize("twig", [0.003, 0.006])
def test_beyond_a_fork_the_stem_is_thinner_by_the_wood_of_its_twig(twig: float) -> None:
    """Where no point shows it: the thicker the twig, the deeper the step."""
    plant = _plant(twig=twig, sigma=0.01)
    hidden = (plant.branch == 0) & (plant.nodes[:, 2] > 0.201)
    told = _told(replace(plant, radius_state=np.where(hidden, INTERPOLATED, MEASURED).astype(
        np.int8)), 0.0003, 0.0001)
    step = told.radius[41] / told.radius[40]
    assert step == pytest.approx((1 - (twig / 0.008)**2.7)**(1 / 2.7), abs=0.06)
    assert told.radius_sigma[41] / told.radius[41] > 2 * told.radius_sigma[38] / told.radius[38]


def test_a_stem_that_no_point_shows_beyond_a_fat_twig_stays_a_stem() -> None:
    """The wood of the twig explains the fork alone: the stem beyond it must not vanish."""
    plant = _plant(twig=0.012, sigma=0.01)
    hidden = (plant.branch == 0) & (plant.nodes[:, 2] > 0.201)
    told = _told(replace(plant, radius_state=np.where(hidden, INTERPOLATED, MEASURED).astype(
        np.int8)), 0.0003, 0.0001)
    beyond = told.radius[hidden & (plant.nodes[:, 2] < 0.25)]
    assert 0.002 < beyond.min() and beyond.max() < 0.009
    assert np.isfinite(told.radius_sigma).all()
