"""Whether points lie on a surface around the axes, or all through the sections."""

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.reconstruction import ReconstructSettings, reconstruct_cloud
from limber.geometry.skeleton.plausibility import surface_share, without_volumes
from limber.geometry.skeleton.radii.fit_kernels import nearest_cylinders
from limber.geometry.skeleton.skeleton import Skeleton

_ROD = Skeleton.from_edges(np.column_stack([np.zeros((60, 2)), np.linspace(0, 1.0, 60)]),
                           np.arange(60) - 1, np.full(60, 0.01))


def _share(height, away):
    turn = np.random.default_rng(3).uniform(0, 2 * np.pi, len(height))
    return surface_share(_ROD, *nearest_cylinders(_ROD, np.column_stack([
        away * np.cos(turn), away * np.sin(turn), height])))


@pytest.mark.parametrize("noise", [0.0005, 0.003])
def test_points_on_a_skin_show_the_volume(noise):
    rng = np.random.default_rng(1)
    assert _share(rng.random(1500), 0.01 + noise * rng.normal(size=1500)) > 0.9


def test_points_all_through_the_sections_show_none_and_half_show_half():
    rng = np.random.default_rng(2)
    height = rng.random(1500)
    filled = np.hypot(*rng.normal(0, 0.008, (2, 1500)))
    assert _share(height, filled) < 0.1
    assert _share(height, np.where(height < 0.5, 0.01 + 0.001 * rng.normal(size=1500),
                                   filled)) == pytest.approx(0.5, abs=0.1)


def test_a_stretch_with_hardly_a_point_shows_nothing():
    assert _share(np.linspace(0, 1, 20), np.full(20, 0.01)) == 0


def test_scattered_points_are_no_wood():
    """A tree of an airborne scan, 60 points: no radius, no volume, no mesh."""
    points = np.random.default_rng(0).normal(size=(60, 3)) * [0.06, 0.06, 0.5]
    with pytest.raises(InputError, match=r"show no surface along .* m of axes"):
        reconstruct_cloud(Cloud(points), ReconstructSettings(root="auto"))


def test_an_unresolved_volume_is_no_number():
    assert without_volumes(0.9) == {"surface_share": 0.9}
    told = without_volumes(0.3)
    assert told["surface_share"] == 0.3 and len(told) == 5
    assert all(told[name] is None for name in told if "volume" in name)
