"""Limbs side by side up to their tips: one axis of both is split where the points show two."""

import numpy as np
import pytest
from tests.geometry.skeleton.repair.test_fused_forks import _tube

from limber.geometry.skeleton.fused_limbs import with_split_limbs
from limber.geometry.skeleton.skeleton import Skeleton

_NOISE = 3e-4
_APART, _RADII = 0.018, (0.008, 0.006)


def limbs_side_by_side(arc: float = 2 * np.pi) -> tuple[Skeleton, np.ndarray]:
    """A stem up to 0.15 m, and two limbs from there to 0.4 and 0.36 m; one axis between them."""
    rng = np.random.default_rng(2)
    points = [_tube(np.zeros(3), np.array([0, 0, 0.15]), 0.012, rng, arc)]
    for x, radius, top in zip((0, _APART), _RADII, (0.4, 0.36), strict=True):
        points.append(_tube(np.array([x, 0, 0.15]), np.array([x, 0, top]), radius, rng, arc))
    z = np.arange(0, 0.4, 0.006)
    middle = np.where((z > 0.15) & (z < 0.36), _APART / 2, 0.0)
    radius = np.select([z <= 0.15, z < 0.36], [0.012, 0.013], 0.008)
    skeleton = Skeleton.from_edges(np.column_stack([middle, 0 * z, z]), np.arange(len(z)) - 1,
                                   radius)
    every = np.vstack(points)
    return skeleton, every + _NOISE * rng.standard_normal(every.shape)


@pytest.mark.parametrize("arc", [2 * np.pi, np.pi])
def test_limbs_side_by_side_get_an_axis_each(arc: float) -> None:
    """Both within 1.5 mm, from about where they begin to the shorter one's tip; radii within 15 %.
    """
    skeleton, count = with_split_limbs(*limbs_side_by_side(arc), _NOISE)
    assert count == 1 and skeleton.branch_count == 2
    long, short = sorted((run[1:] for run in skeleton.runs()),
                         key=lambda run: -skeleton.nodes[run[-1], 2])
    short = short[skeleton.nodes[short, 2] > 0.16]
    beside = long[(skeleton.nodes[long, 2] > 0.17) & (skeleton.nodes[long, 2] < 0.35)]
    assert skeleton.nodes[short[0], 2] < 0.18 and skeleton.nodes[short[-1], 2] > 0.345
    assert np.abs(skeleton.nodes[short, 0] - _APART).max() < 0.0015
    assert np.abs(skeleton.nodes[beside, 0]).max() < 0.0015
    for nodes, radius in ((beside, _RADII[0]), (short, _RADII[1])):
        assert np.median(skeleton.radius[nodes]) == pytest.approx(radius, rel=0.15)


@pytest.mark.parametrize("noise", [_NOISE, 0.003, 0.006])
def test_one_limb_stays_one(noise: float) -> None:
    """An oval stem, in noise up to most of its radius, and half of it hidden."""
    z = np.arange(0, 0.4, 0.006)
    stem = Skeleton.from_edges(np.outer(z, [0, 0, 1.0]), np.arange(len(z)) - 1,
                               np.full(len(z), 0.009))
    for arc in (2 * np.pi, np.pi):
        rng = np.random.default_rng(3)
        points = _tube(np.zeros(3), np.array([0, 0, 0.4]), 0.008, rng, arc) * [1.35, 1, 1]
        for told in (noise, 0.5 * noise):
            assert with_split_limbs(stem, points + noise * rng.standard_normal(points.shape),
                                    told)[1] == 0
