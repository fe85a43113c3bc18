"""The bench of scans: parts of its table, cases that are kept, and the fit of probabilities."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks import scan_scores, scans
from benchmarks.real_scans import CHANGED, other_forks
from benchmarks.scan_probabilities import fitted
from benchmarks.scan_scores import fork_matches
from benchmarks.table import Row, Setting
from benchmarks.trials import Budget
from limber.core.progress import SILENT
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.skeleton.skeleton import Skeleton

_SCORES = {"forks": 2, "forks_found": 2, "forks_false": 0, "centre_radii": 0.1, "centre_m": 1e-4,
           "radius_error": 0.01, "radius_bias": 0.01, "covered": 0.95, "volume": 0.01, "shown": 1.0,
           "main_axis_radii": 0.3, "length_held": True, "volume_held": True,
           "told_forks": [[0.95, 1.0]], "told_bridges": [[0.7, 1.0]],
           "told_nodes": [[1.0, 0.9, 1.0, 1.0]] * 10, "paper": 0.08, "watertight": True}


def test_parts_take_what_other_parts_kept(monkeypatch, tmp_path) -> None:
    """A part that is measured again makes no case again."""
    made = []

    def scored(task: tuple[str, int]) -> dict:
        made.append(task)
        return _SCORES | ({"main_axis_radii": np.inf} if task[1] % 2 else {})
    monkeypatch.setattr(scan_scores, "scored_case", scored)
    monkeypatch.setattr("benchmarks.trials.core_budget", lambda: 1)

    def rows(part: str, seconds: float = 60.0) -> list[Row]:
        return scans.PARTS[part].run(Setting(3, True, Budget(seconds), SILENT, tmp_path))
    for part in ("one-sided", "round"):
        table = rows(part)
        assert all(row.met and row.count == 4 for row in table)
    assert len(rows("round")) == 4 and len(made) == 8
    gaps, = rows("gaps")
    again, = rows("gaps")
    assert gaps == again and gaps.measured.startswith("2 of 4 (worst inf")
    # Of cases for which there is no time a row says nothing.
    (tmp_path / "trials.jsonl").unlink()
    assert rows("round", -1.0)[0].count == 1


def test_a_root_counts_if_it_is_right_or_asked(monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(scans, "_root_trial", lambda task: {
        "right": task[1] % 2, "stated": 0.5 if task[1] % 3 else 0.99})
    monkeypatch.setattr("benchmarks.trials.core_budget", lambda: 1)
    row, = scans.PARTS["root"].run(Setting(3, True, Budget(60.0), SILENT, tmp_path))
    assert row.measured == "2 of 3; 2; 0.493" and row.met is False


def test_a_case_that_fails_is_counted(monkeypatch, tmp_path) -> None:
    """Neither a refusal nor a crash ends the bench: the row is not met, and says so."""
    monkeypatch.setattr(scan_scores, "_scored", lambda one, _: _SCORES | {"n": 1 / (one.seed % 2)})
    monkeypatch.setattr("benchmarks.trials.core_budget", lambda: 1)
    setting = Setting(3, True, Budget(60.0), SILENT, tmp_path)
    found = scan_scores.outcomes(setting, {"gaps": 2})["gaps"]
    assert "ZeroDivisionError" in found.failed[0] and len(found.scores) == 1
    row, = scans.gap_rows(found)
    assert row.met is False and "1 not reconstructed" in row.measured


def test_both_forks_of_a_pair_are_true_wherever_they_are_found() -> None:
    """A pair of side branches at one node, found at two nodes, has no false fork, and a third
    side branch there is false; a pair found at one node is found whole.
    """
    def tree(*feet: int) -> Skeleton:
        axis = np.column_stack([np.zeros((21, 2)), np.linspace(0, 0.2, 21)])
        tips = [axis[foot] + [0.05 * np.cos(2 * k), 0.05 * np.sin(2 * k), 0]
                for k, foot in enumerate(feet)]
        return Skeleton.from_edges(np.vstack([axis, *tips]), np.concatenate([
            np.arange(21) - 1, feet]), np.full(21 + len(feet), 0.005))
    pair = tree(10, 10)
    for found, hits, right in ((tree(10, 11), 2, [1, 1]), (tree(10, 10), 2, [1, 1]),
                               (tree(9, 10, 11), 2, [0, 1, 1]), (tree(10), 1, [1])):
        got, true = fork_matches(pair, found)
        assert got == hits and sorted(true) == right
    assert fork_matches(tree(10, 11), pair)[0] == 2


def test_the_fit_of_probabilities_finds_the_odds_that_made_them() -> None:
    """20,000 outcomes of known odds, of which a tenth fails besides; one slope of the wrong sign:
    that is held at 0."""
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(20_000, 4))
    true = np.array([0.5, 1.2, -0.6, -0.8, -0.3])
    there = rng.uniform(size=len(rows)) < 0.9 / (1 + np.exp(-(true[0] + rows @ true[1:])))
    found = fitted(rows, there, (1, 1, -1, -1), 0.9)
    assert found[[0, 1, 3, 4]] == pytest.approx(true[[0, 1, 3, 4]], abs=0.2)
    assert found[2] == 0


@pytest.mark.parametrize("change", list(CHANGED))
def test_a_changed_scan_goes_back_to_the_original(change: str) -> None:
    """Its points, taken back, are the original's; the root that the user states moves along."""
    rng = np.random.default_rng(5)
    points = rng.normal(size=(400, 3)) * [0.1, 0.1, 0.5]
    settings = {"up": (0.0, 0.1, 1.0), "root": tuple(points[7].tolist())}
    cloud, changed, back = CHANGED[change](Cloud(points), settings, rng)
    away, _ = cKDTree(points).query(back(cloud.points))
    added = {"outliers": 4, "ground": 200}.get(change, 0)
    assert (away < 1e-9).sum() == len(cloud) - added
    assert len(cloud) == {"half": 200, "duplicates": 480}.get(change, 400 + added)
    factor = 1000.0 if changed.get("unit") == "mm" else 1.0
    assert np.linalg.norm(back(np.array([changed["root"]])) - points[7]) < 1e-9 * factor


def test_forks_of_two_trees_are_compared_with_their_probabilities() -> None:
    one = [[0, 0, 0, 0.01, 0.99], [0, 0, 1, 0.01, 0.7]]
    other = [[0, 0.02, 0, 0.01, 0.95], [0, 1, 0, 0.01, 0.9]]
    assert other_forks(one, other) == (2, 1)
    assert other_forks(one, one) == (0, 0)
    assert other_forks(one, []) == (2, 1)
