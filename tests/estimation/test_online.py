"""The online estimator: corrected by the full model, honest without it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.paper_branches import Bench, measured
from limber.estimation.online import filter
from limber.estimation.settings import FitSpec
from limber.recordings.synchronisation import frames_of
from limber.reduced.model_cache import build_reduced
from limber.reduced.reduced_model import ReducedModel, ReducedSettings
from limber.reduced.training import TrainingSettings

TRUTH = np.array([40e6, 22e6, 12e6, 3e6])


def here(full):
    """The full model in this process: each result is there when the call returns."""
    def answer(ask):
        return lambda *asked: (value := ask(*asked), SimpleNamespace(
            done=lambda: True, exception=lambda: None, result=lambda: value))[1]

    solver = filter.ExactSolver(full)
    return SimpleNamespace(frame=answer(solver.frame), basis=answer(solver.basis))


@pytest.fixture(autouse=True)
def time_for_every_frame(monkeypatch):
    """Old frames are linearised again where time allows; a busy machine's clock decides nothing."""
    monkeypatch.setattr("limber.estimation.online.filter.BUDGET_SECONDS", np.inf)


@pytest.fixture(scope="module")
def bench(small):
    return Bench(small, slice_length=3.0, sides=6)


@pytest.fixture(scope="module")
def pull(small_pull):
    return measured(small_pull, 8, points=5e-4, force=0.01)


@pytest.fixture(scope="module")
def batch(bench, pull):
    return bench.fit([pull], FitSpec(hold_out=False, key_frames=16)).values.young


@pytest.fixture(scope="module")
def full(bench, pull):
    return filter.FullBranch(bench.mesh, bench.weights, pull.entry.grasp, bench.points, 0.35, 900.0,
                      (0.0, 0.0, 0.0))


def reduced_around(full, young, spread):
    grasp, model = filter.ExactSolver(full).grasp, full.model(young)
    training = TrainingSettings(grasp_count=20, young_spread=spread)
    return build_reduced(model, grasp, full.weights, young,
                         ReducedSettings(size=40, training=training))[0]


def followed(reduced, full, pull, exact, repeat=1):
    estimator = filter.OnlineEstimator(
        reduced, pull.entry.grasp, full.mesh, full.rest_points,
        position_sigma=pull.entry.sensor.position_sigma_m,
        force_sigma=pull.entry.sensor.force_sigma_n, prior_deviation=0.8, exact=exact)
    frames, states = frames_of(pull), []
    for turn in range(repeat):
        for index in range(len(frames)):
            states.append(estimator.update(filter.OnlineFrame(
                frames.times[index] + 10.0 * turn, frames.poses[index],
                frames.wrenches[index, :3], frames.positions[index])))
    return estimator, states


@pytest.mark.slow
def test_it_ends_where_all_frames_together_do(bench, pull, batch, full):
    """From few training grasps the reduced model alone misses; the full model sets it right, well
    within the interval, and the interval says beforehand that nobody has checked.
    """
    reduced = reduced_around(full, 1.2 * TRUTH, 1.5)
    alone, _ = followed(reduced, full, pull, None)
    alone.settle()
    estimator, states = followed(reduced, full, pull, here(full))
    end = estimator.settle()
    deviation = np.sqrt(np.diag(estimator.covariance))
    off, off_alone = (np.abs(np.log(found / batch)) for found in (end.young, alone.young))
    assert np.all(off < deviation)
    assert off.max() < 0.03 and off.max() < 0.5 * off_alone.max()
    assert 0 < estimator.model_error < 0.1
    assert not states[1].enough


@pytest.mark.slow
def test_a_basis_for_other_moduli_is_made_on_the_way(bench, pull, batch, full):
    """Begun a factor of three too stiff, outside of what the training sampled."""
    estimator, _ = followed(reduced_around(full, 3 * TRUTH, 1.3), full, pull, here(full))
    estimator.settle()
    assert estimator.refresh_count >= 1
    deviation = np.sqrt(np.diag(estimator.covariance))
    assert np.all(np.abs(np.log(estimator.young / batch)) < np.maximum(2 * deviation, 0.02))


@pytest.mark.slow
def test_more_of_the_same_is_called_idle_and_little_noise_enough(bench, pull, full):
    """Standing still at the end narrows nothing: idle. Enough is said only where every modulus is
    known to 2 %, which another pull could not improve by more than that.
    """
    reduced = reduced_around(full, TRUTH, 1.5)
    _, states = followed(reduced, full, pull, here(full))
    assert not states[-1].enough and not any(state.idle for state in states)
    quiet = pull.entry.model_copy(update={"sensor": pull.entry.sensor.model_copy(update={
        "position_sigma_m": 2e-5, "force_sigma_n": 1e-4 * pull.entry.sensor.force_sigma_n})})
    estimator, states = followed(reduced, full, replace(pull, entry=quiet), None, repeat=2)
    assert states[-1].enough
    assert np.sqrt(np.diag(estimator.covariance)).max() < 0.02
    frames = frames_of(pull)
    rest = filter.OnlineFrame(99.0, frames.poses[0], np.full(3, np.nan), np.full((4, 3), np.nan))
    for step in range(30):
        state = estimator.update(replace(rest, time=99.0 + step))
    assert state.idle


@pytest.mark.slow
def test_no_frame_takes_longer_than_a_frame_may(pull, full, monkeypatch):
    """Far off the training states are sought from several starts: in time, or after the pull. A
    second frame is taken up where time is left alone.
    """
    told, solve = [], ReducedModel.solve_static

    def counted(*arguments, **named):
        state = solve(*arguments, **named)
        told.append(state.iterations)
        return state

    monkeypatch.setattr(ReducedModel, "solve_static", counted)
    reduced = reduced_around(full, 2 * TRUTH, 1.3)
    told.clear()
    _, states = followed(reduced, full, pull, None)
    assert filter.FRAME_ITERATIONS / 2 < max(told) <= filter.FRAME_ITERATIONS
    assert len(told) > 1.5 * len(states)
    monkeypatch.setattr("limber.estimation.online.filter.BUDGET_SECONDS", 0.0)
    told.clear()
    followed(reduced, full, pull, None)
    # One before the first frame, for what is compiled when it is called.
    assert len(told) == len(states) + 1
