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
from limber.planning.timing import Pace, poses_at, time_law, times_along

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


# Times along a path: the textbook's trapezoid, corners, stops.

PACE = Pace(0.05, 0.1)
TANGENTIAL = 0.1 * np.sqrt(0.5)


def test_a_straight_line_is_the_trapezoid():
    """From rest to rest: ramps by the acceleration's share, full speed between."""
    line = np.linspace(0.0, 0.2, 21)[:, None] * [1.0, 0.0, 0.0]
    times = times_along(line, PACE)
    assert times[0] == 0.0 and (np.diff(times) > 0.0).all()
    assert times[-1] == pytest.approx(0.2 / 0.05 + 0.05 / TANGENTIAL, rel=1e-3)
    assert np.diff(times)[10] == pytest.approx(0.01 / 0.05, rel=1e-6)


def test_no_speed_and_no_acceleration_over_the_limit():
    """On a wound path, measured by differences of the interpolated motion."""
    s = np.linspace(0.0, 1.0, 200)
    path = np.column_stack([0.05 * np.cos(9 * s), 0.05 * np.sin(9 * s), 0.02 * s])
    times = times_along(path, PACE)
    fine = np.linspace(0.0, times[-1], 4000)
    smooth = np.column_stack([np.interp(fine, times, path[:, k]) for k in range(3)])
    speed = np.linalg.norm(np.diff(smooth, axis=0), axis=1) / fine[1]
    assert speed.max() <= 0.05 * 1.001
    window = 200  # over ten corners of the polyline
    velocity = (smooth[window:] - smooth[:-window]) / (window * fine[1])
    acceleration = (velocity[window:] - velocity[:-window]) / (window * fine[1])
    assert np.linalg.norm(acceleration, axis=1).max() <= 0.1 * 1.02


def test_it_stands_still_at_a_stop_and_slows_at_a_corner():
    """A stop costs a ramp down and up; a right angle is passed slowly."""
    line = np.linspace(0.0, 0.2, 21)[:, None] * [1.0, 0.0, 0.0]
    stopped = times_along(line, PACE, stops=(10,))
    assert stopped[-1] == pytest.approx(2 * (0.1 / 0.05 + 0.05 / TANGENTIAL), rel=1e-3)
    bent = np.concatenate([line[:11], line[10] + line[1:11][:, [1, 0, 2]]])
    assert times_along(line, PACE)[-1] < times_along(bent, PACE)[-1] < stopped[-1]
    assert (np.diff(times_along(np.repeat(line, 2, axis=0), PACE)) >= 0.0).all()


def test_poses_at_a_controllers_rate_go_through_the_path():
    """At the corners' times they are the corners; between, no speed is over the limit, the turn is
    the rotations' and nothing moves at a stop."""
    s = np.linspace(0.0, 1.0, 41)
    poses = np.column_stack([0.1 * np.sin(2 * s), 0.1 * np.cos(2 * s), 0.05 * s, s, 0 * s, 0 * s])
    there_and_back = np.concatenate([poses, poses[-2::-1]])
    law = time_law(there_and_back[:, :3], PACE, stops=(40,))
    times = times_along(there_and_back[:, :3], PACE, stops=(40,))
    assert law.duration == pytest.approx(times[-1])
    assert np.allclose(poses_at(there_and_back, law, times, (40,)), there_and_back, atol=1e-9)
    instants = np.arange(0.0, law.duration, 1 / 500)
    streamed = poses_at(there_and_back, law, instants, (40,))
    speed = np.linalg.norm(np.diff(streamed[:, :3], axis=0), axis=1) * 500
    assert speed.max() <= 1.001 * PACE.speed
    assert np.abs(np.diff(speed)).max() * 500 <= 1.05 * TANGENTIAL
    assert speed[np.searchsorted(instants, times[40]) - 1] < 0.01 * PACE.speed
    assert np.allclose(np.hypot(streamed[:, 0], streamed[:, 1]), 0.1, atol=2e-5)
    assert (np.diff(streamed[instants < times[40], 3]) >= 0.0).all()


def test_a_slower_pace_takes_that_much_longer():
    """Along the same way, k times slower takes k times as long."""
    line = np.linspace(0.0, 0.1, 21)[:, None] * [1.0, 0.0, 0.0]
    assert times_along(line, PACE.slower(3.0))[-1] == pytest.approx(3 * times_along(line, PACE)[-1])
