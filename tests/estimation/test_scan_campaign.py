"""The bench's campaign over scans: its table, and that a stopped run goes on."""

import json
from dataclasses import asdict

import numpy as np
import pytest

from benchmarks import estimation_scans as campaign
from benchmarks.budget import Budget
from benchmarks.estimation_scans import Trial


def _trial(seed: int, view: str, off: float = 0.0, source: str = "now", failure: str = "") -> Trial:
    """Errors of 2 % where 5 % are stated, all moved by ``off``; a failed one has none."""
    errors = () if failure else tuple(off + np.array([0.02, -0.02, 0.02, -0.02]))
    low, high = (tuple(error + sign * 0.1 for error in errors) for sign in (-1, 1))
    return Trial(seed, view, errors, low, high, len(errors) * (0.05,), (0.03, 0.04, 0.0), False,
                 failure, 1.0, source)


def test_the_share_is_that_of_all_intervals_and_a_failure_is_not_met():
    """2 of 8 intervals missed: 75 %, too few to judge. One of 10 trials wholly off: 90 %, met,
    unless another failed; two of them: not met."""
    one = _trial(1, "round")
    row = campaign.coverage_row([one, _trial(2, "one-sided", 0.09)])
    assert row.measured.startswith("75.0 % of 8 (round 100 %, one-sided 50 %") and row.met is None
    many = [_trial(seed, "round") for seed in range(9)]
    assert campaign.coverage_row([*many, _trial(9, "round", 0.3)]).met
    off = [_trial(9, "round", 0.3), _trial(10, "round", 0.3)]
    assert campaign.coverage_row([*many, *off]).met is False
    assert not campaign.coverage_row([*many, _trial(9, "round", 0.3),
                                      _trial(10, "round", failure="no mesh")]).met
    assert campaign.coverage_row([_trial(1, "round", failure="no mesh")]).met is False


def test_the_sizes_are_told_for_each_view():
    """2 % errors where 5 % are stated: 0.59 of it by the median of a normal distribution."""
    text = campaign.size_row([_trial(1, "round"), _trial(1, "one-sided")]).measured
    assert text.count("median 2.0 %, 0.59 of what is stated (sensor 3.0 %, geometry 4.0 %") == 2


def test_a_stopped_campaign_goes_on(monkeypatch, tmp_path):
    """Trials of the same sources are taken over, others and a line cut off are not."""
    monkeypatch.setattr(campaign, "_source_digest", lambda: "now")
    made = []
    monkeypatch.setattr(campaign, "trial_of", lambda task: made.append(task) or _trial(*task))
    kept = tmp_path / "scans.jsonl"
    kept.write_text(json.dumps(asdict(_trial(7, "round"))) + "\n"
                    + json.dumps(asdict(_trial(7, "one-sided", source="old"))) + "\n{\"seed\"")
    kept.write_text(kept.read_text() + "\n")
    tasks = [(seed, view) for seed in (7, 8) for view in campaign.VIEWS]
    trials = campaign.run_trials(tasks, kept, Budget(60), workers=1)
    assert made == [(7, "one-sided"), (8, "round"), (8, "one-sided")]
    assert [trial.seed for trial in trials] == [7, 7, 8, 8]
    assert campaign.run_trials(tasks, kept, Budget(60), workers=1) == trials and len(made) == 3
    assert trials[0].covered == pytest.approx(True)
