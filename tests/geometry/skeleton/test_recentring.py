"""Recentring contracted points, against axes that are known."""

import numpy as np
import pytest

from limber.geometry.skeleton.contraction.laplacian_contraction import contract
from limber.geometry.skeleton.contraction.recentring import recentred


def _half_tube(radius, noise, count=3000, seed=0, arc=np.pi):
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, arc, count)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle),
                       rng.uniform(0, 0.4, count)], axis=1)
    return points + rng.normal(0, noise, points.shape)


@pytest.mark.parametrize("arc", [np.pi, 0.75 * np.pi])
def test_one_side_alone_gives_the_axis(arc):
    """Contraction ends on the seen side; recentred, points lie near the true axis."""
    points = _half_tube(0.01, 0.0003, arc=arc)
    result = contract(points)
    inner = np.abs(points[:, 2] - 0.2) < 0.15
    before = np.linalg.norm(result.drawn[inner, :2], axis=1).mean()
    after = np.linalg.norm(result.points[inner, :2], axis=1).mean()
    assert before > 0.5 * 0.01
    assert after < 0.15 * 0.01


def test_all_around_is_not_spoilt():
    """Scanned from all around and noisy, points come nearer to the axis."""
    points = _half_tube(0.008, 0.001, arc=2 * np.pi)
    result = contract(points)
    before = np.linalg.norm(result.drawn[:, :2], axis=1).mean()
    after = np.linalg.norm(result.points[:, :2], axis=1).mean()
    assert after < before < 0.3 * 0.008


def test_a_leaf_has_no_axis_to_move_to():
    """Points of a flat strip stay on their line: the circle through them is no branch."""
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(-0.02, 0.02, 2000), rng.normal(0, 1e-4, 2000),
                       rng.uniform(0, 0.3, 2000)], axis=1)
    line = points * [0.02, 1, 1]
    assert np.abs(recentred(points, line)[:, :2]).max() < 0.004


def test_few_points_are_left_alone():
    """Too few for a circle: nothing is moved."""
    points = np.random.default_rng(0).normal(size=(8, 3))
    np.testing.assert_array_equal(recentred(points, points), points)
