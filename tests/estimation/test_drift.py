"""Pulls of several days: how the modulus of each differs, and how it changes from day to day."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from tests.estimation.test_nuisances import SETTINGS, TRUTH, objective_of

from benchmarks.paper_branches import exact_pull, measured
from limber.core.errors import InputError
from limber.estimation.fit import fit_pulls
from limber.estimation.fitting.nuisances import relaxed
from limber.estimation.fitting.objective import Objective
from limber.estimation.parameters import Values
from limber.estimation.uncertainty.drift import ScaleStep, drift, pull_moduli, scale_steps
from limber.recordings.recording import CalibrationEntry, Observations, entry_of_text, entry_text
from limber.results.report.estimate_figures import modulus_over_days
from limber.results.report.report_tables import pull_rows

DAYS = ("2026-05-01", "2026-05-03T12:00", "2026-05-06")


def test_a_branch_that_dries_stiffens_by_what_it_did():
    """Two percent a day over five days, each pull known to half a percent."""
    days = np.array([0.0, 2.5, 5.0])
    steps = [ScaleStep(k, float(np.log(1.02) * day) - 0.05, 0.005**2) for k, day in enumerate(days)]
    found = drift(steps, DAYS, 0.0)
    assert found["per_day"] == pytest.approx(0.02, abs=1e-6)
    low, high = found["interval"]
    assert low < 0.02 < high and high - low == pytest.approx(2 * 1.96 * 1.02 * 0.005 / np.sqrt(
        np.sum((days - days.mean())**2)), rel=0.01)
    wider = drift(steps, DAYS, 0.02)["interval"]
    assert wider[1] - wider[0] > 3 * (high - low)


def test_one_day_tells_no_change():
    steps = [ScaleStep(k, 0.1 * k, 1e-4) for k in range(3)]
    assert drift(steps, ["2026-05-01", None, "2026-05-01"], 0.0) is None
    minutes = ["2026-05-01T14:00", None, "2026-05-01T14:03"]
    assert drift(steps, minutes, 0.02) is None, "three minutes tell nothing about a day"
    found = drift(steps, ["2026-05-01", None, "2026-05-03"], 0.0)
    assert found["per_day"] == pytest.approx(np.expm1(0.1))


def test_a_pull_of_a_stiffer_day_says_so(small_bench, small_pull):
    """Its force is a tenth larger on the same path: its modulus lies that far above the other's."""
    first, second = (measured(replace(small_pull, name=name), seed, points=2e-4, force=0.002)
                     for seed, name in enumerate(("pull-1", "pull-2")))
    second = replace(second, wrenches=1.1 * second.wrenches)
    pulls = [replace(pull, entry=pull.entry.model_copy(update={"recorded": day}))
             for pull, day in ((first, DAYS[0]), (second, DAYS[2]))]
    parts = [objective_of(small_bench, pull) for pull in pulls]
    objective = Objective([part.forwards[0] for part in parts], parts[0].space,
                          force_sigma=[part.force_sigma[0] for part in parts])
    evaluation = objective.evaluate(
        objective.space.pack(Values(1.05 * TRUTH, 0.36, 900.0)), jacobian=True)
    steps = scale_steps(evaluation, objective, 1.0)
    moduli = pull_moduli(steps, objective)
    apart = moduli[1]["factor"] / moduli[0]["factor"]
    assert apart == pytest.approx(1.1, abs=0.03)
    told = {"pull_moduli": moduli, "drift": drift(steps, DAYS[::2], 0.0)}
    assert told["drift"]["per_day"] == pytest.approx(np.log(1.1) / 5, abs=0.006)
    rows = pull_rows(told)
    assert [row[0] for row in rows] == ["pull", "pull-1", "pull-2", "change per day"]
    assert len(modulus_over_days(told).axes[0].lines) >= 2


def test_a_time_survives_the_file_and_another_is_refused(small_pull):
    entry = small_pull.entry.model_copy(update={"recorded": DAYS[1]})
    text = entry_text(entry)
    assert entry_of_text(text, "here").recorded == DAYS[1]
    with pytest.raises(InputError, match="yesterday"):
        entry_of_text(text.replace(DAYS[1], "yesterday"), "here")


# Creep by a standard linear solid, found where the record shows it.

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
