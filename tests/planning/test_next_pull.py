"""The next pull: what it would tell, what it would risk, whether a plan is served by it."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from limber.core.errors import WorkError
from limber.estimation import next_pull
from limber.estimation.next_pull import (
    Cell,
    ExpectedPull,
    Known,
    PullChoice,
    _of_field,
    expected_pull,
    suggest,
)
from limber.estimation.settings import FitSpec
from limber.planning.constraints.chance import Exposure, Surface
from limber.recordings.recording import EXACT, SensorEntry
from limber.stages.pulls.suggest_pull import SuggestPull, verdict
from limber.store import Branch
from limber.store.loading import load_subject


@pytest.fixture(scope="module")
def subject(planned_branch):
    return load_subject(Branch.open(planned_branch), FitSpec(fractions=(0.3, 0.6)))


def test_information_adds_up_as_gauss_has_it():
    """Two unknowns, one of them no modulus; a repeat error that both moduli share."""
    jacobian = np.array([[2.0, 0.0, 1.0], [0.0, 3.0, 1.0], [0.0, 0.0, 4.0]])
    found = np.linalg.inv(_of_field(jacobian, 2, 0, 0.1))
    wanted = np.linalg.inv(jacobian.T @ jacobian)[:2, :2] + 0.01
    assert np.allclose(found, wanted)
    known = Known(np.diag([0.04, 0.09]), 0.01 * np.eye(2))
    after = known.after(np.diag([25.0, 0.0]))
    assert np.allclose(after.total, np.diag([0.02 + 0.01, 0.09 + 0.01]))
    assert known.gain(after) == pytest.approx(0.5 * np.log2(0.05 / 0.03))


def test_a_longer_pull_tells_more_and_strains_more(subject):
    """Each step: more bits, more strain, more force; the grasp goes about as far as asked."""
    known = Known.nothing(2)
    pulls = [expected_pull(PullChoice(0.8, 0.5, reach), subject, subject.start, known, Cell())
             for reach in (0.05, 0.2)]
    assert pulls[1].bits > pulls[0].bits > 0.0
    assert pulls[1].peak_strain > 2.0 * pulls[0].peak_strain
    assert pulls[1].peak_force > 2.0 * pulls[0].peak_force
    for pull, reach in zip(pulls, (0.05, 0.2), strict=True):
        assert np.linalg.norm(pull.end - pull.point) == pytest.approx(reach * 0.8 * 0.5, rel=0.1)
    after = known.after(pulls[1].information)
    assert (np.diag(after.total) < np.diag(known.total)).all()


def test_what_pulls_tell_of_the_form_of_the_field_adds_up():
    """Two pulls that see log E with its form, each with another sign: together they part both."""
    jacobians = [np.array([[10.0, 10.0 * sign]]) for sign in (1, -1)]
    once, elsewhere = (_of_field(each, 1, 1, 0.0) for each in jacobians)
    first = Known.nothing(1, 1).after(once)
    again, there = (first.after(each).total[0, 0] for each in (once, elsewhere))
    assert first.total[0, 0] == pytest.approx(1.0, rel=0.4)
    assert again > 0.9 * first.total[0, 0] and there < 0.01 * first.total[0, 0]


def test_a_pull_elsewhere_tells_more_than_the_same_again(subject):
    """A second pull at the same place leaves open how the modulus runs between; it is not taken
    for a new look at it."""
    known, start = Known.nothing(2, len(subject.field.names)), subject.start
    exact = Cell(SensorEntry(position_sigma_m=1e-5, force_sigma_n=1e-3), EXACT)
    first, elsewhere = (expected_pull(PullChoice(place, 0.5, 0.1), subject, start, known, exact)
                        for place in (0.92, 0.5))
    after = known.after(first.information)
    again, there = (after.gain(after.after(each.information)) for each in (first, elsewhere))
    assert there > again > 0.0


@pytest.mark.slow
def test_a_few_simulated_frames_tell_as_much_as_all_recorded(subject, monkeypatch):
    """Of what pulls tell, in each direction; four times as many tell more, but no four times:
    the cell's errors stay."""
    choice, known = PullChoice(0.8, 0.5, 0.2), Known.nothing(2)

    def told(count):
        return expected_pull(choice, subject, subject.start, known,
                             Cell(frame_count=count)).information

    few, many = told(36), told(144)
    monkeypatch.setattr(next_pull, "_FRAMES", 36)
    ratios = np.linalg.eigvals(np.linalg.solve(told(36), few)).real
    assert np.allclose(ratios, 1.0, atol=0.15)
    more = np.linalg.eigvals(np.linalg.solve(few, many)).real
    assert (more > 1.0).all() and (more < 4.0).all()


@pytest.mark.slow
def test_a_new_pull_has_as_many_frames_as_the_last(small_pull):
    """Its cell too; a swing goes on for longer than a pull."""
    cell = Cell.of(small_pull)
    assert cell.frame_count == len(small_pull.observations.times)
    assert cell.sensor == small_pull.entry.sensor
    swung = replace(small_pull, entry=small_pull.entry.model_copy(update={"motion": "swing"}))
    assert Cell.of(swung).frame_count == Cell.of(None).frame_count == Cell().frame_count


def test_an_estimate_without_finite_intervals_is_as_none():
    """Else: covariance of moduli and form as it has them, what pulls cannot narrow apart."""
    found = {"groups": [0, 0], "parameters": ["E1=E2", "bulk over shear", "form"],
             "covariance": np.diag([0.04, 0.01, 0.25]).tolist(),
             "young_pa": [1e9, 1e9], "young_interval_sensor_pa": None,
             "young_interval_pa": (1e9 * np.exp(np.outer([1, 1], [-0.392, 0.392]))).tolist()}
    known = Known.estimated(found)
    assert np.allclose(known.measured, [[0.04, 0.04, 0], [0.04, 0.04, 0], [0, 0, 0.25]], rtol=2e-4)
    assert np.allclose(known.common, 0, atol=1e-5)
    found["covariance"][0][0] = None
    assert np.allclose(Known.estimated(found).measured, Known.nothing(2, 1).measured)


def test_no_pull_within_the_strain_is_said(subject, monkeypatch):
    """With what the gentlest would do, and how many cannot be made at all."""
    made = ExpectedPull(PullChoice(0.8, 0.0, 0.1), np.zeros(3), np.ones(3), 2.0, 0.05, np.eye(2),
                        1.0)
    found = iter([made, *([None] * 20)])
    monkeypatch.setattr(next_pull, "_tried", lambda *_: next(found))
    with pytest.raises(WorkError, match=r"6 of 7 are impossible, and the gentlest .* 5 %") as error:
        suggest(subject, subject.start, Known.nothing(2), Cell(), (0.8,), max_strain=0.01)
    # No limit of the force was set: it is not advised to raise it.
    assert "--max-strain 0.0525" in str(error.value) and "--max-force" not in str(error.value)
    with pytest.raises(WorkError, match="None of 4 pulls can be simulated"):
        suggest(subject, subject.start, Known.nothing(2), Cell(), (0.8,), max_strain=0.01)


def exposed(slope, value=0.8):
    """A force that grows with the first of two moduli alone."""
    places = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    pairs, axes = np.array([[0, 0], [1, 1]]), np.diag([0.2, 1.0])
    law = value * np.exp(slope * (places @ axes.T)[:, :1])[..., None]
    return Exposure({"force": 1.0}, {"force": Surface.through(axes, pairs, places, law, 0.0)})


@pytest.mark.parametrize(("value", "now", "after", "worth", "words"), [
    (0.5, 0.2, 0.1, False, "none of them restricts it"),
    (0.8, 0.25, 0.05, True, "does not keep force"),
    (0.95, 0.25, 0.2, True, "not expected to after one"),
    (0.8, 0.13, 0.04, True, "more of that limit could be used"),
    (0.8, 0.13, 0.12, False, "only"),
])
def test_a_pull_is_worth_it_where_it_changes_what_a_plan_may_do(value, now, after, worth, words):
    """By the share of its limit that the plan takes and how well the modulus is known."""
    risks = [exposed(1.0, value).risk(np.diag([deviation**2, 1.0]), 0.95)
             for deviation in (now, after)]
    found, why = verdict(*risks, 0.95)
    assert found is worth and words in why


@pytest.mark.slow
def test_the_stage_writes_the_best_pull_and_answers_for_a_plan(planned_branch, tmp_path):
    """Best first; a plan without limits needs no other pull."""
    folder = shutil.copytree(planned_branch, tmp_path / "copy.branch")
    settings = {"max_strain": 0.05, "fractions": (0.8,)}
    result = SuggestPull(branch_folder=folder, **settings, plan="there").run()
    written = json.loads((folder / "suggested_pull.json").read_text())
    shares = [pull["bits_per_percent_strain"] for pull in [written["best"], *written["others"]]]
    assert shares == sorted(shares, reverse=True) and len(shares) > 4
    assert written["best"]["peak_strain"] <= 0.05
    assert written["most_telling"]["bits"] == max(
        pull["bits"] for pull in [written["best"], *written["others"]])
    assert all(after < now for after, now in zip(
        written["best"]["young_deviation"], written["young_deviation_now"], strict=True))
    assert result["plan"]["worth"] is False and "no limit" in result["plan"]["why"]
