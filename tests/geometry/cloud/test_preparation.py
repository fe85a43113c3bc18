"""Cleaning a cloud: digits, duplicates, outliers, and what is refused."""


import sys

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.preparation import PreparationSettings, prepare
from limber.geometry.cloud.surroundings import find_sheet
from limber.geometry.generated import generate_branch
from limber.geometry.settings import OPEN

RNG = np.random.default_rng(0)


@pytest.fixture(autouse=True)
def _fresh_draws(monkeypatch):
    """Each test draws anew: what ran before it changes no points."""
    monkeypatch.setattr(sys.modules[__name__], "RNG", np.random.default_rng(0))


def _rod(count=2000):
    angle = RNG.uniform(0, 2 * np.pi, count)
    return np.column_stack([0.01 * np.cos(angle), 0.01 * np.sin(angle), RNG.uniform(0, 1, count)])


def test_map_coordinates_lose_no_digits():
    """A rod at UTM coordinates comes out as the rod, to a nanometre."""
    rod, origin = _rod(), np.array([454321.123, 5412345.678, 312.5])
    prepared = prepare(Cloud(rod + origin), 1.0)
    np.testing.assert_allclose(prepared.cloud.points + (prepared.origin - origin), rod, atol=2e-9)


def test_duplicates_and_strays_go():
    """Repeated points and points far from all others are dropped and counted."""
    rod = _rod()
    cloud = Cloud(np.vstack([rod, rod[:100], [[0.5, 0.5, 0.5], [-0.6, 0.3, 0.2]]]))
    counts = prepare(cloud, 1.0).counts
    assert counts["duplicates"] == 100
    assert counts["outliers"] == 2


def test_the_background_shows_its_strays():
    """Stray points near a rod go too if its background has as many; without one, nothing goes."""
    rod = _rod(4000) + RNG.normal(0, 5e-4, (4000, 3))
    strays = RNG.uniform([-0.05, -0.05, 0.0], [0.05, 0.05, 1.0], (200, 3))
    assert prepare(Cloud(rod), 1.0).counts["outliers"] == 0
    kept = prepare(Cloud(np.vstack([rod, strays]), {"index": np.arange(4200.0)}),
                   1.0).cloud.attributes["index"]
    assert (kept >= 4000).sum() < 40  # on and in the rod, or nearly
    assert (kept < 4000).sum() >= 3990


def test_ground_leaves_the_plant_its_outliers():
    """How isolated a plant's points are does not depend on denser ground under it."""
    points, up = generate_branch(73, noise=5e-4).cloud.points, np.array([0.0, 0.0, 1.0])
    sparse = points[:, 2] >= 0.3
    points = np.vstack([points[~sparse], points[sparse][::20]])
    ground = np.column_stack([RNG.uniform(-0.4, 0.4, (20_000, 2)), RNG.normal(
        points[:, 2].min() - 0.005, 0.001, 20_000)])
    bare, both = (prepare(Cloud(cloud), 1.0, up=up)
                  for cloud in (points, np.vstack([points, ground])))
    high, same = (prepared.cloud.points + prepared.origin for prepared in (bare, both))
    assert both.counts["sheets"] + both.counts.get("ground", 0) > 19_900
    np.testing.assert_allclose(high[high[:, 2] > 0.02], same[same[:, 2] > 0.02])


def test_crop_box():
    """The crop box is in the file's coordinates."""
    settings = PreparationSettings(crop=(-1, -1, 0, 1, 1, 500.0))
    prepared = prepare(Cloud(_rod() * 1000), 0.001, PreparationSettings(
        crop=(-100, -100, 0, 100, 100, 500)))
    assert np.ptp(prepared.cloud.points[:, 2]) == pytest.approx(0.5, abs=0.02)
    with pytest.raises(InputError, match="crop box holds no points"):
        prepare(Cloud(_rod() + 100), 1.0, settings)


@pytest.mark.parametrize(("points", "complaint"), [
    (np.ones((100, 3)), "at the same position"),
    (_rod(40), "has 40 points"),
])
def test_refused(points, complaint):
    """All points equal, or too few of them."""
    with pytest.raises(InputError, match=complaint):
        prepare(Cloud(points), 1.0)


def _plane(count: int, side: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-side / 2, side / 2, (count, 2)),
                            rng.normal(0, 0.002, count)])


@pytest.mark.parametrize("turned", [False, True])
def test_ground_and_walls_are_cut_out(turned):
    """A branch on the ground or before a wall is the branch; the user may keep the sheet."""
    branch = generate_branch(71, length=0.6).cloud.points
    plane = _plane(2 * len(branch), 1.0, 71)
    if turned:
        plane = plane[:, [0, 2, 1]] + [0.0, 0.3, 0.3]
    both = Cloud(np.vstack([branch, plane]))
    prepared = prepare(both, 1.0)
    assert prepared.counts["sheets"] > 0.99 * len(plane)
    assert len(prepared.cloud) > 0.97 * len(branch)
    (told,) = (text for text in prepared.warnings if "flat sheet" in text)
    assert np.abs(plane - told.place).sum(axis=1).min() < 1e-3
    assert len(prepare(both, 1.0, PreparationSettings(keep=("sheets",))).cloud) == len(both)


@pytest.mark.slow
def test_branches_are_no_sheets():
    """Stout, one-sided, noisy, sparse and flat-grown plants lose nothing."""
    for spec in ({"radius_root": 0.04, "length": 0.3}, {"view": "one-sided", "radius_root": 0.03},
                 {"noise": 0.003}, {"point_spacing": 0.006}, {"fork_count": 8}):
        cloud = generate_branch(72, **spec).cloud
        assert prepare(cloud, 1.0).counts["sheets"] == 0, spec
        flat = cloud.points * [1.0, 0.2, 1.0]  # as a trained fruit tree is
        assert prepare(Cloud(flat), 1.0).counts.get("sheets", 0) == 0, spec


@pytest.mark.parametrize("count", [120, 400, 1400, 20_000])
def test_a_fan_is_no_wall_and_a_shadowed_wall_is(count):
    """Twigs side by side in a plane fill it by cells of few points; once they were taken out. A
    wall with the shadows of twigs is one, however few of its points were scanned."""
    foot, flat = RNG.uniform(0, 1, (2, count))
    twig, slope = RNG.integers(0, 9, count), RNG.uniform(-0.3, 0.3, 9)
    wide = 0.1 * twig + slope[twig] * flat + RNG.normal(0, 3e-3, count)
    fan = np.column_stack([wide, RNG.normal(0, 1e-3, count), flat])
    assert find_sheet(fan, 0.08 * count).probability < 1 - OPEN
    wall = np.column_stack([foot, RNG.normal(0, 1e-3, count), flat])
    sheet = find_sheet(wall[np.abs(foot - 0.5 - 0.3 * (flat - 0.5)) > 0.03], 0.08 * count)
    assert len(sheet.points) > 0.8 * count and sheet.probability > 0.5


@pytest.mark.parametrize("is_kept", [True, False])
def test_a_sheet_near_even_is_asked_about(is_kept):
    """Many crossing twigs in a plane beside a branch: points do not tell them from a wall. What is
    done is said, with the option that does the other, which settles it."""
    rng = np.random.default_rng(5 if is_kept else 3)
    branch, flat = generate_branch(71, length=0.9).cloud.points, rng.uniform(0, 1, 1400)
    twig, slope = rng.integers(0, 20, 1400), rng.uniform(-0.3, 0.3, 20)
    wide = 0.045 * twig + slope[twig] * flat + rng.normal(0, 0.01, 1400)
    fan = np.column_stack([wide - 0.5, 0.4 + rng.normal(0, 1e-3, 1400), flat])
    both = Cloud(np.vstack([branch[rng.permutation(len(branch))[:1500]], fan]))
    prepared = prepare(both, 1.0)
    (asked,) = (text for text in prepared.warnings if "or the plant's?" in text)
    (option,) = asked.named
    assert np.abs(fan - asked.place).sum(axis=1).min() < 1e-3
    settled = prepare(both, 1.0, PreparationSettings(**{option.name: option.value}))
    assert "or the plant's?" not in " ".join(settled.warnings)
    assert (prepared.counts["sheets"] == 0) is (len(settled.cloud) < 1550) is is_kept


def test_two_flat_neighbourhoods_are_no_plane():
    """Clumps of six points strewn in a box: once a crash, where only two lay in one plane."""
    rng = np.random.default_rng([91, 1])
    clumps = rng.uniform(-0.5, 0.5, (2000, 1, 3)) + rng.normal(scale=1e-3, size=(2000, 6, 3))
    assert find_sheet(clumps.reshape(-1, 3), 960) is None


def test_lost_digits_are_told():
    """Map coordinates in single precision are refused; coarse rounding is told."""
    points = generate_branch(73).cloud.points
    far = points + [500_000.0, 4.6e6, 120.0]
    assert len(prepare(Cloud(far), 1.0).cloud) == len(points)
    with pytest.raises(InputError, match=r"resolution of 0\.5"):
        prepare(Cloud(far.astype(np.float32).astype(float)), 1.0)
    near = (points + [500.0, 4600.0, 12.0]).astype(np.float32).astype(float)
    assert not prepare(Cloud(near), 1.0).warnings
    assert "rounded to 5 mm" in " ".join(prepare(Cloud(np.round(points / 5e-3) * 5e-3),
                                                 1.0).warnings)


def test_a_line_is_no_branch():
    """Points without any thickness are refused before they reach the solver."""
    line = np.linspace(0, 1, 500)[:, None] * [0.3, 0.2, 1.0]
    with pytest.raises(InputError, match="straight line"):
        prepare(Cloud(line), 1.0)


def test_leaves_are_no_sheets(tomato):
    """The lower half of a leafy seedling, where two leaves lie flat, keeps them."""
    points = tomato.points / 1000
    for axis in range(3):
        middle = (points[:, axis].min() + points[:, axis].max()) / 2
        for half in (points[points[:, axis] < middle], points[points[:, axis] > middle]):
            sheet = find_sheet(half, 0.08 * len(half))
            assert sheet is None or sheet.probability < 1 - OPEN
