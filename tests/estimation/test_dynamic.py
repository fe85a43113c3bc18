"""A fast pull, simulated in time."""

from dataclasses import replace

import numpy as np
import pytest
from tests.subjects.forced_pulls import residual_slopes

from benchmarks.paper_branches import Bench
from limber.estimation.fitting.objective import Objective
from limber.estimation.fitting.optimise import gauss_newton
from limber.estimation.forward.forward_model import key_frames, smoothed, travel
from limber.estimation.forward.solved_pull import DynamicForward
from limber.estimation.parameters import ParameterSpace, Values
from limber.estimation.uncertainty.identifiability import identifiability, require_scale
from limber.recordings.synchronisation import Frames

YOUNG = np.array([40e6, 30e6, 22e6, 16e6])
EXTRA = ("density", "alpha", "beta")
TRUE = Values(YOUNG, 0.36, 900.0, (0.8, 0.004))


@pytest.fixture(scope="module")
def shaken(small, small_pull):
    """The tip is jerked aside within 0.15 s and held; nobody measures the force."""
    bench = Bench(small, slice_length=6.0, sides=4)
    times = np.arange(0.0, 0.32, 0.02)
    poses = np.zeros((len(times), 6))
    poses[:, :3] = small_pull.entry.grasp.point_m
    share = np.clip(times / 0.15, 0, 1)
    poses[:, 0] += 0.05 * share**2 * (3 - 2 * share)
    entry = small_pull.entry.model_copy(update={"motion": "dynamic"})
    count = len(times)
    frames = Frames(times, poses, np.full((count, 6), np.nan), np.zeros(count, int),
                    np.zeros((count, 4, 3)), np.broadcast_to(
                        (2e-4)**2 * np.eye(3), (count, 4, 3, 3)))
    forward = DynamicForward("shaken", bench.model, bench.weights, entry, frames, bench.points)
    seen = forward.simulate(TRUE, EXTRA, False)
    forward.frames = replace(frames, positions=seen.positions)
    return forward


@pytest.mark.slow
def test_sensitivities_equal_central_differences(shaken):
    """Moduli, density and both dampings, through all time steps."""
    objective = Objective([shaken], ParameterSpace.separate(TRUE, EXTRA))
    free = objective.space.pack(replace(TRUE, young=0.9 * YOUNG))
    exact = objective.evaluate(free, jacobian=True).jacobian
    off = np.linalg.norm(residual_slopes(objective, free, 1e-3) - exact, axis=0)
    assert np.all(off < 0.02 * np.linalg.norm(exact, axis=0) + 1e-3)


@pytest.mark.slow
def test_inertia_gives_the_scale_without_force(shaken):
    """With the density known, motion alone tells how stiff the branch is."""
    objective = Objective([shaken], ParameterSpace.separate(replace(TRUE, young=2.0 * YOUNG)))
    start = objective.space.pack(objective.space.base)
    evaluation = objective.evaluate(start, jacobian=True)
    require_scale(identifiability(evaluation, objective.space), objective, evaluation)
    fit = gauss_newton(objective, start, shortest=1e-3)
    assert np.abs(np.exp(fit.evaluation.free) / YOUNG - 1).max() < 0.01


# Few frames simulated, all frames known.


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
