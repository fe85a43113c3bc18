"""The native loops of planning against the same formulas in plain numpy."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from limber.planning.certificate import subsolution as proof
from limber.planning.cost import EdgeWeights, path_cost
from limber.planning.field.energy_field import fit_field
from limber.planning.field.radial import KERNELS, LocalError, RadialInterpolant, slack_of, slacks_at
from limber.planning.field.valid_region import nearest_of
from limber.planning.goals.goal import allowed_points
from limber.planning.planners.rrt_star import _grown, _Tree

CORNERS = np.array(list(product((0, 1), repeat=3)))
STEPS = np.eye(3, dtype=int)
SPLINE = {False: [[0.5, 0.5, 0], [0, 1, 0], [0, 0.5, 0.5]],
          True: [[-1, 1, 0], [-0.5, 0, 0.5], [0, -1, 1]]}
"""Bernstein coefficients of a quadratic spline in a cell, and of its slope."""


@pytest.fixture(scope="module")
def ground():
    """A terrain of random numbers, some corners not known; and those numbers and its slopes."""
    rng = np.random.default_rng(2)
    rate, cells = rng.uniform(2.0, 3.0, (8, 9, 7)), np.zeros((7, 8, 6), bool)
    rate[rng.uniform(size=rate.shape) < 0.03] = np.nan
    cells[1:-1, 1:-1, 1:-1] = rng.uniform(size=(5, 6, 4)) < 0.8
    slopes = 0.1 * rng.normal(size=(*rate.shape, 3))
    positive = rng.uniform(size=rate.shape) < 0.98
    return proof.terrain(rate, slopes, positive, cells, np.array([0.1, 0.2, 0.15]),
                         0.5), rate, slopes


def seconds(values, places, axis):
    """Second differences at ``places`` [n, 3] that have neighbours along an axis, else nan."""
    def at(where):
        return values[tuple(where.T)]
    has = ((places[:, axis] > 0) & (places[:, axis] + 1 < values.shape[axis])).nonzero()[0]
    found = np.full((len(places), *values.shape[3:]), np.nan)
    found[has] = (at(places[has] - STEPS[axis]) - 2.0 * at(places[has])
                  + at(places[has] + STEPS[axis]))
    return found


def test_what_corners_prove_of_a_cell(ground):
    """The largest turn of slopes, second differences at the corners and beside them, the least
    value and the least length."""
    terrain, rate, slopes = ground
    cells, forces = terrain.open_cells, slopes + 0.5
    turned, least = proof.turns(slopes, cells), proof.least_between(rate, slopes, cells)
    bends, sizes = proof._bends(rate, cells), proof.least_size(forces, cells)
    assert not turned[:, ~cells].any() and not bends[:, ~cells].any() and not sizes[~cells].any()
    for cell in np.argwhere(cells):
        own, ends = tuple(cell), cell + CORNERS
        wanted, curved, force_bends = rate[tuple(ends.T)].min(), 0.0, 0.0
        for axis, step in enumerate(STEPS):
            first = ends[CORNERS[:, axis] == 0]
            rise = slopes[(*(first + step).T, axis)] - slopes[(*first.T, axis)]
            turn = max(2.0 * rise.max(), 0.0)
            assert turned[axis][own] == pytest.approx(turn)
            size = np.nan_to_num(np.abs(seconds(rate, ends, axis))).max()
            beside = np.concatenate([ends, ends - step, ends + step])
            beside = beside[(beside[:, axis] > 0) & (beside[:, axis] + 1 < rate.shape[axis])]
            near = np.nan_to_num(seconds(rate, beside, axis))
            bend = 0.25 * max(min(2.0 * near.max() - near.min(), 2.0 * size), 0.0)
            assert bends[axis][own] == pytest.approx(bend)
            curved += max(2.0 * size, turn) / 8.0
            force_bends += np.linalg.norm(seconds(forces, ends, axis), axis=1).max()
        assert least[own] == (pytest.approx(wanted - curved) if wanted > 0.0 else -np.inf)
        hull = proof.off_zero(forces[tuple(ends.T)][None])[0]
        assert sizes[own] == pytest.approx(max(hull - 0.25 * force_bends, 0.0))


def test_steepness_of_a_spline_in_a_cell(ground):
    """From Bernstein coefficients of each component of its gradient, and of the spline itself."""
    terrain, half = ground[0], np.array([[1, 0], [0.5, 0.5], [0, 1]])
    cells, u = terrain.open_cells, np.random.default_rng(3).uniform(0.0, 0.3, (7, 8, 6))
    u[3, 3, 3], floor = np.inf, np.full((3, 3, 3), terrain.floor)
    asked = np.argwhere(cells)
    over, least = proof._excess(u, terrain, asked), proof.least_in_cells(u, cells)
    assert np.isinf(least[~cells]).all()
    for n, cell in enumerate(asked):
        block = u[tuple(slice(k - 1, k + 2) for k in cell)]
        if np.isinf(block).any():
            assert over[n] == 0.0
            continue
        value, *slopes = (np.einsum("abc,ia,jb,kc->ijk", block, *(
            SPLINE[axis == along] for axis in range(3))) for along in (None, 0, 1, 2))
        assert least[tuple(cell)] == pytest.approx(value.min())
        steep = np.sqrt(sum((one / h)**2 for one, h in zip(slopes, terrain.edges, strict=True)))
        rate = np.einsum("abc,ia,jb,kc->ijk", terrain.rate[
            tuple(slice(k, k + 2) for k in cell)], half, half, half)
        bends = terrain.bends[(slice(None), *cell)]
        middle = ((np.indices((3, 3, 3)) == 1) * bends[:, None, None, None]).sum(axis=0)
        allowed = [floor] if terrain.level[tuple(cell)] else [
            floor, rate - bends.sum() / 2.0, rate - middle]
        assert over[n] == pytest.approx(min(np.where(most > 0.0, steep / np.maximum(
            most, 1e-300), np.inf).max() for most in allowed))


def test_marching_on_even_ground_is_the_distance_from_a_wall():
    active = np.ones((9, 10, 11), bool)
    active[4, :7] = False
    numbers, indices, near = proof.neighbours(active)
    places, padded = np.argwhere(active), np.pad(numbers, 1, constant_values=-1)
    assert np.array_equal(numbers[active], np.arange(len(indices)))
    for side, step in enumerate(sign * step for step in STEPS for sign in (-1, 1)):
        assert np.array_equal(near[:, side], padded[tuple((places + 1 + step).T)])
    found = proof.march(np.full(len(places), 2.0), near, places[:, 2] == 0, np.zeros(len(places)),
                        np.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(found, 0.6 * places[:, 2], atol=1e-12)
    values = np.random.default_rng(1).uniform(size=len(places))
    assert np.array_equal(proof._most_about(values, numbers, indices), [max(
        values[other] for other in padded[tuple(slice(k, k + 3) for k in place)].ravel()
        if other >= 0) for place in places])
    rate = np.random.default_rng(1).uniform(size=(10, 11, 12))
    means = [rate[tuple(slice(k, k + 2) for k in place)].mean() for place in places]
    np.testing.assert_allclose(proof._middles(rate, indices), means)


# The field: plain sums over its samples.

POINTS = np.random.default_rng(7).uniform(-0.12, 0.12, (60, 3))
REFUSED = np.array([[0.05, 0.05, 0.05], [-0.1, 0.02, 0.0], [0.02, -0.08, 0.06]])


@pytest.fixture(scope="module")
def curved_field(ridge):
    samples = ridge.samples(count=120, rejected=np.hstack([REFUSED, 0 * REFUSED]))
    return fit_field(samples, np.array([0.0, 0.0, -0.5]), 0.5)


def plain_value(fit, points, channel):
    """Sum over the samples of ``fit`` by its formula: one channel at ``points`` [n, 3]."""
    x = (points - fit.shift) / fit.scale
    off = x[:, None] - fit.centres
    r = np.linalg.norm(off, axis=2)
    s = np.sqrt(1.0 + (fit.shape * r)**2)
    gaussian = np.exp(-(fit.shape * r)**2)
    phi, slope = {"cubic": (r**3, 3.0 * r), "quintic": (-r**5, -5.0 * r**3),
                  "multiquadric": (-s, -fit.shape**2 / s),
                  "gaussian": (gaussian, -2.0 * fit.shape**2 * gaussian)}[fit.kernel]
    total = phi @ fit.value_weights[:, channel] + np.prod(
        x[:, None] ** fit.powers, axis=2) @ fit.polynomial[:, channel]
    if len(fit.gradient_weights):
        total -= (slope * (off * fit.gradient_weights[:, :, channel]).sum(axis=2)).sum(axis=1)
    return total


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("with_slopes", [False, True])
def test_an_interpolant_is_the_sum_over_its_samples(kernel, with_slopes, ridge):
    """Of several channels at once too, which are taken in threes."""
    rng = np.random.default_rng(5)
    values, slopes = rng.normal(size=(59, 5)), rng.normal(size=(59, 3, 5))
    fit = RadialInterpolant.fit(POINTS[:59], values, slopes if with_slopes else None,
                                kernel=kernel, shape=2.0, smoothing=1e-3)
    found = fit.value(0.9 * POINTS)
    for channel in range(5):
        wanted = plain_value(fit, 0.9 * POINTS, channel)
        np.testing.assert_allclose(found[:, channel], wanted, atol=1e-9 * np.abs(wanted).max())


def test_a_region_is_below_its_planes_and_nearer_to_accepted_poses(curved_field):
    region = curved_field.region
    far = np.linalg.norm(POINTS[:, None] - region.accepted, axis=2)
    refused = np.linalg.norm(POINTS[:, None] - REFUSED, axis=2).min(axis=1)
    flat = region.chart.map(POINTS)
    heights = (flat @ region.planes[:, :3].T + region.planes[:, 3]).max(axis=1)
    np.testing.assert_allclose(region.height(POINTS), heights, atol=1e-15)
    trusted = (heights <= 1e-9) & (far.min(axis=1) <= refused)
    assert np.array_equal(region.contains(POINTS), trusted) and 40 < trusted.sum() < 60
    distance, away = nearest_of(POINTS, region.accepted)
    np.testing.assert_allclose(distance, far.min(axis=1))
    np.testing.assert_allclose(POINTS - distance[:, None] * away,
                               region.accepted[far.argmin(axis=1)], atol=1e-12)
    halves = 0.004 * np.eye(3)
    corners = (POINTS[:, None] + (2.0 * CORNERS - 1.0) @ halves)[:, :, None]
    good, bad = (((corners - some)**2).sum(axis=3) for some in (region.accepted, REFUSED))
    own = bad[np.arange(60), :, np.linalg.norm(POINTS[:, None] - REFUSED, axis=2).argmin(axis=1)]
    whole = replace(region, planes=np.array([[0.0, 0.0, 0.0, -1.0]]))
    assert np.array_equal(whole.surely_outside(POINTS, halves),
                          (good > own[:, :, None]).all(axis=(1, 2)))


def test_limits_costs_and_a_tree(curved_field):
    """A point keeps all limits less their slack; an edge costs what its middles do; and a tree's
    nodes cost what the way to them does, no more than by another near node."""
    field, rng = curved_field, np.random.default_rng(4)
    positions, off = field.samples.positions, rng.uniform(0.0, 0.02, 120)
    error = LocalError.of(field.region.chart.map(positions), off, 0.9, 0.05)
    slack = slack_of(("energy", "force", *field.load_names), {"strain": error}, 0.5)
    flat = field.region.chart.map(POINTS)
    weights = (((flat[:, None] - error.points)**2).sum(axis=2) + error.near)**-3.0
    tighter = 0.5 * np.minimum(error.factor * np.sqrt(
        weights @ error.squares / weights.sum(axis=1)), 0.05)
    np.testing.assert_allclose(slacks_at(flat, 2, slack), tighter)
    limits = field.limited(0.45, 8.0, strain=0.07, slack=slack, high=np.full(3, 0.09))
    kept = field.region.contains(POINTS) & (POINTS <= 0.09).all(axis=1) & (
        field.energy(POINTS) <= 0.45) & (np.linalg.norm(field.force(POINTS), axis=1) <= 8.0) & (
        np.abs(field.load(POINTS, "strain")) <= 0.07 - tighter)
    assert np.array_equal(allowed_points(POINTS, limits), kept) and 10 < kept.sum() < 50
    own = EdgeWeights(2.0, 3.0, 0.005)

    def cost(start, stop):
        pieces = int(np.ceil(np.linalg.norm(stop - start) / own.step))
        middles = start + (np.arange(pieces)[:, None] + 0.5) / pieces * (stop - start)
        kept = allowed_points(np.vstack([middles, stop]), limits).all()
        return np.linalg.norm(stop - start) * (
            own.energy * field.energy(middles).mean() + own.length) if kept else np.inf
    path = np.array([[0.0, 0.0, 0.0], [0.02, -0.03, 0.01], [0.03, -0.03, 0.02]])
    total = sum(map(cost, path[:-1], path[1:]))
    assert path_cost(path, limits, own) == pytest.approx(total) and total < np.inf
    tree = _Tree(400)
    count = _grown(rng.uniform(-0.1, 0.1, (399, 3)), limits.numbers, *tree.arrays, 1, 0.05, *own)
    assert 30 < count < 399
    for node in range(1, count):
        parent = tree.parent[node]
        edge = cost(tree.nodes[parent], tree.nodes[node])
        assert tree.cost[node] == pytest.approx(tree.cost[parent] + edge)
        assert np.linalg.norm(tree.nodes[parent] - tree.nodes[node]) <= 0.05 * (1 + 1e-8)
    away = np.linalg.norm(tree.nodes[count - 1] - tree.nodes[:count - 1], axis=1)
    by = [tree.cost[j] + cost(tree.nodes[j], tree.nodes[count - 1]) for j in np.argsort(away)[:20]
          if away[j] <= 0.05]
    assert tree.cost[count - 1] == pytest.approx(min(by))
