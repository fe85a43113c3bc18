"""Length and volume of wood that is not known exactly: doubted twigs, radii, and whole scans."""

from dataclasses import replace

import numpy as np
import pytest
from tests.subjects.grown import grown

from limber.core.errors import InputError
from limber.geometry.skeleton.alternatives import SearchDoubts
from limber.geometry.skeleton.confidence import PLACED, likely
from limber.geometry.skeleton.qsm_tables import (
    Caliper,
    against_calipers,
    by_order,
    diameters_at_heights,
    read_calipers,
)
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.totals import total_length, total_volume, totals
from limber.geometry.surface.tubes import branch_surface


def _doubtful() -> Skeleton:
    """A stem of 1 m, a twig of 0.3 m with one of 0.15 m on it, in steps of a centimetre."""
    return grown((-1, (0, 0, 0), (0, 0, 1), 101, 0.008),
                 (50, (0, 0, 0.5), (0.3, 0, 0.5), 31, 0.004),
                 (110, (0.1, 0, 0.5), (0.1, 0.15, 0.5), 16, 0.003))


def _with_chances(tree: Skeleton, side: float, last: float) -> Skeleton:
    """The same with stated probabilities: of the twig on the stem, and of that on the twig."""
    on_side = np.flatnonzero((tree.nodes[:, 0] > 0) & (tree.nodes[:, 1] == 0))
    chance = np.ones(tree.node_count)
    chance[on_side], chance[tree.nodes[:, 1] > 0] = side, last
    return replace(tree, probability=chance)


def test_doubted_twigs_count_by_their_probability() -> None:
    """Mean and deviation are those of 40,000 draws, in which a twig goes with its carrier, the
    odds of all twigs are off together, and wood whose fork is elsewhere is there."""
    tree = _with_chances(_doubtful(), 0.8, 0.5)
    rng = np.random.default_rng(0)
    together = rng.normal(0, 0.9, 40_000)

    def drawn_with(chance: float) -> np.ndarray:
        odds = np.log(chance / (1 - chance)) + together
        return rng.uniform(size=40_000) < 1 / (1 + np.exp(-odds))
    side = drawn_with(0.8 / PLACED)
    last = side & drawn_with(0.5 / 0.8 / PLACED)
    drawn = 1 + 0.3 * side + 0.15 * last
    found = total_length(tree)
    assert found.expected == pytest.approx(drawn.mean(), abs=0.015)
    assert found.sigma == pytest.approx(np.hypot(drawn.std(), 0.015), rel=0.1)
    sure = total_length(_doubtful())
    assert sure.expected == pytest.approx(1.45) and sure.sigma < 0.02


def test_a_dropped_twig_still_counts_by_its_probability() -> None:
    """Whether a twig just stays or is just dropped hardly changes what is to be expected."""
    stays, goes = (likely(_with_chances(_doubtful(), 0.99, chance), 0.5) for chance in (0.51, 0.49))
    assert stays[0].branch_count == goes[0].branch_count + 1
    kept, dropped = (total_length(skeleton, SearchDoubts(unlikely=unlikely))
                     for skeleton, unlikely in (stays, goes))
    assert kept.expected == pytest.approx(dropped.expected, abs=0.008)
    assert kept.sigma == pytest.approx(dropped.sigma, rel=0.05)
    assert kept.interval[0] < stays[0].length < kept.interval[1]


def test_volume_is_that_of_the_surface() -> None:
    """Of sure wood: what twigs have inside their carriers is not counted twice."""
    tree = _doubtful()
    found = total_volume(tree)
    assert found.expected == pytest.approx(branch_surface(tree, sides=24).volume, rel=0.02)
    assert found.sigma == 0 and totals(tree)["volume_interval_m3"] is None


def test_errors_of_radii_average_out_but_for_what_all_share() -> None:
    """Of deviations of 5 % each, all share what the surest has; over 10 radii they go together."""
    tree = _doubtful()
    same = total_volume(replace(tree, radius_sigma=0.05 * tree.radius))
    assert same.sigma == pytest.approx(2 * 0.05 * same.expected)
    sure = np.where(tree.nodes[:, 2] < 0.2, 0.0, 0.05) * tree.radius
    apart = total_volume(replace(tree, radius_sigma=sure))
    stem = np.pi * 0.008**2 * 1.0
    expected = 0.1 * stem * np.sqrt(0.8 * 0.08)  # blocks of 8 cm of the stem's upper 80 cm
    assert apart.sigma == pytest.approx(expected, rel=0.15)
    assert apart.interval[0] > 0


# Tables of a cylinder model, against what a cone and a stem with a twig have.


def _cone() -> Skeleton:
    """A cone of 1 m from 20 to 10 mm radius, with a twig of 0.2 m and 5 mm at its middle."""
    tree = grown((-1, (0, 0, 0), (0, 0, 1), 51, (0.02, 0.01)),
                 (25, (0, 0, 0.5), (0.2, 0, 0.5), 11, 0.005))
    return replace(tree, radius_sigma=0.02 * tree.radius)


def test_orders_and_heights() -> None:
    """Length, volume and taper are those of a cone and a cylinder; diameters lie on the cone."""
    stem, twig = by_order(_cone())
    assert (stem["branch_count"], twig["branch_count"]) == (1, 1)
    assert stem["length_m"] == pytest.approx(1) and twig["length_m"] == pytest.approx(0.2)
    assert stem["volume_m3"] == pytest.approx(np.pi / 3 * (4e-4 + 2e-4 + 1e-4), rel=1e-3)
    assert twig["volume_m3"] == pytest.approx(np.pi * 25e-6 * 0.2)
    assert stem["taper"] == pytest.approx(0.01)
    for row in diameters_at_heights(_cone()):
        assert row["diameter_m"] == pytest.approx(0.04 - 0.02 * row["share"])
        assert row["sigma_m"] == pytest.approx(0.02 * row["diameter_m"])


def test_calipers(tmp_path) -> None:
    """A caliper's value beside ours, in per cent and deviations; bad files and places are named."""
    path = tmp_path / "c.csv"
    path.write_text("along_m,diameter_mm\n0.5,30\n1.0,19\n")
    first, second = against_calipers(_cone(), read_calipers(path))
    assert first["difference"] == pytest.approx(0) and second["difference"] == pytest.approx(1 / 19)
    assert second["sigmas"] == pytest.approx(0.001 / (0.02 * 0.02))
    with pytest.raises(InputError, match="main path is 1 m"):
        against_calipers(_cone(), [Caliper(1.5, 0.02)])
    path.write_text("height,diameter_mm\n0.5,30\n")
    with pytest.raises(InputError, match="lacks the columns along_m"):
        read_calipers(path)
