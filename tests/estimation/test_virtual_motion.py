"""Virtual pulls that are not slow, not free to turn, or not pulled at all."""

from dataclasses import replace

import numpy as np
import pytest
from tests.subjects.forced_pulls import residual_slopes

from benchmarks.paper_branches import Bench
from limber.core.errors import InputError
from limber.estimation.fitting.objective import Objective
from limber.estimation.fitting.optimise import gauss_newton
from limber.estimation.forward.solved_pull import DynamicForward
from limber.estimation.parameters import ParameterSpace, Values
from limber.estimation.settings import FitSpec
from limber.estimation.simulated_pull import PullSpec, TrueBranch, simulate_pull
from limber.estimation.uncertainty.identifiability import identifiability
from limber.geometry.skeleton.skeleton import control_points
from limber.recordings.recording import read_pull, write_pull
from limber.recordings.synchronisation import frames_of

TRUTH = (40e6, 22e6, 12e6, 3e6)
FRACTIONS = (0.2, 0.4, 0.6, 0.8)
EXACT = {"young": TRUTH, "poisson": 0.36, "phase": 0.5, "position_noise": 0.0,
         "force_noise": 0.0, "torque_noise": 0.0}


@pytest.fixture(scope="module")
def truth(small):
    """Coarser than a real truth, and another mesh than the fit's."""
    skeleton = small.skeleton
    return TrueBranch(small.mesh(slice_length=2.6, sides=6), skeleton,
                      control_points(skeleton, FRACTIONS), FRACTIONS, np.array(TRUTH),
                      is_weightless=True)


@pytest.fixture(scope="module")
def bench(small):
    return Bench(small, slice_length=3.4, sides=6)


def simulated(truth, **settings):
    return simulate_pull(truth, "pull-1", PullSpec(**(EXACT | settings)))[0]


@pytest.mark.slow
@pytest.mark.parametrize("drive", ["pose", "force"])
def test_a_fast_pull_gives_young_and_swings_on(truth, bench, drive, tmp_path):
    """Shaken by poses, or pulled and let go: written, read and fitted, the moduli come back."""
    pull = simulated(truth, motion="dynamic", drive=drive, frames=17, duration=0.48, reach=0.2)
    write_pull(tmp_path / "pull-1", pull)
    pull = read_pull(tmp_path / "pull-1")
    assert pull.entry.motion == "dynamic" and pull.entry.drive == drive
    tip = pull.observations.positions[:, -1]
    if drive == "force":
        # Let go at 0.4 of the time: it swings back, and over its place at rest.
        away = (tip - tip[0]) @ (tip[6] - tip[0]) / np.sum((tip[6] - tip[0])**2)
        assert away[8:].min() < -0.2
        assert not pull.wrenches[7:, :3].any()
    forward = DynamicForward(pull.name, bench.model, bench.weights, pull.entry, frames_of(pull),
                             bench.points)
    start = Values(1.3 * np.array(TRUTH), 0.36, 900.0, (0.5, 0.002))
    objective = Objective([forward], ParameterSpace.separate(start), force_sigma=[
        pull.entry.sensor.force_sigma_n])
    fit = gauss_newton(objective, objective.space.pack(start), tolerance=1e-3)
    assert np.abs(np.exp(fit.evaluation.free) / TRUTH - 1).max() < 0.1


def test_a_hung_weight_is_driven_by_its_force(truth, bench):
    """The wrench is the weight, grows to it, and the fit by force gives the moduli."""
    pull = simulated(truth, weight=0.8, frames=8)
    assert pull.entry.drive == "force"
    assert np.allclose(pull.wrenches[-1, :3], [0.0, 0.0, -0.8])
    assert np.allclose(pull.wrenches[0, :3], 0.0)
    with pytest.raises(InputError, match="--weight"):
        simulated(truth, weight=0.1, motion="dynamic")


def test_a_clamped_grasp_twists_and_its_torque_tells_the_outer_moduli(truth, bench):
    """The torque's derivatives equal central differences; with it E4 is known far better."""
    pull = simulated(truth, mode="rigid", frames=8, grasp_fraction=0.85)
    assert np.linalg.norm(pull.wrenches[-1, 3:]) > 1e-3
    settings = FitSpec(poisson=0.36, hold_out=False, key_frames=4)
    sensor = pull.entry.sensor.model_copy(update={
        "position_sigma_m": 1e-3, "force_sigma_n": 0.02 * np.abs(pull.wrenches[:, :3]).max(),
        "torque_sigma_nm": 0.02 * np.abs(pull.wrenches[:, 3:]).max()})
    deaf = sensor.model_copy(update={"torque_sigma_nm": None})
    deviations = []
    for chosen in (sensor, deaf):
        entry = pull.entry.model_copy(update={"sensor": chosen})
        objective = bench.objective([replace(pull, entry=entry)], settings)
        judged = identifiability(objective.evaluate(np.log(TRUTH), jacobian=True), objective.space)
        deviations.append(judged.deviations)
        if chosen is deaf:
            continue
        free = np.log(0.9 * np.array(TRUTH))
        exact = objective.evaluate(free, jacobian=True).jacobian
        off = residual_slopes(objective, free, 2e-4) - exact
        # The last rows are the torque's.
        assert np.all(np.linalg.norm(off[-24:], axis=0) < 5e-3 * np.linalg.norm(
            exact[-24:], axis=0))
    assert np.all(deviations[0] <= deviations[1])
    assert deviations[0][3] < 0.7 * deviations[1][3]
