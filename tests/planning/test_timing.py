"""Times along a path: the textbook's trapezoid, corners, stops."""

import numpy as np
import pytest

from limber.planning.timing import Pace, times_along

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
