"""Readers in a process of their own: what stops them is their own work, and is named."""

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.io import isolated_readers
from limber.geometry.io.clouds import read_points


@pytest.fixture
def packed(tmp_path):
    """A good LAZ file."""
    import laspy

    content = laspy.create(point_format=3)
    content.header.scales = [1e-4] * 3
    content.x, content.y, content.z = np.random.default_rng(0).uniform(0, 1, (3, 50))
    content.write(tmp_path / "a.laz")
    return tmp_path / "a.laz"


def test_too_much_work_is_named_as_that(packed, monkeypatch):
    """A reader that computes for ever is stopped; its file is not called damaged."""
    monkeypatch.setattr(isolated_readers, "_LEAST_SECONDS", 0.0)
    monkeypatch.setattr(isolated_readers, "_SECONDS_PER_MB", 0.0)
    with pytest.raises(InputError, match="s of processor time") as caught:
        read_points(packed)
    assert "damaged" not in str(caught.value)
