"""The small file of the force while a robot moves."""

import json

import numpy as np

from limber.robot.driver.link import FILE, LiveForce


def _samples(force, expected=np.nan):
    rows = np.full((3, 37), np.nan)
    rows[:, 0], rows[:, 7:10] = [1.0, 1.01, 1.02], 99.0
    rows[:, 13:16], rows[:, 25:28] = [0.0, 0.0, force], [0.0, expected, 0.0]
    return rows


def test_the_force_is_there_while_it_moves(tmp_path):
    """Smoothed force, what was expected, the peak, what it is at; gone at the end."""
    path = tmp_path / FILE
    with LiveForce(tmp_path, "Following to-goal", 10.0) as live:
        assert not path.exists()
        live.at("path")
        live.take(_samples(4.0, 3.5))
        told = json.loads(path.read_text())
        assert (told["force_n"], told["expected_n"], told["peak_n"]) == (4.0, 3.5, 4.0)
        assert (told["step"], told["title"], told["limit_n"]) == ("path", "Following to-goal", 10.0)
        assert told["recent"] == [[1.02, 4.0]]
        # Ten times a second, not with every batch; the peak misses none.
        live.take(_samples(6.0))
        assert json.loads(path.read_text())["force_n"] == 4.0
        live._written = 0.0
        live.take(_samples(1.0))
        told = json.loads(path.read_text())
        assert (told["force_n"], told["expected_n"], told["peak_n"]) == (1.0, None, 6.0)
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_takes_nothing_does_not_stop_the_samples(tmp_path):
    """The folder is gone: no file, and no error in the thread that reads the robot."""
    with LiveForce(tmp_path / "gone", "Following", 10.0) as live:
        live.take(_samples(4.0))
