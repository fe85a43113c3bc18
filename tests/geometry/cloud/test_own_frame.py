"""A cloud's own frame: the same places wherever its file has it."""

import sys

import numpy as np
import pytest

from limber.geometry.cloud.cloud import OwnFrame

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(3000, 3)) ** 3 * [1.0, 0.3, 0.1]


@pytest.fixture(autouse=True)
def _fresh_draws(monkeypatch):
    """Each test draws anew: what ran before it changes no points."""
    monkeypatch.setattr(sys.modules[__name__], "RNG", np.random.default_rng(0))


def test_places_are_the_same_digits_for_a_cloud_moved_turned_and_shuffled() -> None:
    """Not nearly so: nothing that compares two of them can come out otherwise."""
    turn = np.linalg.qr(RNG.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    order = RNG.permutation(len(POINTS))
    first = OwnFrame.of(POINTS)
    for changed in (POINTS + [50.0, -80.0, 20.0], POINTS @ turn.T, POINTS[order],
                    1e-3 * (1e3 * POINTS)):
        np.testing.assert_array_equal(OwnFrame.of(changed).coordinates, first.coordinates)


def test_the_frame_leads_there_and_back() -> None:
    """Places are the points themselves, to a millionth of the cloud's size."""
    own = OwnFrame.of(POINTS)
    size = np.linalg.norm(np.ptp(POINTS, axis=0))
    np.testing.assert_allclose(own.outside(own.coordinates), POINTS[own.order], atol=1e-6 * size)
    np.testing.assert_allclose(own.outside(own.inside(POINTS)), POINTS, atol=1e-12)
