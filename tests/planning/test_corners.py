"""What a cell's corners say of what lies in it, where a valley's floor does: by brute force."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator

from limber.core.errors import WorkError
from limber.planning.certificate import lower_bound
from limber.planning.certificate.feasibility import judge
from limber.planning.certificate.subsolution import off_zero
from limber.planning.cost import CostWeights
from limber.planning.field.chart import Chart
from limber.planning.field.energy_field import fit_field
from limber.planning.field.radial import KERNELS, RadialInterpolant
from limber.planning.field.stored_states import States
from limber.planning.goals.goal import allowed_points, grasp_goal
from limber.planning.path_problem import GentleProblem
from limber.planning.planners.refine import plan_gentle, refine

RADIUS = 0.25  # [m] of the shell about the origin
ALONG, OFF = 20.0, 3e4  # [N/m] along the shell and across it
MOST = 10.0  # [N] that the branch resists with off the shell, drawn taut or bowed out


@pytest.fixture(scope="module")
def bowing_field():
    """A branch that is stiff by its shell and yields a little off it: its valley has steep sides,
    and nothing a few millimetres beside it tells how low it is."""
    generator = np.random.default_rng(4)
    chart = Chart.about(np.zeros(3), RADIUS, np.array([0.0, 0.0, RADIUS]))
    flat = np.concatenate([np.zeros((1, 3)), generator.uniform(-0.13, 0.13, (300, 3))])
    flat[1:, 2] = generator.choice([0.02, -0.05], 300) * generator.uniform(0.0, 1.0, 300)**2
    off = np.abs(flat[:, 2]) * OFF / MOST
    slope = flat * ALONG
    slope[:, 2] = np.sign(flat[:, 2]) * MOST * np.tanh(off)
    energy = 0.5 * ALONG * (flat[:, :2]**2).sum(axis=1) + MOST**2 / OFF * (
        off + np.log1p(np.exp(-2.0 * off)) - np.log(2.0))
    points = chart.curved(flat)
    return fit_field(States(
        np.hstack([points, np.zeros_like(points)]), energy, chart.pull_back(points, slope),
        1.5 * points, np.ones(len(points)), np.empty((0, 6)), np.full(len(points), 0.01)),
                     np.zeros(3), RADIUS)


def problem_on(field, share):
    """Across the shell, with a limit of a ``share`` of the force that the end needs; the field is
    taken for the branch."""
    ends = field.region.chart.plain.curved(np.array([[-0.08, 0.03, 0.0], [0.06, 0.07, 0.0]]))
    goal = grasp_goal(tuple(ends[1]), 0.004)
    weights = CostWeights.between(field, ends[0], ends[1], deformation=1.0, distance=1.5).weights
    limit = share * np.linalg.norm(field.force(ends), axis=1).max()
    limited = field.limited(max_force=limit)
    return GentleProblem(field, limited, weights, ends[0], goal, sure=limited)


def poses_near_the_floor(field, count):
    """Positions [n, 3] by the shell, most of them within a tenth of a millimetre."""
    generator = np.random.default_rng(6)
    flat = generator.uniform(-0.12, 0.12, (count, 3))
    flat[:, 2] = generator.choice([-1.0, 1.0], count) * 10 ** generator.uniform(-6.0, -2.5, count)
    return field.region.chart.plain.curved(flat)


def test_a_hull_is_as_far_from_zero_as_its_nearest_point():
    """Against weights by the thousand; below it always, and close to it where it does not hold 0.
    """
    generator = np.random.default_rng(3)
    corners = generator.normal(size=(50, 8, 3)) + generator.normal(size=(50, 1, 3)) * 3.0
    weights = generator.dirichlet(np.full(8, 0.3), 20_000)
    nearest = np.linalg.norm(weights @ corners, axis=2).min(axis=1)
    found = off_zero(corners)
    assert (found <= nearest).all()
    assert (found[nearest > 1.0] > 0.9 * nearest[nearest > 1.0]).all()
    assert (nearest > 1.0).sum() > 20


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_bound")
@pytest.mark.parametrize("share", [1.02, 1.5])
def test_no_allowed_pose_lies_in_a_closed_cell_nor_costs_less_than_is_claimed(
        bowing_field, share, monkeypatch):
    """On every grid of a certificate, at random poses by the shell that keep the limit: the cell is
    open, and c is not below the claimed bound there."""
    problem = problem_on(bowing_field, share)
    poses = poses_near_the_floor(bowing_field, 20_000)
    poses = poses[allowed_points(poses, problem.limits)]
    assert len(poses) > 300
    rate = problem.weights.length + problem.weights.energy * bowing_field.energy(poses)
    original, asked = lower_bound._bound, []

    def bound(problem, on_grid, grid, cell):
        found = original(problem, on_grid, grid, cell)
        place = (poses - grid.origin) @ grid.axes.T / grid.edges
        number = np.floor(place).astype(int)
        within = ((number >= 0) & (number < grid.open_cells.shape)).all(axis=1)
        within[within] = grid.open_cells[tuple(number[within].T)]
        number, part = number[within], place[within] - number[within]
        lost = ~found.rates.open_cells[tuple(number.T)]
        least = claimed_rate(found.rates, number, part)
        asked.append((within.sum(), lost.sum(), (least > rate[within] * (1 + 1e-9)).sum()))
        return found

    monkeypatch.setattr(lower_bound, "_bound", bound)
    found = plan_gentle(problem)
    assert asked[0][0] > 300 and len(asked) > 2
    assert [lost for _, lost, _ in asked] == [0] * len(asked)
    assert [below for _, _, below in asked] == [0] * len(asked)
    assert found.certificate.lower <= found.cost < 1.03 * found.certificate.lower


def claimed_rate(ground, cells, part):
    """What the terrain says c is at least, at ``part`` [n, 3] of ``cells`` [n, 3]."""
    value = 0.0
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(corner, part, 1.0 - part).prod(axis=1)
        value = value + weight * ground.rate[tuple((cells + corner).T)]
    bends = ground.bends[(slice(None), *cells.T)].T
    value -= (2.0 * bends * part * (1.0 - part)).sum(axis=1)
    level = ground.level[tuple(cells.T)]
    return np.where(level, ground.floor, np.maximum(value, ground.floor))


@pytest.mark.slow
def test_no_proof_stands_against_a_path(bowing_field):
    """With a force just enough a path exists, and no cells say otherwise; with one too low for the
    goal they do."""
    enough = problem_on(bowing_field, 1.02)
    line = np.linspace(enough.start, enough.goal.region.centre, 40)
    path, cost = refine(line, enough)
    assert cost == enough.cost(path) < np.inf
    assert not judge(enough).proven
    limited = replace(enough.limits, max_force=0.9 * np.linalg.norm(
        bowing_field.force(enough.start[None])))
    assert judge(replace(enough, limits=limited, sure=limited)).proven
    assert not judge(replace(enough, limits=limited)).proven, "nothing is known of its error"


# Radial interpolation: against scipy, by finite differences, and what forces are worth.

GENERATOR = np.random.default_rng(3)
POINTS = GENERATOR.uniform(-0.2, 0.2, (100, 3))
ELSEWHERE = GENERATOR.uniform(-0.15, 0.15, (60, 3))


@pytest.mark.parametrize(("kernel", "degree"), [("cubic", 1), ("quintic", 2)])
def test_without_gradients_it_is_scipys(kernel, degree, ridge):
    """Fitted to values alone, it is what scipy's RBFInterpolator gives."""
    values = ridge.energy(POINTS)
    wanted = RBFInterpolator(POINTS, values, kernel=kernel, degree=degree)(ELSEWHERE)
    found = RadialInterpolant.fit(POINTS, values, kernel=kernel).value(ELSEWHERE)[:, 0]
    assert np.allclose(found, wanted, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("with_gradients", [False, True])
def test_gradient_is_that_of_the_value(kernel, with_gradients, ridge):
    """The compiled gradient agrees with central differences of the compiled value."""
    fitted = RadialInterpolant.fit(POINTS, ridge.energy(POINTS),
                                   ridge.force(POINTS) if with_gradients else None, kernel=kernel,
                                   shape=2.5, smoothing=1e-9)
    step = 1e-4
    differences = np.stack(
        [(fitted.value(ELSEWHERE + step * axis) - fitted.value(ELSEWHERE - step * axis))[:, 0]
         / (2 * step) for axis in np.eye(3)], axis=1)
    assert np.allclose(fitted.gradient(ELSEWHERE)[:, :, 0], differences, atol=2e-4)


@pytest.mark.parametrize("kernel", KERNELS)
def test_values_and_gradients_are_matched(kernel, ridge):
    """Without smoothing the field passes through the values and gradients it was given."""
    fitted = RadialInterpolant.fit(POINTS, ridge.energy(POINTS), ridge.force(POINTS),
                                   kernel=kernel, shape=2.5)
    assert np.allclose(fitted.value(POINTS)[:, 0], ridge.energy(POINTS), atol=1e-6)
    assert np.allclose(fitted.gradient(POINTS)[:, :, 0], ridge.force(POINTS), atol=1e-4)


def test_forces_make_the_same_samples_tell_more(ridge):
    """With forces the error at unseen points falls to under half, the gradient's too."""
    values, forces = ridge.energy(POINTS), ridge.force(POINTS)

    def errors(fitted):
        energy = fitted.value(ELSEWHERE)[:, 0] - ridge.energy(ELSEWHERE)
        force = fitted.gradient(ELSEWHERE)[:, :, 0] - ridge.force(ELSEWHERE)
        return np.sqrt(np.mean(energy**2)), np.sqrt(np.mean(force**2))

    plain = errors(RadialInterpolant.fit(POINTS, values, kernel="multiquadric", shape=2.0))
    hermite = errors(RadialInterpolant.fit(POINTS, values, forces, kernel="multiquadric",
                                           shape=2.0))
    assert hermite[0] < plain[0] / 2
    assert hermite[1] < plain[1] / 2


def test_channels_are_independent(ridge):
    """Several channels fitted at once are each as fitted alone."""
    values = np.stack([ridge.energy(POINTS), POINTS[:, 0]], axis=1)
    both = RadialInterpolant.fit(POINTS, values).value(ELSEWHERE)
    alone = RadialInterpolant.fit(POINTS, values[:, 1]).value(ELSEWHERE)
    assert np.allclose(both[:, 1], alone[:, 0], atol=1e-12)
    assert np.allclose(both[:, 1], ELSEWHERE[:, 0], atol=1e-9)


def test_too_few_samples_are_refused():
    """Fewer samples than polynomial terms, or all in a plane, are an error and not nonsense."""
    with pytest.raises(WorkError, match="no unique solution"):
        RadialInterpolant.fit(np.zeros((5, 3)), np.zeros(5))
