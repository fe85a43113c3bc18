"""Few frames simulated, all frames known."""

import numpy as np

from limber.estimation.forward.forward_model import key_frames, smoothed, travel


def test_travel_ignores_jitter_and_counts_turns():
    """A robot that stands still does not travel, however its readings shake; turning counts."""
    poses = np.zeros((50, 6))
    poses[20:, 0] = 0.1
    poses[40:, 5] = 0.5
    poses[:20, :3] += 1e-5 * np.random.default_rng(0).standard_normal((20, 3))
    length = travel(poses)
    assert length[19] < 1e-4
    assert abs(length[25] - 0.1) < 1e-3 and abs(length[-1] - 0.15) < 1e-3
    assert np.all(np.diff(length) >= 0)


def test_spline_returns_smooth_functions_of_the_path():
    """A smooth response along the path, sampled at 10 of 120 frames, is known everywhere."""
    along = np.linspace(0, 1, 120)**2
    keys, spread = key_frames(along, 10)
    assert len(keys) == 10 and spread.shape == (120, 10)
    response = np.column_stack([np.sin(2 * along), along**2])
    assert np.abs(spread @ response[keys] - response).max() < 2e-4
    assert np.allclose(spread[keys], np.eye(10), atol=1e-12)


def test_there_and_back_shares_states():
    """On the way back the states of the way out serve again."""
    along = np.r_[np.linspace(0, 1, 40), np.linspace(1, 0, 40)]
    keys, spread = key_frames(along, 8)
    response = np.cos(along)[:, None]
    assert np.abs(spread @ response[keys] - response).max() < 1e-3
    assert len(key_frames(np.zeros(7), 5)[0]) == 1


def test_smoothing_keeps_the_course_and_lowers_the_noise():
    """A noisy force at key frames is better than its single readings."""
    rng = np.random.default_rng(0)
    time = np.linspace(0, 5, 200)
    true = np.column_stack([time**2, np.sin(time)])
    noisy = true + 0.1 * rng.standard_normal(true.shape)
    noisy[50] = np.nan
    places = time[::22]
    off = smoothed(time, noisy, places) - true[::22]
    assert np.std(off) < 0.06
