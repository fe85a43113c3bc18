"""Creep by a standard linear solid, found where the record shows it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from tests.estimation.test_nuisances import SETTINGS, objective_of

from benchmarks.paper_branches import exact_pull, measured
from limber.estimation.fit import fit_pulls
from limber.estimation.fitting.nuisances import relaxed
from limber.recordings.recording import CalibrationEntry, Observations

SHARE, SECONDS = 0.12, 1.2
CELL = CalibrationEntry(force_bias_sigma_n=0.1, force_drift_sigma_n=0.1, pose_sigma_m=2e-4,
                        pose_sigma_rad=3.5e-3, point_sigma_m=5e-4, pose_noise_m=1e-3)


def test_the_relaxed_part_of_a_step_and_of_a_ramp():
    times = np.linspace(0, 5, 401)
    step = np.where(times > 0.011, 1.0, 0.0)[:, None]
    found = relaxed(times, step, SECONDS)
    assert found[-1, 0] == pytest.approx(1 - np.exp(-5 / SECONDS), abs=0.01)
    ramp = relaxed(times, times[:, None], SECONDS)
    assert ramp[:, 0] == pytest.approx(times - SECONDS * (1 - np.exp(-times / SECONDS)))


@pytest.fixture(scope="module")
def held(small):
    """Pulled out in three seconds and held for six."""
    pull = exact_pull(small, 0, frames=16)
    moments = np.minimum(np.linspace(0, 9, 40), 3.0) / 3.0 * pull.times[-1]

    def at(values):
        return CubicSpline(pull.times, values)(moments)

    times = np.linspace(0, 9, 40)
    return replace(pull, times=times, poses=at(pull.poses), wrenches=at(pull.wrenches),
                   observations=Observations(times, at(pull.observations.positions)),
                   entry=pull.entry.model_copy(update={"calibration": CELL}))


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, SHARE])
def test_creep_is_found_where_it_is_and_nowhere_else(held, small, small_bench, share):
    forces = held.wrenches[:, :3]
    wrenches = held.wrenches.copy()
    wrenches[:, :3] -= share * relaxed(held.times, forces, SECONDS)
    pull = measured(replace(held, wrenches=wrenches), 5, points=3e-4, force=0.005)
    objective = objective_of(small_bench, pull)
    found = fit_pulls(objective, objective.space.base, SETTINGS)
    if share == 0.0:
        assert found.creep is None
        return
    low, high = found.creep["interval"]
    assert low < SHARE < high and high - low < 0.15
    assert 0.3 < found.creep["time_s"] / SECONDS < 3
    assert np.abs(found.values.young / np.array(small.young) - 1).max() < 0.15
