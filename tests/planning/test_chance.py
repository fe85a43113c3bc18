"""Limits under an uncertain Young's modulus, against scalings that are exact."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm
from tests.stages.specified import Planned

from limber.core.errors import InputError
from limber.planning.constraints.chance import Exposure, Surface, YoungUncertainty, _chosen, _design
from limber.planning.constraints.limits import Limits
from limber.planning.path_on_full_model import resolve_path


@pytest.fixture(scope="module")
def bent(small_model):
    """The weightless small branch, bent in three steps to the side."""
    side = np.linspace(0.0, 1.0, 4)[1:, None] * np.array([0.0, 0.04, -0.002])
    return resolve_path(small_model, small_model.rest_position + side,
                        small_model.rest_position[None])


def uncertainty_of(small_model, deviations, correlation=0.0):
    """Control points at a third and two thirds of the height, or one alone."""
    height = small_model.mesh.centroids[:, 2] / 0.5
    shares = np.column_stack([1.0 - height, height])[:, :len(deviations)]
    count = len(deviations)
    return YoungUncertainty(shares / shares.sum(axis=1, keepdims=True), np.array(deviations),
                      np.eye(count) + correlation * (1 - np.eye(count)))


def laid(axes, law, degree=1.0):
    """A surface through values of ``law`` of the logs [m, K], [m, n, parts]."""
    axes = np.array(axes, float)
    places, pairs = _design(axes.shape[1], 2.0)
    return Surface.through(axes, pairs, places, law(places @ axes.T), degree)


def test_a_branch_that_is_stiffer_everywhere(small_model, bent):
    """Force goes with E, strain does not: both chances are known in closed form."""
    peak = bent.solved.force_sizes.max()
    limits = Limits(force=1.1 * peak, strain=1.01 * bent.solved.strains.max())
    found = uncertainty_of(small_model, [0.08]).risk(small_model, bent, limits, 0.95)
    z = norm.ppf(0.975)
    assert found.factors["force"] == pytest.approx(np.exp(0.08 * z), rel=1e-3)
    assert found.factors["strain"] == pytest.approx(1.0, abs=1e-3)
    assert found.kept == pytest.approx(norm.cdf(np.log(1.1) / 0.08), abs=2e-3)
    assert "force" in found.exceeded_limits()[0]
    tighter = limits.tightened(found.factors)
    assert tighter.force < peak
    wide = replace(limits, force=1.2 * peak)
    assert not uncertainty_of(small_model, [0.08]).risk(small_model, bent, wide,
                                                        0.95).exceeded_limits()


def test_what_is_left_to_a_motion_is_what_the_moduli_leave(small_model, bent):
    """At the pose where the force is nearest its limit, standing still takes as much of what is
    left for the estimate's branch as the stiffest branch in question takes of the limit."""
    peak = bent.ahead.force_sizes.max()
    limits = Limits(force=1.3 * peak, strain=0.5)
    found = uncertainty_of(small_model, [0.08]).risk(small_model, bent, limits, 0.95)
    left = found.left(limits, bent)
    assert left.force == pytest.approx(peak / found.excess["force"])
    assert peak < left.force < limits.force and left.strain == limits.strain


def test_forces_under_other_moduli_are_those_of_the_full_model(small_model, bent):
    """Also where the moduli change against each other and the force turns with them."""
    uncertainty = uncertainty_of(small_model, [0.2, 0.3], -0.5)
    exposure = uncertainty.exposure(small_model, bent, Limits(force=bent.solved.force_sizes.max()))
    surface = exposure.surfaces["force"]
    for logs in np.array([[0.35, -0.45], [-0.3, 0.4], [0.25, 0.1]]):
        truth = uncertainty.solved(small_model, logs, bent.solved).force_sizes
        found = surface.sizes(logs[None])[0]
        size = np.abs(truth - truth.max()) <= 0.5 * truth.max()
        assert len(found) == size.sum()
        assert np.allclose(found, truth[size], rtol=4e-3)


def test_a_force_that_turns_is_told_by_its_parts():
    """Pull and weight nearly cancel on the estimate: the log of what is left has no slope that
    tells it, its parts have."""
    def law(logs):
        return np.stack([np.exp(logs), np.zeros_like(logs)], axis=-1) - [1.02, 0.1]

    exposure = Exposure({"force": 1.0}, {"force": laid([[0.2]], law)})
    found = exposure.risk(np.full((1, 1), 0.04), 0.95)
    draws = 0.2 * norm.ppf((np.arange(20000) + 0.5) / 20000)
    truth = np.hypot(np.exp(draws) - 1.02, 0.1)
    likely = float(np.quantile(truth, 0.95))
    assert found.excess["force"] == pytest.approx(likely, rel=5e-3)
    assert found.factors["force"] > 3.0


def test_poses_are_asked_where_a_limit_may_break(bent):
    """Not on the way there, but about the peak of what each limit is on."""
    order = np.argsort(bent.solved.force_sizes)
    states = bent.solved.take(np.repeat(order[[0, -1]], [30, 20]))
    assert bent.solved.force_sizes[order[0]] < 0.6 * bent.solved.force_sizes[order[-1]]
    chosen = _chosen(states, {"force": states.force_sizes.max()})
    assert len(chosen) >= 10 and chosen.min() >= 30


@pytest.mark.slow
@pytest.mark.parametrize(("settings", "words"), [
    ({"confidence": 0.95}, "without a limit"),
    ({"confidence": 0.95, "max_force": 5.0}, "there is no estimate"),
])
def test_a_confidence_needs_a_limit_and_an_estimate(planned_branch, settings, words):
    with pytest.raises(InputError, match=words):
        Planned(branch_folder=planned_branch, **settings, name="sure").run()


def test_poses_that_break_under_other_moduli_share_the_chance():
    """Two poses, each below its limit with 0.95 under a modulus of its own: both with 0.95 squared;
    a force that bends upwards with its modulus is kept less often, in closed form."""
    z = norm.ppf(0.95)
    both = Exposure({"force": 1.0}, {"force": laid(
        0.1 * np.eye(2), lambda logs: np.exp(logs - 0.1 * z)[..., None])})
    found = both.risk(0.01 * np.eye(2), 0.95)
    assert found.kept == pytest.approx(0.95**2, abs=2e-3)
    assert found.excess["force"] == pytest.approx(
        np.exp(0.1 * (norm.ppf(np.sqrt(0.95)) - z)), rel=2e-3)
    bent = Exposure({"force": 1.0}, {"force": laid(
        [[0.15]], lambda logs: (0.8 + logs + 0.8 * logs**2)[..., None], 0.0)})
    most = (np.sqrt(1.0 + 4 * 0.8 * 0.2) - 1.0) / (2 * 0.8)  # p + 0.8 p^2 = 0.2
    least = (-np.sqrt(1.0 + 4 * 0.8 * 0.2) - 1.0) / (2 * 0.8)
    kept = norm.cdf(most / 0.15) - norm.cdf(least / 0.15)
    assert bent.risk(np.full((1, 1), 0.15**2), 0.95).kept == pytest.approx(kept, abs=2e-3)
