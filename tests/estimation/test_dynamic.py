"""A fast pull, simulated in time."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.paper_branches import Bench
from limber.estimation.fitting.objective import Objective
from limber.estimation.fitting.optimise import gauss_newton
from limber.estimation.forward.dynamic_pull import DynamicForward
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
    for column in range(7):
        step = np.zeros(7)
        step[column] = 1e-3
        ahead, behind = (objective.evaluate(free + sign * step).residual for sign in (1, -1))
        off = (ahead - behind) / 2e-3 - exact[:, column]
        assert np.linalg.norm(off) < 0.02 * np.linalg.norm(exact[:, column]) + 1e-3


@pytest.mark.slow
def test_inertia_gives_the_scale_without_force(shaken):
    """With the density known, motion alone tells how stiff the branch is."""
    objective = Objective([shaken], ParameterSpace.separate(replace(TRUE, young=2.0 * YOUNG)))
    start = objective.space.pack(objective.space.base)
    evaluation = objective.evaluate(start, jacobian=True)
    require_scale(identifiability(evaluation, objective.space), objective, evaluation)
    fit = gauss_newton(objective, start, robust=False)
    assert np.abs(np.exp(fit.evaluation.free) / YOUNG - 1).max() < 0.01
