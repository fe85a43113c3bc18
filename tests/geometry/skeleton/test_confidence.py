"""What a scan leaves open is said: gaps, unresolved twigs, doubtful ones."""

from dataclasses import replace

import numpy as np
import pytest
from tests.subjects.grown import grown

from limber.geometry.io.skeletons import read_cylinders, write_cylinders
from limber.geometry.skeleton.confidence import (
    DoubtfulKind,
    assessed,
    doubted,
    doubtful_parts,
    likely,
    shares,
)
from limber.geometry.skeleton.run_ends import tapered
from limber.geometry.skeleton.skeleton import (
    BRIDGED,
    INTERPOLATED,
    LIMITED,
    MEASURED,
    UNRESOLVED,
    Skeleton,
)


def _tube(low, high, radius, count, seed=0):
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle),
                     rng.uniform(low, high, count)], axis=1)


def _stem(radius: float, twig: float) -> Skeleton:
    """A stem of 0.4 m along z, and a twig along x from its middle."""
    return grown((-1, (0, 0, 0), (0, 0, 0.4), 41, radius),
                 (20, (0, 0, 0.2), (0.1, 0, 0.2), 21, twig))


def _twig_points(radius: float, count: int) -> np.ndarray:
    return _tube(0.008, 0.1, radius, count, seed=1)[:, [2, 1, 0]] + [0, 0, 0.2]


def test_gaps_and_thin_twigs_are_said(tmp_path) -> None:
    """A stretch without points is bridged; a twig under one spacing is unresolved, and its
    interval is wide; the file keeps it all."""
    points = np.vstack([_tube(0, 0.08, 0.008, 1500), _tube(0.14, 0.4, 0.008, 4500, seed=2),
                        _twig_points(0.0015, 30)])
    told = assessed(_stem(0.008, 0.0015), points, 0.0003)
    z, stem = told.nodes[:, 2], told.branch == 0
    assert set(told.radius_state[stem & (z > 0.09) & (z < 0.13)]) == {BRIDGED}
    assert set(told.radius_state[stem & (z > 0.16)]) == {MEASURED}
    twig = told.branch == 1
    assert set(told.radius_state[twig][10:]) <= {UNRESOLVED, BRIDGED}
    assert (told.radius_sigma[twig] > 0.2 * told.radius[twig])[10:].all()
    share = shares(told)
    assert sum(share.values()) == pytest.approx(1) and 0.08 < share["bridged"] < 0.2
    write_cylinders(told, tmp_path / "s.csv")
    back = read_cylinders(tmp_path / "s.csv")
    np.testing.assert_array_equal(back.radius_state[1:], told.radius_state[1:])
    np.testing.assert_allclose(back.probability[1:], told.probability[1:], atol=6e-4)
    # Two nodes at one place are read as one, and the others keep what was said of them.
    twice = told.nodes.copy()
    twice[20] = twice[19]
    write_cylinders(told.moved(twice), tmp_path / "t.csv")
    once = read_cylinders(tmp_path / "t.csv")
    assert once.node_count == told.node_count - 1
    np.testing.assert_allclose(once.probability[20:], told.probability[21:], atol=6e-4)


def test_a_twig_with_more_points_is_surer() -> None:
    """Probability grows with the points; a stem is sure, where noise is small against it; a carrier
    is no less sure than its twig."""
    sure = []
    for count in (4, 60, 900):
        points = np.vstack([_tube(0, 0.4, 0.008, 6000), _twig_points(0.004, count)])
        told = assessed(_stem(0.008, 0.004), points, 0.0003)
        assert (told.probability[told.branch == 0] > 0.98).all()
        assert told.probability[told.branch == 1].max() <= told.probability.max()
        sure.append(float(told.probability[told.branch == 1][0]))
    assert sure[0] < sure[1] < sure[2] < 1 and sure[2] > 0.95


def test_a_forks_probability_is_its_twigs_not_that_of_the_gap_at_its_foot() -> None:
    """What lies in the gap may be elsewhere; that the twig is there its points tell."""
    stem, twig = _stem(0.008, 0.004), _twig_points(0.004, 900)
    nodes = stem.nodes.copy()
    nodes[41:, 0] = np.linspace(0.02, 0.1, 20)
    around = _tube(0, 0.4, 0.008, 6000)
    points = np.vstack([around[(around[:, 0] < 0) | (np.abs(around[:, 2] - 0.2) > 0.01)],
                        twig[twig[:, 0] > 0.06]])
    told = assessed(stem.moved(nodes), points, 0.0003)
    fork, *rest = told.probability[told.branch == 1]
    assert set(told.radius_state[told.branch == 1][:8]) == {BRIDGED}
    assert fork >= max(rest) and rest[0] < fork - 0.02 and 0.5 < fork < 1


def test_gaps_and_noise_make_places_doubtful() -> None:
    """A node in a gap is less sure the longer the gap, and a thin stem in noise less than a thick.
    """
    sure = []
    for end in (0.14, 0.3):
        points = np.vstack([_tube(0, 0.1, 0.008, 2000), _tube(end, 0.4, 0.008, 2000, seed=2)])
        told = assessed(_stem(0.008, 0.004).subset(np.arange(61) < 41), points, 0.0003)
        sure.append(float(told.probability[(told.nodes[:, 2] > 0.11) & (
            told.nodes[:, 2] < 0.13)].max()))
    assert sure[1] < sure[0] < 0.995
    points = _tube(0, 0.4, 0.004, 4000)
    clear, noisy = (assessed(_stem(0.004, 0.002).subset(np.arange(61) < 41), points, noise)
                    for noise in (0.0003, 0.003))
    assert noisy.probability[20] < clear.probability[20]


def test_an_unresolved_radius_goes_by_the_resolved_part_of_its_branch() -> None:
    """A fit that collapsed below the noise is not believed: the branch above it says more, and the
    interval holds the truth."""
    skeleton = _stem(0.008, 0.004).subset(np.arange(61) < 41)
    radius = np.where(skeleton.nodes[:, 2] > 0.3, 0.003, skeleton.radius)
    told = assessed(Skeleton.from_edges(skeleton.nodes, skeleton.parent, radius),
                    _tube(0, 0.4, 0.008, 4000), 0.004)
    top = told.nodes[:, 2] > 0.3
    assert set(told.radius_state[top]) == {UNRESOLVED}
    assert (np.abs(told.radius - 0.008) < 1.96 * told.radius_sigma)[top].all()


def test_what_is_filled_in_limits_no_radius() -> None:
    """A stem that starts thin, where there were no points, may be thicker where it was measured;
    one that was measured thin may not."""
    stem = _stem(0.008, 0.004).subset(np.arange(61) < 41)
    radius = np.where(np.arange(41) < 12, 0.002, 0.006)
    for first, limited in ((INTERPOLATED, False), (MEASURED, True)):
        state = np.where(np.arange(41) < 12, first, MEASURED).astype(np.int8)
        told = tapered(Skeleton.from_edges(stem.nodes, stem.parent, radius, radius_state=state))
        assert (told.radius_state == LIMITED).any() == limited


def test_twigs_more_likely_not_there_are_dropped_and_told() -> None:
    """A twig without points goes, with place and length; one of many stays."""
    points = np.vstack([_tube(0, 0.4, 0.008, 6000), _twig_points(0.004, 900)])
    sure = assessed(_stem(0.008, 0.004), points, 0.0003)
    assert likely(sure, 0.5)[0] is sure and likely(sure, 0.5)[1] == []
    told = assessed(_stem(0.008, 0.004), _tube(0, 0.4, 0.008, 6000), 0.0003)
    assert likely(told, 0.0)[0].branch_count == 2 and likely(told, 0.5)[0].branch_count == 1
    twig = likely(told, 0.5)[1][0]
    assert twig["length"] == pytest.approx(0.1) and twig["probability"] < 0.5
    assert twig["at"] == pytest.approx([0.1, 0, 0.2])


def test_axes_through_leaves_are_doubted_as_others_are() -> None:
    """Without a fit too a twig of few points is less sure than the stem; radii stay."""
    points = np.vstack([_tube(0, 0.4, 0.008, 6000), _twig_points(0.004, 20)])
    stem = _stem(0.008, 0.004)
    told = doubted(stem, points, 0.0003)
    assert told.probability[told.branch == 1].max() < 0.95 < told.probability[5]
    np.testing.assert_array_equal(told.radius, stem.radius)


def test_a_rag_at_the_foot_does_not_make_a_hair_of_the_stem() -> None:
    """3 mm of 0.05 mm radius, in 60 nodes, below a stem of 1 mm: that keeps its radius. A bundle
    of 3 mm at the end of the same stem, in points as many, does not."""
    rag, stem = np.linspace(0, 0.003, 61), 0.003 + 0.001 * np.arange(1, 41)
    z = np.concatenate([rag, stem])
    axis = np.stack([0 * z, 0 * z, z], axis=1)
    radius = np.where(z <= 0.003, 5e-5, 1e-3)
    told = tapered(Skeleton.from_edges(axis, np.arange(len(z)) - 1, radius))
    np.testing.assert_allclose(told.radius[61:], 1e-3)
    swollen = np.where(z > 0.03, 3e-3, 1e-3)
    told = tapered(Skeleton.from_edges(axis, np.arange(len(z)) - 1, swollen))
    assert told.radius.max() < 1.3e-3 and (told.radius_state[z > 0.03] != 0).all()


# Doubtful parts: each kind is found where it was made, and a sound skeleton has none.


def test_a_sound_skeleton_has_no_doubtful_parts(y_skeleton) -> None:
    """A fork of 37 degrees is no kink."""
    assert doubtful_parts(y_skeleton) == []


def test_each_doubt_is_found_with_its_place(y_skeleton) -> None:
    """An unlikely twig, an unresolved and a limited stretch, a gap: length, radius and value."""
    state = y_skeleton.radius_state.copy()
    state[1:3], state[3:6], state[8:10] = LIMITED, BRIDGED, UNRESOLVED
    sigma = np.where(state == UNRESOLVED, 0.4 * y_skeleton.radius, 0.0)
    told = doubtful_parts(replace(
        y_skeleton, radius_state=state, radius_sigma=sigma,
        probability=np.where(y_skeleton.branch == 1, 0.3, 1.0)))
    assert [uncertainty.kind for uncertainty in told] == [
        DoubtfulKind.unlikely, DoubtfulKind.unresolved, DoubtfulKind.limited,
        DoubtfulKind.bridged]
    unlikely, unresolved, limited, bridged = told
    assert unlikely.branch == 1 and unlikely.value == pytest.approx(0.3)
    np.testing.assert_allclose(unlikely.at, y_skeleton.nodes[11])  # deleting there leaves no stub
    in_gap = np.where(np.arange(16) == 9, 0.5, 1.0)  # of a stem that is there on both sides
    assert not doubtful_parts(replace(y_skeleton, probability=in_gap))
    assert unresolved.length == pytest.approx(0.1) and unresolved.value == pytest.approx(0.4)
    assert limited.length == pytest.approx(0.1) and limited.branch == 0
    assert bridged.length == pytest.approx(0.15)
    np.testing.assert_allclose(bridged.at, y_skeleton.nodes[4])


def test_a_radius_jump_is_found_where_no_fork_explains_it() -> None:
    """Half as thick within four radii; the same beside a fork with a twig is no jump."""
    z = np.arange(0, 0.4, 0.004)
    nodes = np.outer(z, [0, 0, 1.0])
    radius = np.where(z < 0.2, 0.01, 0.0055)
    told = doubtful_parts(Skeleton.from_edges(nodes, np.arange(-1, 99), radius))
    assert [part.kind for part in told] == [DoubtfulKind.jump]
    assert told[0].value == pytest.approx(0.55) and abs(told[0].at[2] - 0.2) < 0.01
    twig = np.outer(np.arange(0.004, 0.1, 0.004), [1.0, 0, 0]) + [0, 0, 0.2]
    forked = Skeleton.from_edges(np.vstack([nodes, twig]), np.r_[
        np.arange(-1, 99), 50, 100 + np.arange(len(twig) - 1)], np.r_[
            radius, np.full(len(twig), 0.004)])
    assert doubtful_parts(forked) == []


def test_kinks_and_backward_starts_are_found() -> None:
    """A stem that turns by 90 degrees, and a twig that starts down along it."""
    z, x = np.linspace(0, 0.2, 21), np.linspace(0.01, 0.2, 20)
    stem = np.vstack([np.stack([0 * z, 0 * z, z], axis=1), np.stack([x, 0 * x, 0 * x + 0.2], 1)])
    down = np.stack([0 * z[1:6], 0.004 + 0 * z[1:6], 0.1 - z[1:6]], axis=1)
    skeleton = Skeleton.from_edges(
        np.vstack([stem, down]), np.concatenate([np.arange(41) - 1, [10], 41 + np.arange(4)]),
        np.full(46, 0.006))
    told = {uncertainty.kind: uncertainty for uncertainty in doubtful_parts(skeleton)}
    assert set(told) == {DoubtfulKind.kink, DoubtfulKind.backwards}
    np.testing.assert_allclose(told[DoubtfulKind.kink].at, [0, 0, 0.2], atol=1e-9)
    assert told[DoubtfulKind.kink].value == pytest.approx(np.pi / 2, abs=0.01)
    assert told[DoubtfulKind.backwards].value > np.deg2rad(150)
