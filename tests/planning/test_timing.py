"""Times along a path: the textbook's trapezoid, corners, stops."""

import numpy as np
import pytest

from limber.planning.timing import Pace, poses_at, time_law, times_along

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
