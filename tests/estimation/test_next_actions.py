"""What to do next: the interval that an action promises is the one that it then gives."""

from dataclasses import replace

import numpy as np
import pytest
from tests.estimation.test_nuisances import TRUTH, objective_of

from benchmarks.paper_branches import Bench, PaperBranch, exact_pull, measured
from limber.estimation.estimated_branch import subject_of
from limber.estimation.fit import equal_fractions, fit_branch, is_open, supported
from limber.estimation.fitting import nuisances
from limber.estimation.fitting.nuisances import Action, Cause, Unknown
from limber.estimation.fitting.objective import EvaluationLog, Objective
from limber.estimation.forward.solved_pull import QuasiStaticForward
from limber.estimation.parameters import ParameterSpace, Values
from limber.estimation.settings import FitSpec
from limber.estimation.simulated_pull import PullSpec, simulate_pull
from limber.estimation.uncertainty.covariance import largest, uncertainty, variance_parts
from limber.estimation.uncertainty.model_error import ModelError, path_error
from limber.estimation.uncertainty.next_actions import ANOTHER_PULL, TORQUE_SIGMA_NM, Prospects
from limber.geometry.skeleton.skeleton import FRACTIONS
from limber.recordings.recording import EXACT, CalibrationEntry
from limber.recordings.synchronisation import frames_of
from limber.results.report.report_tables import cause_rows

CELL = CalibrationEntry(force_bias_sigma_n=0.5, force_drift_sigma_n=0.5, repeat_sigma=0.03)
UNIT = {"variance_factor": 1.0, "repetition": 1.0}


def prospects(bench, pulls, error=None):
    """At the true moduli, with the noise as stated."""
    parts = [objective_of(bench, pull) for pull in pulls]
    objective = Objective([part.forwards[0] for part in parts], parts[0].space,
                          force_sigma=[part.force_sigma[0] for part in parts])
    evaluation = objective.evaluate(objective.space.pack(Values(TRUTH, 0.36, 900.0)), jacobian=True)
    sure = replace(uncertainty(evaluation, objective), recording_spread=0.03, **UNIT)
    return Prospects(evaluation, objective, sure, error or ModelError(), TRUTH)


@pytest.fixture(scope="module")
def noisy(small_pull):
    pull = measured(small_pull, 3, points=5e-4, force=0.01)
    return replace(pull, entry=pull.entry.model_copy(update={"calibration": CELL}))


@pytest.fixture(scope="module")
def today(small_bench, noisy):
    return prospects(small_bench, [noisy])


def width(found, name):
    """Half widths of log E after an action."""
    chosen = next(each for each in found.best(9) if each["action"] == name)
    return np.diff(np.log(chosen["young_interval_pa"]), axis=1)[:, 0] / (2 * 1.96), chosen


def test_a_repeated_pull_gives_what_was_promised(today, small_bench, noisy):
    """Its own errors and force are unknown anew; those of the cell are the same."""
    promised = today.after_another_pull()
    got = prospects(small_bench, [noisy, replace(noisy, name="again")])
    assert promised == pytest.approx(got._now, rel=5e-3)
    share = promised / today._now
    assert np.all(share < 1.0) and share.min() > 2**-0.5 - 1e-6
    assert width(today, ANOTHER_PULL)[1]["width_share"] == pytest.approx(share.mean())


@pytest.mark.parametrize(("action", "stated"), [
    ("tare the force sensor", {"force_bias_sigma_n": 0.05, "force_drift_sigma_n": 0.1}),
    ("calibrate the gripper", {"pose_sigma_m": 2e-4, "pose_sigma_rad": 3.5e-3})])
def test_a_calibration_gives_what_was_promised(today, small_bench, noisy, action, stated):
    entry = noisy.entry.model_copy(update={"calibration": CELL.model_copy(update=stated)})
    got = prospects(small_bench, [replace(noisy, entry=entry)])
    share = next(each for each in today.best(9) if each["action"] == action)["width_share"]
    assert share == pytest.approx(float((got._now / today._now).mean()), rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("pose_sigma", [0.0, 1e-3])
def test_a_recorded_torque_gives_what_was_promised(small, small_bench, pose_sigma):
    """A clamping gripper whose torque was not recorded leaves the outer moduli undetermined."""
    settings = PullSpec(young=small.young, poisson=0.36, frames=10, mode="rigid",
                        grasp_fraction=0.85, phase=0.5, torque_noise=0.0)
    pull = simulate_pull(small.truth(), "pull-1", settings)[0]
    calibration = CELL.model_copy(update={
        "held_length_sigma_m": 0.0, "pose_sigma_m": pose_sigma, "pose_sigma_rad": 0.0})

    def prospects_with(torque_sigma, error):
        sensor = pull.entry.sensor.model_copy(update={"torque_sigma_nm": torque_sigma})
        entry = pull.entry.model_copy(update={"calibration": calibration, "sensor": sensor})
        seen = replace(pull, entry=entry)
        forward = QuasiStaticForward(pull.name, small_bench.model, small_bench.weights, entry,
                                     frames_of(seen), np.array(entry.rest_points_m), key_count=6)
        objective = Objective([forward], ParameterSpace.separate(Values(TRUTH, 0.36, 900.0)),
                              force_sigma=[entry.sensor.force_sigma_n])
        evaluation = objective.evaluate(np.log(TRUTH), jacobian=True)
        sure = replace(uncertainty(evaluation, objective), recording_spread=0.03, **UNIT)
        path = path_error(evaluation, objective) if error else None
        return Prospects(evaluation, objective, sure, ModelError().having(path=path), TRUTH)

    poor = prospects_with(None, pose_sigma > 0)
    chosen = next(each for each in poor.best(9) if each["action"] == "record the torque")
    promised = poor._with_torque().mean()
    exact = prospects_with(TORQUE_SIGMA_NM, False)._now.mean()
    assert chosen["width_share"] == pytest.approx((poor._with_torque() / poor._now).mean())
    assert chosen["width_share"] < 0.9
    if pose_sigma == 0:
        assert promised == pytest.approx(exact, rel=0.1)
    else:
        # The fit finds part of the frame's error; a prescribed path puts all of it into the moduli.
        assert exact < promised < prospects_with(TORQUE_SIGMA_NM, True)._now.mean()


def test_the_best_come_first_and_the_idle_do_not_come(today, small_bench, noisy):
    shares = [each["width_share"] for each in today.best(9)]
    assert shares == sorted(shares) and shares[-1] < 0.98
    assert "scan again" not in {each["action"] for each in today.best(9)}
    rough = prospects(small_bench, [noisy], ModelError().having(geometry=np.full(4, 0.5)))
    best = rough.best(1)[0]
    assert best["action"] == "scan again" and best["width_share"] == pytest.approx(0.5, abs=0.1)


# As many control points as the pulls support.

QUICK = FitSpec(key_frames=6, hold_out=False, mesh_check=False, gravity=False, poisson=0.35)


class _OnTheFitsMesh(PaperBranch):
    """A uniform branch on another mesh is no longer uniform to a thousandth of its force."""

    def truth(self):
        return replace(super().truth(), mesh=self.mesh(slice_length=2.4, sides=6))


def support(young):
    branch = _OnTheFitsMesh("drawn", young, 0.35, 0.40, (0.010, 0.008), 0.4)
    bench = Bench(branch, slice_length=2.4, sides=6)
    pull = measured(exact_pull(branch, 0, frames=20), 3, points=2e-4, force=0.004)
    pull = replace(pull, entry=pull.entry.model_copy(update={
        "calibration": EXACT, "rest_points_m": tuple(map(tuple, bench.points.tolist()))}))
    count = bench.mesh.tet_count
    mesh = bench.mesh.with_data(cell_data={"young": np.full(count, 2e7),
                                           "poisson": np.full(count, 0.35),
                                           "density": np.full(count, 900.0)})
    subject = subject_of(mesh, branch.skeleton, (), (0.0, 0.0, 0.0), QUICK)
    found = fit_branch([pull], subject, QUICK, log=EvaluationLog(None, ""), quick=True)
    return supported(found)


@pytest.mark.slow
def test_a_uniform_branch_has_one_and_a_graded_one_the_four_of_its_truth():
    uniform, graded = support(4 * (2e7,)), support((40e6, 22e6, 12e6, 3e6))
    assert uniform.fractions == equal_fractions(1) and graded.fractions == FRACTIONS
    assert uniform.start.young == pytest.approx([2e7], rel=0.02)
    for found in (uniform, graded):
        assert list(found.evidence) == [1, 2, 3, 4, 5, 6]
    # One modulus cannot explain a fall by a factor of 13.
    assert graded.evidence[1] < graded.evidence[4] - 100


@pytest.mark.slow
def test_a_modulus_that_goes_up_and_down_needs_more_than_four():
    found = support((20e6, 60e6, 10e6, 40e6, 8e6, 20e6))
    assert found.fractions == equal_fractions(6)
    assert found.evidence[6] > found.evidence[4] + 3


def test_given_control_points_stay_and_other_methods_have_four():
    assert is_open(FitSpec()) and FitSpec().initial_fractions == FRACTIONS
    for given in ({"fractions": FRACTIONS}, {"method": "nelder-mead"},
                  {"field": "inverse_distance"}):
        assert not is_open(FitSpec(**given))
        assert FitSpec(**given).initial_fractions == FRACTIONS


def test_a_new_source_of_error_is_one_entry(small_bench, noisy, monkeypatch):
    """A gripper's backlash, added here: fit, covariance, causes, actions, records and table."""
    backlash = Unknown(
        Cause("backlash", "preload the gripper"), lambda forward: [f"backlash of {forward.name}"],
        "", lambda known: 10 * known.force_gain_sigma,
        lambda pull: {"forces": pull.share[:, None, None] * pull.forces[..., None]},
        is_shared=False, measured=(Action("measure the backlash", "with a gauge"), 1e-3))
    plain = prospects(small_bench, [noisy])
    monkeypatch.setattr(nuisances, "UNKNOWNS", [*nuisances.UNKNOWNS, backlash])
    objective = objective_of(small_bench, noisy)
    evaluation = objective.evaluate(objective.space.pack(Values(TRUTH, 0.36, 900.0)), jacobian=True)
    assert len(evaluation.errors.values) == len(objective.cell_errors.nuisances)
    parts = variance_parts(evaluation, objective)
    assert np.all(parts["backlash"] > 1e-8)
    causes = largest(parts, 20)
    assert "preload the gripper" in {row[-1] for row in cause_rows({"causes": causes})}
    record = nuisances.nuisance_records(objective.cell_errors.nuisances, evaluation.errors,
                                        np.zeros((objective.space.size,) * 2))[-1]
    assert record["name"] == "backlash of pull-1" and record["prior_sigma"] == pytest.approx(0.2)
    now = prospects(small_bench, [noisy])
    assert np.all(now._now > plain._now)
    assert np.all(now._deviation(now._measured(backlash.measured[0])) < now._now)
    assert backlash.measured[0] in now._factors()
