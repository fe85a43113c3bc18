"""Radii under noise: a straight branch seen from all around, or from one side."""

from dataclasses import replace

import numpy as np
import pytest
from tests.subjects.grown import grown

from benchmarks.scan_cases import one_sided_case
from benchmarks.scan_scores import cylinder_volume, seen_part
from limber.geometry.skeleton.radii import visible_sides
from limber.geometry.skeleton.radii.axis_fit import fit_axes, normal_equations
from limber.geometry.skeleton.radii.fit_kernels import match_cylinders
from limber.geometry.skeleton.radii.sensor_effects import (
    mean_positions,
    sensor_smoothing,
    weighted_target_distances,
)
from limber.geometry.skeleton.radii.visible_sides import seen_sides
from limber.geometry.skeleton.radii.wood import ShapeEvidence, likeliest_shape
from limber.geometry.skeleton.skeleton import MEASURED, Skeleton
from limber.geometry.skeleton.skeletonise import skeletonise


def _points(radius: float, noise: float, half: bool, count: int = 3000, seed: int = 0):
    rng = np.random.default_rng(seed)
    # One side is seen up to where generated scans see it: within 6 degrees of grazing.
    reach = np.arccos(0.1) if half else np.pi
    angle = rng.uniform(-reach, reach, count)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle),
                       rng.uniform(0, 0.5, count)], axis=1)
    return points + rng.normal(0, noise, points.shape)


def _axis(radius: float) -> Skeleton:
    return grown((-1, (0, 0, 0), (0, 0, 0.5), 40, radius))


@pytest.mark.slow
@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("share", [0.1, 0.25, 0.4])
def test_radius_under_noise_has_no_bias(half: bool, share: float) -> None:
    """Noise of a tenth to four tenths of the radius moves the radius by less than 6 %.

    The nearest place on the circle taken for the true one, half a circle came out 13 % too thin
    at 0.3 of the radius.
    """
    fit = fit_axes(_axis(0.006), _points(0.006, share * 0.006, half), rounds=30)
    inner = fit.skeleton.radius[5:-5]
    assert np.median(inner) == pytest.approx(0.006, rel=0.06)
    assert fit.noise == pytest.approx(share * 0.006, rel=0.08)


@pytest.mark.parametrize("apart", [0.0, 1e-9, 1e-4])
def test_nodes_that_come_near_each_other_do_not_throw_a_round_off(apart: float) -> None:
    """Whatever is left of their distance: no node moves by more than a radius."""
    start, points = _axis(0.006), _points(0.006, 0.0008, half=False)
    nodes = start.nodes.copy()
    nodes[21, 2] = nodes[20, 2] + apart
    match = match_cylinders(start.moved(nodes), points)
    step = normal_equations(start, nodes, start.radius, match, np.ones(len(points)), 8e-4).solve()
    assert np.linalg.norm(step[:, :3], axis=1).max() < 0.006
    assert np.abs(step[:, 3]).max() < 0.001


@pytest.mark.parametrize("radius", [0.7, 1.0, 2.0, 4.0])
def test_points_lie_at_their_aims_on_average(radius: float) -> None:
    """A third of a circle, noise 1, and weights that end 3 noises and 0.9 of the radius off it."""

    def limit(thick):
        return 0.9 * thick + 3

    rng = np.random.default_rng(3)
    turn = rng.uniform(-1, 1, 400_000)
    true = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    points = radius * true + rng.normal(size=true.shape)
    distance = np.linalg.norm(points, axis=1)
    out = points / distance[:, None]
    weight = np.clip(1 - ((distance - radius) / limit(radius))**2, 0, None)**2
    mean, near = weighted_target_distances(np.array([radius]), 1.0, limit)

    def average(values):
        return np.average(values, weights=weight, axis=0)

    assert average((points * true).sum(axis=1)) == pytest.approx(mean.radius[0], abs=0.01)
    assert average(points - mean.axis * true) == pytest.approx(0, abs=0.01)
    assert average(distance) == pytest.approx(near.radius[0], abs=0.01)
    assert average((distance[:, None] - near.axis) * out) == pytest.approx(0, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("half", [False, True])
def test_noise_of_half_the_radius_is_told_whole(half: bool) -> None:
    """Points over a radius off are left out; without those it came out 10 % too small."""
    fit = fit_axes(_axis(0.006), _points(0.006, 0.003, half, 6000), rounds=30)
    assert fit.noise == pytest.approx(0.003, rel=0.05)


@pytest.mark.parametrize("share", [0.06, 0.12])
def test_a_side_seen_to_the_grazing_angle_has_no_bias_at_any_noise(share: float) -> None:
    """Where noise is low, too, it is the arc's ends that tell the radius: it came out 3 % too thin
    at 0.06 of the radius, and right at 0.12."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(-visible_sides._GRAZING, visible_sides._GRAZING, 6000)
    points = np.stack([0.006 * np.cos(angle), 0.006 * np.sin(angle), rng.uniform(0, 0.5, 6000)],
                      axis=1) + rng.normal(0, share * 0.006, (6000, 3))
    fit = fit_axes(_axis(0.006), points, rounds=20, uncertainty=False)
    assert np.median(fit.skeleton.radius[5:-5]) == pytest.approx(0.006, rel=0.012)


def test_a_strip_of_a_half_hidden_branch_is_no_thin_branch() -> None:
    """Between two parts whose side is seen whole: taken for all of a side, it came to 0.7."""
    rng = np.random.default_rng(0)
    angle, z = rng.uniform(-1.4, 1.4, 3000), rng.uniform(0, 0.5, 3000)
    seen = (np.abs(z - 0.25) > 0.1) | (angle < -0.35)
    points = np.stack([0.006 * np.cos(angle), 0.006 * np.sin(angle), z], axis=1)[seen]
    fit = fit_axes(_axis(0.006), points + rng.normal(0, 0.001, points.shape), rounds=30)
    assert fit.skeleton.radius[5:-5].min() > 0.85 * 0.006


def test_a_side_comes_to_one_radius_wherever_it_starts() -> None:
    """Noise of a third of the radius: steps twice as far as they should be ended at 0.83 and at
    1.00 of it by turns."""
    rng = np.random.default_rng(1)
    angle = rng.uniform(-visible_sides._GRAZING, visible_sides._GRAZING, 3000)
    points = np.stack([0.006 * np.cos(angle), 0.006 * np.sin(angle), rng.uniform(0, 0.5, 3000)],
                      axis=1) + rng.normal(0, 0.002, (3000, 3))
    told = fit_axes(_axis(0.006), points, uncertainty=False).seen
    assert told.one_sided
    found = []
    for aside, rounds in ((0.0, 12), (-0.0012, 12), (-0.0012, 13)):
        start = _axis(0.006)
        fit = fit_axes(start.moved(start.nodes + [aside, 0, 0]), points, rounds=rounds,
                       settled=True, seen=told, uncertainty=False)
        found.append(float(np.median(fit.skeleton.radius[5:-5])))
    assert found == pytest.approx([0.006] * 3, rel=0.06)
    assert np.ptp(found) < 0.01 * 0.006


def _twig_beside_a_stem(radius: float, noise: float, half: bool, per_radius: float, seed: int):
    """Points of a stem of 9 mm that tells noise and side, and of a twig with so many points a
    radius of its length; and their axes."""
    rng, length = np.random.default_rng(seed), 0.2
    places, axes = [], []
    for thick, beside, count in ((0.009, 0.0, 1400), (radius, 0.08, per_radius * length / radius)):
        reach = visible_sides._GRAZING if half else np.pi
        angle = rng.uniform(-reach, reach, int(count))
        places.append(np.stack([thick * np.cos(angle), beside + thick * np.sin(angle),
                                rng.uniform(0, length, len(angle))], axis=1))
        along = np.arange(0, length, thick)
        axes.append(np.stack([0 * along, 0 * along + beside, along], axis=1))
    points, stem = np.vstack(places), len(axes[0])
    parent = np.concatenate([np.arange(stem) - 1, [0], stem + np.arange(len(axes[1]) - 1)])
    thick = np.repeat([0.009, radius], [stem, len(axes[1])])
    return (Skeleton.from_edges(np.vstack(axes), parent, thick),
            points + rng.normal(0, noise, points.shape))


@pytest.mark.slow
@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("noise", [0.001, 0.003])
@pytest.mark.parametrize("per_radius", [3, 8])
def test_a_twig_of_few_points_is_as_thick_as_it_is(half, noise, per_radius) -> None:
    """A radius of 3 mm, noise up to as much: half as thick again with 3 points a radius, and a
    quarter as thick with 8, both with intervals that did not hold it."""
    found, held = [], []
    for seed in range(3):
        axes, points = _twig_beside_a_stem(0.003, noise, half, per_radius, seed)
        fit = fit_axes(axes, points, rounds=24).skeleton
        inner = (fit.nodes[:, 1] > 0.04) & (np.abs(fit.nodes[:, 2] - 0.1) < 0.08)
        found.append(np.median(fit.radius[inner]) / 0.003)
        held.append(np.mean(np.abs(fit.radius - 0.003)[inner] < 1.96 * fit.radius_sigma[inner]))
    assert np.mean(found) == pytest.approx(1.0, abs=0.15)
    assert np.mean(held) > 0.7


@pytest.mark.slow
def test_twigs_as_thin_as_the_noise_do_not_take_it_for_radius() -> None:
    """One of the bench's cases: by their nearest places alone twigs came out half as thick again,
    and its volume by 32 % too large."""
    case = one_sided_case(905117013, noise=0.003)
    volume = cylinder_volume(seen_part(case.truth, case.points))
    found = skeletonise(case.points).skeleton
    assert cylinder_volume(found) == pytest.approx(volume, rel=0.12)


def test_an_axis_that_starts_far_too_thin_does_not_follow_single_points() -> None:
    """Begun at a seventh of the noise, it stays straight: its bends made it 5 % too long."""
    z = np.arange(0, 0.3, 0.0003)
    thin = Skeleton.from_edges(np.stack([0 * z, 0 * z, z], axis=1), np.arange(len(z)) - 1,
                               np.full(len(z), 0.0003))
    points = _points(0.002, 0.002, False, 3000)
    fit = fit_axes(thin, points[points[:, 2] < 0.3], uncertainty=False)
    step = np.diff(fit.skeleton.nodes[100:-100], axis=0)
    assert np.linalg.norm(step, axis=1).sum() < 1.02 * step[:, 2].sum()


def test_sides_are_told_apart() -> None:
    """Half a circle is one side, a full one is all around, scatter along the sight is a camera's.
    """
    axis = np.tile([0.0, 0.0, 1.0], (3000, 1))

    def seen(points):
        distance = np.linalg.norm(points[:, :2], axis=1)
        out = np.column_stack([points[:, :2] / distance[:, None], np.zeros(len(points))])
        sharpness = 0.006 * distance / 0.001**2
        return out, sharpness, seen_sides(
            out, axis, distance - 0.006, sharpness, np.full(3000, 36.0), np.ones(3000))

    assert seen(_points(0.006, 0.001, False))[2].share.min() == 1.0
    out, sharpness, half = seen(_points(0.006, 0.001, True))
    assert half.share.min() < 0.1 and half.view @ [1, 0, 0] > 0.95 and not half.along_sight
    camera = _points(0.006, 0.0, True)
    camera[:, 0] += np.random.default_rng(1).normal(0, 0.001, len(camera))
    assert seen(camera)[2].along_sight
    # The mean place is shorter the less is known, and never longer than the circle's radius.
    size = np.linalg.norm(mean_positions(out, axis, sharpness, np.full(3000, 36.0), half), axis=1)
    assert size.max() <= 1 + 1e-9 and size.min() > 0.3


@pytest.mark.slow
def test_half_a_noisy_ring_is_not_taken_for_a_thinner_whole_one() -> None:
    """Noise of half the radius, and the axis at first in the middle of the points that one side
    shows: points lie all around it, and only how they scatter tells that it is half a ring."""
    half = _points(0.005, 0.0025, True)
    start = _axis(0.003)
    fit = fit_axes(start.moved(start.nodes + [half[:, 0].mean(), 0, 0]), half, rounds=30)
    assert np.median(fit.skeleton.radius[5:-5]) == pytest.approx(0.005, rel=0.15)
    whole = fit_axes(_axis(0.005), _points(0.005, 0.0025, False), rounds=30)
    assert np.median(whole.skeleton.radius[5:-5]) == pytest.approx(0.005, rel=0.1)
    # Where the seen side ends is open: its doubt is in the interval, of half a ring alone.
    assert fit.skeleton.radius_sigma[20] > 0.03 * fit.skeleton.radius[20]
    assert whole.skeleton.radius_sigma[20] < fit.skeleton.radius_sigma[20]


def test_a_side_that_was_told_is_kept() -> None:
    """A blob says nothing of it: told anew each round it turned with the axis, radii vanishing."""
    half = _points(0.006, 0.0012, True)
    told = fit_axes(_axis(0.006), half, rounds=12)
    assert told.seen.view[0] > 0.95
    blob = np.random.default_rng(7).normal(0, 0.003, half.shape)
    blob[:, 2] = half[:, 2]
    kept = fit_axes(_axis(0.004), blob, rounds=18, settled=True, seen=told.seen)
    assert kept.seen is told.seen


@pytest.mark.slow
def test_a_flat_stem_is_not_taken_for_half_a_ring(monkeypatch) -> None:
    """An elliptic section, 1.7 times as wide as thick, with noise of 0.4 of its radius: as flat as
    an arc, but not bent. Taken for one, it would come out thicker."""
    points = _points(0.005, 0.0, False) * [1.3, 1 / 1.3, 1.0]
    points += np.random.default_rng(6).normal(0, 0.002, points.shape)
    whole = np.median(fit_axes(_axis(0.004), points, rounds=30).skeleton.radius[5:-5])
    assert whole == pytest.approx(0.005, rel=0.1)
    monkeypatch.setattr(visible_sides, "_BENT_LEAST", 0.0)
    half = np.median(fit_axes(_axis(0.004), points, rounds=30).skeleton.radius[5:-5])
    assert half > 1.05 * whole


@pytest.mark.slow
def test_scatter_that_is_known_to_be_along_the_sight_moves_no_radius() -> None:
    """A camera's scatter of 1.4 radii, and a fit that starts thin.

    Not told that it is a camera's, it comes out a third too thick; on a tree of many twigs such
    fits collapsed to a fifth. At 1.1 radii the untold one is right to 5 % too.
    """
    points = _points(0.005, 0.0, True)
    points[:, 0] += np.random.default_rng(5).laplace(0, 0.007, len(points))
    radius = [np.median(fit_axes(_axis(0.002), points, rounds=18, along_sight=known)
                        .skeleton.radius[5:-5]) for known in (True, False)]
    assert radius[0] == pytest.approx(0.005, rel=0.05)
    assert abs(radius[1] - 0.005) > 2 * abs(radius[0] - 0.005)


# A sensor that smooths thins twigs without losing their points; one that does not stays as is.

SPACING = 0.003


def tree() -> Skeleton:
    """A stem of 9 to 6 mm radius and eight twigs of 2.5 to 1.6 mm."""
    nodes, parent, radius = [np.zeros(3)], [-1], [0.009]
    for k in range(1, 101):
        nodes.append(np.array([0, 0, 0.008 * k]))
        parent.append(k - 1)
        radius.append(0.009 - 0.00003 * k)
    for twig in range(8):
        at, angle = 10 + 11 * twig, 2.4 * twig
        for k in range(1, 61):
            nodes.append(nodes[at] + 0.004 * k * np.array([np.cos(angle), np.sin(angle), 0.3]))
            parent.append(at if k == 1 else len(nodes) - 2)
            radius.append(0.0025 - 0.000015 * k)
    return Skeleton.from_edges(np.array(nodes), np.array(parent), np.array(radius))


def counts(skeleton: Skeleton, seed: int, power: float = 1.0) -> np.ndarray:
    """Points at random over the skin; on each length in proportion to a power of the radius."""
    skin = 2 * np.pi * skeleton.steps * (skeleton.radius / 0.008)**power * 0.008
    return np.random.default_rng(seed).poisson(skin / SPACING**2)


def smoothed(skeleton: Skeleton, shrink: float) -> Skeleton:
    return replace(skeleton, radius=skeleton.radius * np.exp(
        -shrink * (SPACING / skeleton.radius)**2))


@pytest.mark.parametrize("seed", range(4))
def test_radii_before_smoothing_follow_from_the_number_of_points(seed: int) -> None:
    true = tree()
    seen = smoothed(true, 0.25)
    assert np.quantile(seen.radius / true.radius, 0.1) < 0.55
    found = sensor_smoothing(seen, seen.radius, counts(true, seed), SPACING)
    covariance = np.tile(np.eye(4) * 1e-8, (seen.node_count, 1, 1))
    mended, spread = found.undone(seen, covariance)
    off = np.log(mended.radius / true.radius)
    assert abs(found.shrink - 0.25) < 0.1
    assert (np.abs(off) < 3 * found.uncertainty(mended.radius) + 0.01).all()
    assert np.abs(off).max() < 0.2
    assert (spread[:, 3, 3] > 0).all()
    assert np.allclose(spread[:, :3, :3], covariance[:, :3, :3])


@pytest.mark.parametrize("power", [1.0, 1.15])
def test_a_sensor_that_does_not_smooth_leaves_radii_as_they_are(power: float) -> None:
    """Also one that sees fewer points on the skin of thin twigs, as most do."""
    true = tree()
    found = sensor_smoothing(true, true.radius, counts(true, 5, power), SPACING)
    assert found.shrink < 0.05
    mended, _ = found.undone(true, np.tile(np.eye(4), (true.node_count, 1, 1)))
    off = np.log(mended.radius / true.radius)
    assert np.abs(off).max() < 0.12
    assert (off < 0.7 * found.uncertainty(mended.radius)).all()


def test_what_density_leaves_open_is_an_error_of_all_radii_together() -> None:
    """Stem and twigs that are alike thick say nothing of smoothing: half of it may be there."""
    told = tree()
    alike = replace(told, radius=np.where(told.branch == 0, 0.0045, 0.0035))
    found = sensor_smoothing(alike, alike.radius, counts(alike, 0), SPACING)
    assert found.sigma > 0.08
    covariance = np.tile(np.eye(4) * 1e-10, (alike.node_count, 1, 1))
    state = np.full(alike.node_count, MEASURED, np.int8)
    sigma = [shape.radius_sigma / shape.radius for shape in (likeliest_shape(
        replace(alike, radius_state=state), ShapeEvidence(
            covariance, np.full(alike.node_count, SPACING), 0.0, smoothing=smoothing))
        for smoothing in (None, found))]
    twig = alike.branch > 0
    assert np.median(sigma[1][twig]) > 1.3 * np.median(sigma[0][twig])


def test_few_points_show_no_smoothing() -> None:
    true = tree()
    few = counts(true, 0) // 40
    found = sensor_smoothing(true, true.radius, few, SPACING)
    assert found.shrink == 0 and found.sigma == 0
