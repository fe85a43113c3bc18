"""Tables of a cylinder model, against what a cone and a stem with a twig have."""

from dataclasses import replace

import numpy as np
import pytest
from tests.subjects.grown import grown

from limber.core.errors import InputError
from limber.geometry.skeleton.qsm_tables import (
    Caliper,
    against_calipers,
    by_order,
    diameters_at_heights,
    read_calipers,
)
from limber.geometry.skeleton.skeleton import Skeleton


def _tree() -> Skeleton:
    """A cone of 1 m from 20 to 10 mm radius, with a twig of 0.2 m and 5 mm at its middle."""
    tree = grown((-1, (0, 0, 0), (0, 0, 1), 51, (0.02, 0.01)),
                 (25, (0, 0, 0.5), (0.2, 0, 0.5), 11, 0.005))
    return replace(tree, radius_sigma=0.02 * tree.radius)


def test_orders_and_heights() -> None:
    """Length, volume and taper are those of a cone and a cylinder; diameters lie on the cone."""
    stem, twig = by_order(_tree())
    assert (stem["branch_count"], twig["branch_count"]) == (1, 1)
    assert stem["length_m"] == pytest.approx(1) and twig["length_m"] == pytest.approx(0.2)
    assert stem["volume_m3"] == pytest.approx(np.pi / 3 * (4e-4 + 2e-4 + 1e-4), rel=1e-3)
    assert twig["volume_m3"] == pytest.approx(np.pi * 25e-6 * 0.2)
    assert stem["taper"] == pytest.approx(0.01)
    for row in diameters_at_heights(_tree()):
        assert row["diameter_m"] == pytest.approx(0.04 - 0.02 * row["share"])
        assert row["sigma_m"] == pytest.approx(0.02 * row["diameter_m"])


def test_calipers(tmp_path) -> None:
    """A caliper's value beside ours, in per cent and deviations; bad files and places are named."""
    path = tmp_path / "c.csv"
    path.write_text("along_m,diameter_mm\n0.5,30\n1.0,19\n")
    first, second = against_calipers(_tree(), read_calipers(path))
    assert first["difference"] == pytest.approx(0) and second["difference"] == pytest.approx(1 / 19)
    assert second["sigmas"] == pytest.approx(0.001 / (0.02 * 0.02))
    with pytest.raises(InputError, match="main path is 1 m"):
        against_calipers(_tree(), [Caliper(1.5, 0.02)])
    path.write_text("height,diameter_mm\n0.5,30\n")
    with pytest.raises(InputError, match="lacks the columns along_m"):
        read_calipers(path)
