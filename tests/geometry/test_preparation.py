"""Cleaning a cloud: digits, duplicates, outliers, and what is refused."""

import numpy as np
import pytest

from limber.errors import InputError
from limber.geometry.cloud import Cloud
from limber.geometry.preparation import PreparationSettings, prepare

RNG = np.random.default_rng(0)


def _rod(count=2000):
    angle = RNG.uniform(0, 2 * np.pi, count)
    return np.column_stack([0.01 * np.cos(angle), 0.01 * np.sin(angle), RNG.uniform(0, 1, count)])


def test_map_coordinates_lose_no_digits():
    """A rod at UTM coordinates comes out as the rod, to a nanometre."""
    rod, origin = _rod(), np.array([454321.123, 5412345.678, 312.5])
    prepared = prepare(Cloud(rod + origin), 1.0, PreparationSettings(outlier_ratio=0))
    np.testing.assert_allclose(prepared.cloud.points + (prepared.origin - origin), rod, atol=2e-9)


def test_duplicates_and_strays_go():
    """Repeated points and points far from all others are dropped and counted."""
    rod = _rod()
    cloud = Cloud(np.vstack([rod, rod[:100], [[0.5, 0.5, 0.5], [-0.6, 0.3, 0.2]]]))
    counts = prepare(cloud, 1.0).counts
    assert counts["duplicates"] == 100
    assert counts["outliers"] == 2


def test_crop_box_and_voxels():
    """The crop box is in the file's coordinates, voxels in metres."""
    settings = PreparationSettings(crop_low=(-1, -1, 0), crop_high=(1, 1, 500.0), voxel=0.01)
    prepared = prepare(Cloud(_rod() * 1000), 0.001, PreparationSettings(
        crop_low=(-100, -100, 0), crop_high=(100, 100, 500), voxel=0.01))
    assert np.ptp(prepared.cloud.points[:, 2]) == pytest.approx(0.5, abs=0.02)
    assert prepared.counts["thinned"] > 100
    with pytest.raises(InputError, match="crop box holds no points"):
        prepare(Cloud(_rod() + 100), 1.0, settings)


@pytest.mark.parametrize(("points", "complaint"), [
    (np.ones((100, 3)), "at one place"),
    (_rod(40), "has 40 points"),
])
def test_refused(points, complaint):
    """All points equal, or too few of them."""
    with pytest.raises(InputError, match=complaint):
        prepare(Cloud(points), 1.0)


def test_millimetres_taken_for_metres_are_noticed():
    """A kilometre-long branch is a branch in millimetres; the warning has the extent."""
    rod = _rod()
    rod[:2, 2] = 0, 1
    assert "1000 m long" in prepare(Cloud(rod * 1000), 1.0).warnings[0]
