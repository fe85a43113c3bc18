"""Estimates of a small branch whose truth is known, simulated on a finer mesh."""

from dataclasses import replace

import numpy as np
import pytest
from tests.subjects.forced_pulls import residual_slopes

from benchmarks.paper_branches import Bench, measured
from limber.core.errors import Cancelled, InputError, WorkError
from limber.core.progress import Progress
from limber.estimation.estimated_branch import require_scale_in_principle
from limber.estimation.fitting import objective as objective_module
from limber.estimation.fitting.objective import EvaluationLog, Objective, Stopped
from limber.estimation.fitting.optimise import FitStatus, best_so_far, gauss_newton, nelder_mead
from limber.estimation.parameters import LINK_DEVIATION
from limber.estimation.settings import FitSpec
from limber.estimation.uncertainty import identifiability as identify
from limber.estimation.uncertainty.covariance import uncertainty
from limber.recordings.recording import Observations

SETTINGS = FitSpec(poisson=0.36, hold_out=False, key_frames=5)
TRUTH = np.array([40e6, 22e6, 12e6, 3e6])


@pytest.fixture(scope="module")
def noisy(small_pull):
    return measured(small_pull, 3, points=5e-4, force=0.01)


@pytest.fixture(scope="module")
def objective(small_bench, noisy):
    return small_bench.objective([noisy], SETTINGS)


@pytest.fixture(scope="module")
def at_truth(objective):
    return objective.evaluate(np.log(TRUTH), jacobian=True)


@pytest.fixture(scope="module")
def fitted(small_bench, noisy):
    return small_bench.fit([noisy], SETTINGS)


def relative(values):
    return values.young / TRUTH - 1


@pytest.mark.slow
def test_sensitivities_equal_central_differences(small_bench, small_pull):
    """Every column of the Jacobian, for log E and Poisson's ratio, in both kinds of drive."""
    for drive in ("pose", "force"):
        entry = small_pull.entry.model_copy(update={"drive": drive})
        settings = SETTINGS.model_copy(update={"also": ("poisson",), "key_frames": 3})
        objective = small_bench.objective([replace(small_pull, entry=entry)], settings)
        free = np.r_[np.log(0.8 * TRUTH), 1.36]
        exact = objective.evaluate(free, jacobian=True).jacobian
        off = np.linalg.norm(residual_slopes(objective, free, 2e-4) - exact, axis=0)
        assert np.all(off < 2e-3 * np.linalg.norm(exact, axis=0))


@pytest.mark.slow
def test_exact_data_give_the_truth(small_bench, small_pull):
    """From another mesh and a uniform start, without noise: within what the meshes differ."""
    found = small_bench.fit([measured(small_pull, 0, points=0, force=0)], SETTINGS)
    assert np.abs(relative(found.values)).max() < 0.03
    assert found.fit.converged and found.objective.forward_count <= 15
    assert not found.warnings


@pytest.mark.slow
def test_intervals_hold_the_truth_and_noise_is_recognised(fitted):
    """With noise as stated: the variance factor is near 1, all intervals hold the truth."""
    # Noise of half the stated size: a variance of a quarter.
    assert 0.1 < fitted.uncertainty.variance_factor < 0.5
    low, high = fitted.uncertainty.young_interval.T
    assert np.all(TRUTH < fitted.values.young * (high / fitted.values.young) ** 1.6)
    assert np.all(TRUTH > fitted.values.young * (low / fitted.values.young) ** 1.6)


@pytest.mark.slow
def test_nelder_mead_finds_the_same_with_many_more_simulations(small, noisy):
    """The paper's estimator ends near the loss of Gauss-Newton, which is robust against outliers,
    after many more simulations."""
    start = np.log(TRUTH) + 0.3
    coarse = Bench(small, slice_length=6.0, sides=4)
    ours, theirs = (coarse.objective([noisy], SETTINGS.model_copy(update={"key_frames": 3}))
                    for _ in range(2))
    quick, slow = gauss_newton(ours, start), nelder_mead(theirs, start)
    assert slow.converged
    assert slow.evaluation.objective == pytest.approx(quick.evaluation.objective, rel=0.05)
    assert theirs.forward_count > 8 * ours.forward_count


@pytest.mark.slow
def test_outliers_hardly_matter_and_are_named(small_bench, noisy, fitted):
    """One point in twenty displaced by centimetres: the moduli stay, the outliers are named."""
    rng = np.random.default_rng(5)
    positions = noisy.observations.positions.copy()
    stray = rng.random(positions.shape[:2]) < 0.06
    positions[stray] += 0.05
    pull = replace(noisy, observations=Observations(noisy.observations.times, positions))
    found = small_bench.fit([pull], SETTINGS)
    assert np.abs(np.log(found.values.young / fitted.values.young)).max() < 0.12
    assert any("Outliers" in message for message in found.warnings)


def test_positions_alone_are_refused(small_bench, noisy):
    """Slow, without force, gravity or inertia: every scale of E fits, so none is given."""
    pull = replace(noisy, wrenches=np.full_like(noisy.wrenches, np.nan))
    objective = small_bench.objective([pull], SETTINGS)
    with pytest.raises(InputError, match="soft or stiff"):
        require_scale_in_principle(objective.forwards)
    evaluation = objective.evaluate(np.log(TRUTH), jacobian=True)
    judged = identify.identifiability(evaluation, objective.space)
    assert judged.singular_values[-1] < 1e-6 * judged.singular_values[0]
    with pytest.raises(InputError, match="overall scale"):
        identify.require_scale(judged, objective, evaluation)


def test_gravity_makes_the_scale_known(small_bench, noisy):
    """The same pull is not refused where weight bends the branch as much as the pull does."""
    entry = noisy.entry.model_copy(update={"gravity_m_s2": (0.0, 0.0, -100.0)})
    pull = replace(noisy, entry=entry, wrenches=np.full_like(noisy.wrenches, np.nan))
    objective = small_bench.objective([pull], SETTINGS)
    require_scale_in_principle(objective.forwards)
    evaluation = objective.evaluate(np.log(TRUTH), jacobian=True)
    judged = identify.identifiability(evaluation, objective.space)
    identify.require_scale(judged, objective, evaluation)


def test_what_lies_beyond_the_grasp_is_linked(at_truth, objective):
    """A modulus that nothing depends on is said to be like its neighbour, within a factor of ten:
    its interval is as wide, the neighbour's stays as it was.
    """
    blind = replace(at_truth, jacobian=at_truth.jacobian * [1.0, 1.0, 1.0, 1e-4])
    space, messages = identify.link_unresolved(blind, objective.space)
    assert space.links == ((3, 2),) and space.size == 4
    assert "E4" in messages[0] and "of E3" in messages[0]
    linked = objective.with_space(space)
    residual = np.r_[blind.residual, space.link_rows() @ blind.free]
    whole = replace(blind, residual=residual,
                    jacobian=np.vstack([blind.jacobian, space.link_rows()]))
    found = uncertainty(whole, linked)
    width = np.log(found.young_interval[:, 1] / found.young_interval[:, 0]) / 2
    assert width[3] == pytest.approx(1.97 * LINK_DEVIATION, rel=0.2)
    three = replace(at_truth, jacobian=at_truth.jacobian[:, :3])
    alone = np.linalg.inv(three.jacobian.T @ three.jacobian)[2, 2]**0.5
    assert found.covariance[2, 2]**0.5 == pytest.approx(
        alone * found.variance_factor**0.5 * found.repetition**0.5, rel=0.02)
    # Judged again, the link's own row does not count as data.
    again, _ = identify.link_unresolved(whole, space)
    assert again.links == space.links
    assert identify.link_unresolved(at_truth, objective.space)[1] == []


@pytest.mark.slow
def test_a_pull_of_another_branch_shows(small_bench, noisy):
    """Points that move otherwise than this branch can: the misfit is said."""
    seen = noisy.observations
    wrong = seen.positions[:, ::-1] - seen.positions[0, ::-1] + seen.positions[0]
    found = small_bench.fit([replace(noisy, observations=Observations(seen.times, wrong))],
                            SETTINGS)
    assert any("the pull was recorded on this branch" in message for message in found.warnings)


@pytest.mark.slow
def test_force_in_another_unit_shows(small_bench, noisy):
    """Forces in kilonewtons, taken for newtons, give an impossible modulus: named."""
    pull = replace(noisy, wrenches=noisy.wrenches * 1e-4, entry=noisy.entry.model_copy(
        update={"sensor": noisy.entry.sensor.model_copy(update={
            "force_sigma_n": noisy.entry.sensor.force_sigma_n * 1e-4})}))
    found = small_bench.fit([pull], SETTINGS)
    assert any("another unit than newtons" in message for message in found.warnings)
    assert "reached a bound" in found.is_bad


def test_a_stopped_estimate_keeps_its_best_and_resumes(tmp_path, small_bench, noisy):
    """A cancel: no simulation begins any more, and a second run takes over all that have ended."""
    path = tmp_path / "log.jsonl"
    plain = small_bench.objective([noisy], SETTINGS)
    progress = Progress()
    log = EvaluationLog(path, "problem")
    stopping = Objective(plain.forwards, plain.space, log=log,
                         force_sigma=plain.force_sigma, progress=progress)
    start = np.log(TRUTH) + 0.4
    for step in range(3):
        stopping.evaluate(start - 0.1 * step)
    progress.cancel()
    with pytest.raises(Stopped):
        stopping.evaluate(start - 0.3)
    assert issubclass(Stopped, Cancelled)
    with open(path, "a") as stream:
        stream.write('{"parameters": [1.0, 2.')
    again = EvaluationLog(path, "problem")
    assert again.resumed_count == 3
    assert again.best.objective == min(entry.objective for entry in log.entries)
    assert EvaluationLog(path, "another").resumed_count == 0


def test_a_fit_ends_with_its_budget(monkeypatch, small_bench, noisy, fitted):
    """Of work, so at the same digits again; its intervals hold where it was going, no evaluation
    begins without budget, and nothing is shown as found."""
    spent = objective_module.WORK_LIMIT - fitted.objective.work.left
    monkeypatch.setattr(objective_module, "WORK_LIMIT", 0.4 * spent)
    one, again = (small_bench.fit([noisy], SETTINGS) for _ in range(2))
    assert one.fit.status is FitStatus.out_of_work and not one.warnings
    assert np.array_equal(one.values.young, again.values.young)
    assert "budget was spent" in one.is_bad and "standard deviations" in one.is_bad
    assert np.all((one.uncertainty.young_interval > fitted.values.young[:, None]) == [False, True])
    monkeypatch.setattr(objective_module, "WORK_LIMIT", 0.0)
    with pytest.raises(WorkError, match="budget before it found an equilibrium"):
        small_bench.fit([noisy], SETTINGS)


def test_a_stop_without_an_equilibrium_says_so(small_bench, noisy, monkeypatch):
    """The best parameters of the log may find none when they are simulated anew."""
    objective = small_bench.objective([noisy], SETTINGS)
    objective.log.add(np.log(TRUTH), 1.0, 1.0)
    monkeypatch.setattr(Objective, "evaluate", lambda *_arguments, **_options: None)
    with pytest.raises(Cancelled, match="equilibrium"):
        best_so_far(objective)


def test_a_running_fit_tells_how_well_it_knows_the_moduli(small_bench, noisy):
    """What is shown while it runs: E, and the factor of its 95 % interval."""
    told = []
    plain = small_bench.objective([noisy], SETTINGS)
    objective = Objective(plain.forwards, plain.space, force_sigma=plain.force_sigma,
                          progress=Progress(lambda _share, _message, numbers: told.append(numbers)))
    objective.evaluate(np.log(TRUTH))
    found = objective.evaluate(np.log(TRUTH) + 0.1, jacobian=True)
    assert "young_factor" not in told[1] and "loss_m2" in told[1]
    factors = [float(word) for word in told[-1]["young_factor"].split()]
    covariance = np.linalg.inv(found.jacobian.T @ found.jacobian)
    assert np.log(factors) == pytest.approx(1.96 * np.sqrt(np.diag(covariance)), rel=0.1)


@pytest.mark.slow
def test_three_pulls_know_more_than_one(small_bench, small_pull):
    """The same pull measured three times narrows every interval by about the root of three."""
    names = [replace(measured(small_pull, seed), name=f"pull-{seed}") for seed in (1, 2, 3)]

    def intervals(pulls):
        objective = small_bench.objective(pulls, SETTINGS)
        at_truth = objective.evaluate(np.log(TRUTH), jacobian=True)
        return uncertainty(at_truth, objective).young_interval

    one, three = intervals(names[:1]), intervals(names)
    ratio = np.log(one[:, 1] / one[:, 0]) / np.log(three[:, 1] / three[:, 0])
    assert np.all((1.3 < ratio) & (ratio < 2.3))


@pytest.mark.slow
def test_held_out_pulls_are_scored(small_bench, small_pull):
    """Fitted on one pull, another is foretold to within its noise."""
    names = [replace(measured(small_pull, seed, points=5e-4, force=0.01), name=f"pull-{seed}")
             for seed in (1, 2)]
    found = small_bench.fit(names, SETTINGS.model_copy(update={"hold_out": True}))
    assert set(found.held_out) == {"pull-1", "pull-2"}
    for score in found.held_out.values():
        # Three axes of 0.5 mm each.
        assert 0.7e-3 < score["rms_m"] < 1.3e-3
