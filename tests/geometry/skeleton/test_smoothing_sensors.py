"""A sensor that smooths thins twigs without losing their points; one that does not stays as is."""

from dataclasses import replace

import numpy as np
import pytest

from limber.geometry.skeleton.radii.sensor_effects import sensor_smoothing
from limber.geometry.skeleton.radii.wood import ShapeEvidence, likeliest_shape
from limber.geometry.skeleton.skeleton import MEASURED, Skeleton

SPACING = 0.003


def tree() -> Skeleton:
    """A stem of 9 to 6 mm radius and eight twigs of 2.5 to 1.6 mm."""
    nodes, parent, radius = [np.zeros(3)], [-1], [0.009]
    for k in range(1, 101):
        nodes.append(np.array([0, 0, 0.008 * k]))
        parent.append(k - 1)
        radius.append(0.009 - 0.00003 * k)
    for twig in range(8):
        at, angle = 10 + 11 * twig, 2.4 * twig
        for k in range(1, 61):
            nodes.append(nodes[at] + 0.004 * k * np.array([np.cos(angle), np.sin(angle), 0.3]))
            parent.append(at if k == 1 else len(nodes) - 2)
            radius.append(0.0025 - 0.000015 * k)
    return Skeleton.from_edges(np.array(nodes), np.array(parent), np.array(radius))


def counts(skeleton: Skeleton, seed: int, power: float = 1.0) -> np.ndarray:
    """Points at random over the skin; on each length in proportion to a power of the radius."""
    skin = 2 * np.pi * skeleton.steps * (skeleton.radius / 0.008)**power * 0.008
    return np.random.default_rng(seed).poisson(skin / SPACING**2)


def smoothed(skeleton: Skeleton, shrink: float) -> Skeleton:
    return replace(skeleton, radius=skeleton.radius * np.exp(
        -shrink * (SPACING / skeleton.radius)**2))


@pytest.mark.parametrize("seed", range(4))
def test_radii_before_smoothing_follow_from_the_number_of_points(seed: int) -> None:
    true = tree()
    seen = smoothed(true, 0.25)
    assert np.quantile(seen.radius / true.radius, 0.1) < 0.55
    found = sensor_smoothing(seen, seen.radius, counts(true, seed), SPACING)
    covariance = np.tile(np.eye(4) * 1e-8, (seen.node_count, 1, 1))
    mended, spread = found.undone(seen, covariance)
    off = np.log(mended.radius / true.radius)
    assert abs(found.shrink - 0.25) < 0.1
    assert (np.abs(off) < 3 * found.uncertainty(mended.radius) + 0.01).all()
    assert np.abs(off).max() < 0.2
    assert (spread[:, 3, 3] > 0).all()
    assert np.allclose(spread[:, :3, :3], covariance[:, :3, :3])


@pytest.mark.parametrize("power", [1.0, 1.15])
def test_a_sensor_that_does_not_smooth_leaves_radii_as_they_are(power: float) -> None:
    """Also one that sees fewer points on the skin of thin twigs, as most do."""
    true = tree()
    found = sensor_smoothing(true, true.radius, counts(true, 5, power), SPACING)
    assert found.shrink < 0.05
    mended, _ = found.undone(true, np.tile(np.eye(4), (true.node_count, 1, 1)))
    off = np.log(mended.radius / true.radius)
    assert np.abs(off).max() < 0.12
    assert (off < 0.7 * found.uncertainty(mended.radius)).all()


def test_what_density_leaves_open_is_an_error_of_all_radii_together() -> None:
    """Stem and twigs that are alike thick say nothing of smoothing: half of it may be there."""
    told = tree()
    alike = replace(told, radius=np.where(told.branch == 0, 0.0045, 0.0035))
    found = sensor_smoothing(alike, alike.radius, counts(alike, 0), SPACING)
    assert found.sigma > 0.08
    covariance = np.tile(np.eye(4) * 1e-10, (alike.node_count, 1, 1))
    state = np.full(alike.node_count, MEASURED, np.int8)
    sigma = [shape.radius_sigma / shape.radius for shape in (likeliest_shape(
        replace(alike, radius_state=state), ShapeEvidence(
            covariance, np.full(alike.node_count, SPACING), 0.0, smoothing=smoothing))
        for smoothing in (None, found))]
    twig = alike.branch > 0
    assert np.median(sigma[1][twig]) > 1.3 * np.median(sigma[0][twig])


def test_few_points_show_no_smoothing() -> None:
    true = tree()
    few = counts(true, 0) // 40
    found = sensor_smoothing(true, true.radius, few, SPACING)
    assert found.shrink == 0 and found.sigma == 0
