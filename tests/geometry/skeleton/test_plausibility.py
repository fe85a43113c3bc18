"""What is refused as no plant, and what is not."""

from types import SimpleNamespace

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.skeleton.plausibility import check_explained, shows_round
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
    """Their share, a place among them in the file's coordinates, and the options."""
    axis = np.stack([np.zeros(40), np.zeros(40), np.linspace(0, 0.5, 40)], axis=1)
    skeleton = Skeleton.from_edges(axis, np.arange(40) - 1, np.full(40, 0.01))
    points = axis + [0.01, 0.0, 0.0]
    points[30:, 0] = 0.1
    result = SimpleNamespace(skeleton=skeleton, node_of_point=np.arange(40), noise=0.001,
                             residual=points[:, 0] - 0.01, leafy=False)
    check_explained(result, 0.3, points, lambda place: place, np.any)
    check_explained(result, 0.2, points, lambda place: place, lambda off: False)
    with pytest.raises(InputError, match=r"^25 % of the points.*--crop-low.*--unexplained 1") as no:
        check_explained(result, 0.2, points, lambda place: 1000 * place + 7, np.any)
    where = (np.array(no.value.place) - 7) / 1000
    assert where[0] == pytest.approx(0.1) and 0.38 < where[2] <= 0.5
    result.residual = np.where(np.arange(40) < 18, 0.0, 0.09)
    with pytest.raises(InputError, match=r"^55 %"):
        check_explained(result, 0.3, points, lambda place: place, lambda off: False)


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
