"""Radii along a run: what few points or none say of them, others on the run say better."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.scan_cases import one_sided_case
from benchmarks.scan_scores import cylinder_volume, seen_part
from limber.geometry.skeleton.run_ends import (
    point_counts,
    steadied,
    tapered,
    unpinched,
)
from limber.geometry.skeleton.skeleton import LIMITED, Skeleton
from limber.geometry.skeleton.skeletonise import skeletonise

RADIUS = 0.006


def _stem(hair: slice, thin: float = 4e-4) -> Skeleton:
    """0.4 m along z in steps of 5 mm, with first radii that are a hair's on a stretch."""
    z = np.linspace(0, 0.4, 81)
    radius = np.full(81, RADIUS)
    radius[hair] = thin
    return Skeleton.from_edges(np.column_stack([0 * z, 0 * z, z]), np.arange(81) - 1, radius)


def _points(count: int = 4000, gap: tuple[float, float] = (0.0, 0.0), seed: int = 0) -> np.ndarray:
    """Of the side of the stem that faces x, none between the heights of ``gap``."""
    rng = np.random.default_rng(seed)
    angle, z = rng.uniform(-1.4, 1.4, count), rng.uniform(0, 0.4, count)
    on = np.column_stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), z])
    return on[(z <= gap[0]) | (z >= gap[1])] + 0.0005 * rng.standard_normal(on.shape)[
        (z <= gap[0]) | (z >= gap[1])]


def test_a_hair_where_points_are_missing_gets_its_neighbours_radius() -> None:
    """And where they are not, radii stay what they were."""
    points = _points(gap=(0.1, 0.2))
    steady = steadied(_stem(slice(21, 40)), points)
    np.testing.assert_allclose(steady.radius, RADIUS)
    z = np.linspace(0, 0.4, 81)
    taper = replace(_stem(slice(0)), radius=0.006 - 0.005 * z)
    np.testing.assert_allclose(steadied(taper, points).radius, taper.radius, rtol=0.03, atol=3e-4)


def test_few_points_at_a_foot_do_not_thin_the_run() -> None:
    """A foot of 60 mm with a point a node limits nothing; with as many as the rest it does."""
    foot = slice(0, 13)
    stem = _stem(foot, thin=0.003)
    for on_foot, limited in ((1, False), (60, True)):
        count = np.full(81, 50)
        count[foot] = on_foot
        told = tapered(stem, count)
        assert (told.radius_state == LIMITED).any() == limited
    assert point_counts(stem, _points()).sum() == 4000


def test_a_foot_of_wide_interval_limits_no_twig() -> None:
    """A foot half as thick as the rest limits that, unless its interval reaches as far."""
    foot = slice(0, 13)
    stem = _stem(foot, thin=0.003)
    for sigma, limited in ((0.0002, True), (0.0016, False)):
        told = tapered(replace(stem, radius_sigma=np.where(np.arange(81) < 13, sigma, 0.0)))
        assert (told.radius_state == LIMITED).any() == limited


def test_a_pinched_stretch_starts_as_thick_as_what_is_beyond() -> None:
    """A tip as thin as that stays."""
    points = _points()
    np.testing.assert_allclose(unpinched(_stem(slice(21, 36)), points).radius, RADIUS)
    tip = _stem(slice(60, 81))
    np.testing.assert_array_equal(unpinched(tip, points).radius, tip.radius)


@pytest.mark.slow
def test_a_scan_with_holes_keeps_its_volume() -> None:
    """One of the bench's cases, seen from one side: it had lost 7 % of its cylinders' volume."""
    case = one_sided_case(1604433927049)
    found = skeletonise(case.points).skeleton
    volume = cylinder_volume(seen_part(case.truth, case.points))
    assert cylinder_volume(found) == pytest.approx(volume, rel=0.05)
