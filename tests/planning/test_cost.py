"""Costs and measures of paths: additive, scale-free, the same for every path."""

import numpy as np
import pytest

from limber.planning.cost import (
    CostWeights,
    arc_lengths,
    edge_cost,
    measure_path,
    path_cost,
    resample,
)

START, GOAL = np.array([-0.12, 0.0, 0.0]), np.array([0.12, 0.0, 0.0])


@pytest.fixture
def cost_weights(ridge_field):
    return CostWeights.between(ridge_field, START, GOAL, deformation=1.0, distance=0.5)


def test_cost_is_the_integral(ridge_field, cost_weights):
    """The edge's cost is the two integrals of the cost, here by fine quadrature."""
    line = np.linspace(START, GOAL, 4001)
    energy = ridge_field.energy(line)
    along = np.linspace(0.0, 0.24, 4001)
    wanted = np.trapz(energy, along) / (energy.max() * 0.24) + 0.5  # noqa: NPY201
    found = edge_cost(START, GOAL, ridge_field.limited(), cost_weights.weights)
    assert found == pytest.approx(wanted, rel=2e-3)


def test_division_of_an_edge_changes_nothing(ridge_field, cost_weights):
    """Additive: a line in 3 or in 48 edges costs the same, to quadrature error."""
    costs = [path_cost(np.linspace(START, GOAL, n), ridge_field.limited(), cost_weights.weights)
             for n in (2, 4, 13, 49)]
    assert np.ptp(costs) < 2e-3 * costs[0]


def test_there_and_back_cost_the_same(ridge_field, cost_weights):
    """Symmetric in direction, which rewiring relies on."""
    field = ridge_field.limited()
    assert edge_cost(START, GOAL, field, cost_weights.weights) == pytest.approx(
        edge_cost(GOAL, START, field, cost_weights.weights), rel=1e-12)


def test_limits_make_an_edge_infinite(ridge_field, cost_weights):
    """An edge over the ridge is refused by a limit on energy, and by one on force."""
    over = edge_cost(START, GOAL, ridge_field.limited(max_energy=0.2), cost_weights.weights)
    hard = edge_cost(START, GOAL, ridge_field.limited(max_force=2.0), cost_weights.weights)
    assert np.isinf(over) and np.isinf(hard)
    assert np.isfinite(edge_cost(START, GOAL, ridge_field.limited(1.0, 20.0), cost_weights.weights))


def test_outside_the_samples_is_infinite(ridge_field, cost_weights):
    """No edge leaves the region where the field is known."""
    assert np.isinf(edge_cost(START, np.array([0.5, 0, 0]), ridge_field.limited(),
                              cost_weights.weights))


def test_measures_of_a_known_path():
    """On a straight path with E = x: length, integral, 5 mm sum, peaks and work by hand."""
    x = np.linspace(0.0, 0.1, 51)
    points = np.stack([x, 0 * x, 0 * x], axis=1)
    measures = measure_path(points, x, 2 * x)
    assert measures.length_m == pytest.approx(0.1)
    assert measures.energy_integral_jm == pytest.approx(0.005)
    assert measures.energy_sum_nmm == pytest.approx(1e3 * np.arange(0, 0.1001, 0.005).sum())
    assert measures.peak_energy_j == pytest.approx(0.1)
    assert measures.peak_force_n == pytest.approx(0.2)
    assert measures.positive_work_j == pytest.approx(0.1)


def test_measures_do_not_depend_on_point_count():
    """The 5 mm sum is taken at 5 mm, however densely the path is given."""
    def sum_of(count):
        x = np.linspace(0.0, 0.1, count)
        return measure_path(np.stack([x, x, 0 * x], axis=1), x**2, x).energy_sum_nmm

    assert sum_of(300) == pytest.approx(sum_of(900), rel=1e-3)


def test_resample_keeps_ends_and_spacing():
    """Even spacing of at most what was asked, both ends kept."""
    path = np.array([[0.0, 0, 0], [0.03, 0, 0], [0.03, 0.02, 0]])
    even = resample(path, 0.005)
    assert np.allclose(even[[0, -1]], path[[0, -1]])
    assert np.diff(arc_lengths(even)).max() <= 0.005 + 1e-12
    assert len(even) == 11
