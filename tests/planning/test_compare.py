"""The paper's experiment: planners over random starts, its table and its figure."""

import csv
import shutil

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.core.progress import Progress
from limber.planning.compared_planners import BASELINE, COMPARED, run_trials, summarised
from limber.planning.goals.goal_kinds import GraspGoal
from limber.planning.settings import PlanSettings
from limber.stages.paths.compare import CompareSettings, compare
from limber.stages.registry import stage_description

SETTINGS = PlanSettings(iterations=300, engine="own", seed=3)


@pytest.fixture(scope="module")
def trials(ridge_field):
    return run_trials(ridge_field, GraspGoal((0.1, 0.06, 0.02), 0.02), SETTINGS, 3, workers=1)


def test_trials_start_elsewhere_and_are_scored_alike(trials, ridge_field):
    """Each start is another; scores are of the paths; the gentle one costs least energy."""
    starts = np.array([trial.start for trial in trials])
    assert np.linalg.norm(np.diff(starts, axis=0), axis=1).min() > 0.01
    for trial in trials:
        assert set(trial.paths) == set(COMPARED) and trial.gap_percent < 5.0
        for name, path in trial.paths.items():
            assert np.allclose(path[0], trial.start)
            length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
            assert trial.scores[name].length_m == pytest.approx(length)
            assert trial.scores[name].peak_energy_j == ridge_field.energy(path).max()
    energy = [sum(trial.scores[name].energy_integral_jm for trial in trials)
              for name in ("eikonal", BASELINE)]
    assert energy[0] < energy[1]


def test_the_table_has_means_deviations_and_changes(trials):
    """Against the mean of RRT* as its tree has it; a planner without a path in a trial counts in
    the others alone."""
    found = summarised(trials)
    lengths = np.array([trial.scores["eikonal"].length_m for trial in trials])
    base = np.array([trial.scores[BASELINE].length_m for trial in trials])
    gentle = found["eikonal"]
    assert gentle["length_m_mean"] == pytest.approx(lengths.mean())
    assert gentle["length_m_deviation"] == pytest.approx(lengths.std(ddof=1))
    assert gentle["longer_percent"] == pytest.approx(100 * (lengths.mean() / base.mean() - 1))
    assert found[BASELINE]["saved_percent"] == 0.0
    less = [*trials[:2], type(trials[2])(2, trials[2].start, {}, {}, trouble="none")]
    assert summarised(less)["eikonal"]["trials"] == 2


@pytest.mark.slow  # a plan on a branch's field
def test_the_command_writes_table_and_figure(planned_branch, tmp_path, monkeypatch):
    folder = shutil.copytree(planned_branch, tmp_path / "copy.branch")
    settings = CompareSettings(trials=1, seed=3)
    result = compare(folder, settings, workers=1, progress=Progress(on_warning=pytest.fail))
    with (folder / "comparisons/planners.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["planner"] for row in rows] == list(COMPARED.values())
    assert (folder / "comparisons/planners.png").stat().st_size > 10_000
    (title, table), = stage_description("compare").result.of(result).tables()
    assert "1 random starts" in title and len(table) == 1 + len(COMPARED)
    assert table[1][0] == "copy" and table[1][3] == "" and float(table[5][5]) != 0.0
    monkeypatch.setattr("limber.planning.compared_planners.run_trials", pytest.fail)
    assert compare(folder, settings) == result, "it is current"
    with pytest.raises(InputError, match="cannot name"):
        compare(folder, settings, name="../there")
