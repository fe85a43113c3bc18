"""Loops of the axis fit against the plain formulas."""

import numpy as np

from limber.geometry.skeleton.radii.fit_kernels import (
    match_cylinders,
    mean_on_circle,
    normal_blocks,
    reach_on_circle,
)
from limber.geometry.skeleton.skeleton import Skeleton


def test_nearest_cylinder_is_the_one_that_a_search_along_all_finds() -> None:
    """A point's distance from a tapered tree is the least over finely sampled axes."""
    rng = np.random.default_rng(3)
    nodes = np.array([[0, 0, 0], [0, 0, 1], [0, 0, 2], [0.8, 0, 1.5]])
    parent, radius = np.array([-1, 0, 1, 1]), np.array([0.2, 0.15, 0.1, 0.05])
    points = rng.uniform([-1, -1, -0.5], [1.5, 1, 2.5], (200, 3))
    near = np.tile([1, 2, 3], (len(points), 1))
    m = match_cylinders(Skeleton.from_edges(nodes, parent, radius), points, near)
    t = np.linspace(0, 1, 2001)[:, None]
    least = np.full(len(points), np.inf)
    for end in (1, 2, 3):
        axis = (1 - t) * nodes[parent[end]] + t * nodes[end]
        here = np.full(len(t), radius[end]) if end == 3 else (
            (1 - t) * radius[parent[end]] + t * radius[end])[:, 0]
        foot = np.linalg.norm(points[:, None] - axis, axis=2).argmin(axis=1)
        least = np.minimum(least, np.linalg.norm(points - axis[foot], axis=1) - here[foot])
    np.testing.assert_allclose(m.residual, least, atol=1e-3)
    foot = (1 - m.share)[:, None] * nodes[parent[m.segment]] + m.share[:, None] * nodes[m.segment]
    found = foot + (m.residual + m.thick)[:, None] * m.normal
    np.testing.assert_allclose(found, points, atol=1e-12)


def test_blocks_are_the_sums_of_outer_products() -> None:
    rng = np.random.default_rng(4)
    count = 50
    segment, share, weight = rng.integers(0, 3, count), rng.uniform(size=count), rng.uniform(
        size=count)
    normal, across, gradient = (rng.normal(size=(count, width)) for width in (3, 3, 8))
    low, high = rng.uniform(size=count), rng.uniform(size=count)
    block, right = normal_blocks(segment, share, low, high, normal, across, gradient, weight, 3)
    row = np.column_stack([-(1 - share)[:, None] * normal, -low, -share[:, None] * normal, -high])
    none = np.zeros(count)
    side = np.column_stack([-(1 - share)[:, None] * across, none, -share[:, None] * across, none])
    for s in range(3):
        own = segment == s
        np.testing.assert_allclose(block[s], (row[own] * weight[own, None]).T @ row[own]
                                   + (side[own] * weight[own, None]).T @ side[own])
        np.testing.assert_allclose(right[s], weight[own] @ gradient[own])


def test_mean_on_a_circle_is_von_mises() -> None:
    """All places seen alike: the mean points at the point, as long as I1(k) / I0(k)."""
    from scipy.special import ive

    angle, sharpness = np.array([0.3, 2.0, -2.5]), np.array([0.5, 3.0, 40.0])
    mean = mean_on_circle(np.cos(angle), np.sin(angle), sharpness, np.ones(48))
    np.testing.assert_allclose(np.arctan2(mean[:, 1], mean[:, 0]), angle, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(mean, axis=1),
                               ive(1, sharpness) / ive(0, sharpness), rtol=1e-9)


def test_reach_is_a_side_blurred_as_von_mises_has_it() -> None:
    """Against its distribution in SciPy, and derivatives against differences."""
    from scipy.special import i0e
    from scipy.stats import vonmises

    rng = np.random.default_rng(5)
    angle, sharpness = rng.uniform(-np.pi, np.pi, 300), np.exp(rng.uniform(-3, 6, 300))
    limit, least, step = 1.45, 0.01, 1e-5

    def reach(turn: float = 0.0, further: float = 0.0):
        return reach_on_circle(angle + turn, sharpness, i0e(sharpness), limit + further, least)

    log, by_angle, by_limit = reach()
    inside = (vonmises.cdf(limit - angle, sharpness) - vonmises.cdf(-limit - angle, sharpness))
    np.testing.assert_allclose(np.exp(log), least + (1 - least) * inside, atol=2e-5)
    # From sharpness 30 the density is von Mises' own, and the share that of its normal shape.
    np.testing.assert_allclose(by_angle, (reach(step)[0] - reach(-step)[0]) / (2 * step), atol=5e-3)
    np.testing.assert_allclose(
        by_limit, (reach(0, step)[0] - reach(0, -step)[0]) / (2 * step), atol=5e-3)
