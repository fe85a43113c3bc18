"""What is refused as no plant, and what is not."""

from types import SimpleNamespace

import numpy as np
import pytest

from limber.core.errors import InputError, places_moved
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.reconstruction import ReconstructSettings, reconstruct_cloud
from limber.geometry.skeleton.plausibility import (
    check_explained,
    shows_round,
    surface_share,
    without_volumes,
)
from limber.geometry.skeleton.radii.fit_kernels import nearest_cylinders
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.skeletonise import skeletonise


def test_rods_that_leaves_became_show_nothing_round() -> None:
    """Points that fill rods are told from points on them, however many are explained by either."""
    axis = np.stack([np.zeros(40), np.zeros(40), np.linspace(0, 0.5, 40)], axis=1)
    skeleton = Skeleton.from_edges(axis, np.arange(40) - 1, np.full(40, 0.01))
    result = SimpleNamespace(skeleton=skeleton, node_of_point=np.arange(40), noise=0.002)
    assert shows_round(result)
    result.noise = 0.004
    assert not shows_round(result)


def test_points_off_all_axes_are_named_with_their_place() -> None:
    """Their number, share and distance, a place among them in the file's coordinates, and the
    options."""
    axis = np.stack([np.zeros(40), np.zeros(40), np.linspace(0, 0.5, 40)], axis=1)
    skeleton = Skeleton.from_edges(axis, np.arange(40) - 1, np.full(40, 0.01))
    points = axis + [0.01, 0.0, 0.0]
    points[30:, 0] = 0.1
    result = SimpleNamespace(skeleton=skeleton, node_of_point=np.arange(40), noise=0.001,
                             residual=points[:, 0] - 0.01, leafy=False)
    check_explained(result, 0.3, points, np.any)
    check_explained(result, 0.2, points, lambda off: False)
    with (pytest.raises(InputError, match=r"^10 points \(25 %\).* 90 mm.*--unexplained 1") as no,
          places_moved(lambda place: 1000 * np.array(place) + 7)):
        check_explained(result, 0.2, points, np.any)
    assert f"{no.value.place[0]:.3f}" in str(no.value)
    assert no.value.place[0] == pytest.approx(107) and 387 < no.value.place[2] <= 507
    result.residual = np.where(np.arange(40) < 18, 0.0, 0.09)
    with pytest.raises(InputError, match=r"^22 points \(55 %\)"):
        check_explained(result, 0.3, points, lambda off: False)


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["rough ball", "half ball", "heap", "can"])
def test_what_has_no_axis_is_refused(shape: str) -> None:
    """Balls, seen whole or from one side, a filled box and a can are no branches."""
    rng = np.random.default_rng(12)
    ball = rng.normal(size=(4000, 3))
    ball /= np.linalg.norm(ball, axis=1)[:, None]
    angle = rng.uniform(0, 2 * np.pi, 4000)
    points = {"rough ball": 0.1 * ball * (1 + 0.05 * rng.normal(size=(4000, 1))),
              "half ball": 0.1 * ball[ball[:, 0] > 0],
              "heap": rng.random((4000, 3)) * [0.5, 0.5, 0.7],
              "can": np.column_stack([0.1 * np.cos(angle), 0.1 * np.sin(angle),
                                      rng.uniform(0, 0.3, 4000)])}[shape]
    with pytest.raises(InputError, match="not have the shape of a branch"):
        skeletonise(points)


# Whether points lie on a surface around the axes, or all through the sections.

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


def test_scattered_points_show_a_length_but_no_volume():
    """A tree of an airborne scan, 60 points."""
    points = np.random.default_rng(0).normal(size=(60, 3)) * [0.06, 0.06, 0.5]
    made = reconstruct_cloud(Cloud(points), ReconstructSettings(root="auto"))
    assert made.numbers["surface_share"] == 0 and made.numbers["volume_interval_m3"] is None
    assert 1.2 < made.numbers["length_m"] < 2.6
    assert any("The volume is unresolved" in text for text in made.numbers["skeleton_warnings"])


def test_an_unresolved_volume_is_no_number():
    assert without_volumes(0.9) == {"surface_share": 0.9}
    told = without_volumes(0.3)
    assert told["surface_share"] == 0.3 and len(told) == 5
    assert all(told[name] is None for name in told if "volume" in name)
