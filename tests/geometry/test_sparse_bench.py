"""The bench of sparse scans: its cases, its changes, and what its rows say."""

import subprocess

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks import peers, sparse_scans
from benchmarks.real_scans import AS_IT_IS
from benchmarks.sparse_scans import PERTURBED, subject
from benchmarks.table import Setting
from benchmarks.trials import Budget
from limber.core.progress import SILENT
from limber.geometry.cloud.cloud import Cloud


def test_a_sparse_scan_lies_on_its_truth() -> None:
    """Nine tenths of 300 to 1,500 points and the 1 to 3 % of stray ones are on true wood."""
    known = subject("drooping:round", 3)
    away = cKDTree(known.axes).query(known.cloud.points)[0]
    assert 300 < len(known.cloud) < 1545 and 0.9 < (away < 0.02).mean() < 0.999
    assert known.length == pytest.approx(0.001 * len(known.axes), rel=0.05)
    assert 1e-5 < known.volume < 1e-3


def test_changes_are_as_small_as_they_say() -> None:
    points = np.random.default_rng(2).normal(size=(400, 3))
    spacing = np.median(cKDTree(points).query(points, k=2)[0][:, 1])
    less, moved = (PERTURBED[name](Cloud(points), {}, np.random.default_rng(4))[0].points
                   for name in ("two less", "noise"))
    assert len(less) == 398
    assert np.linalg.norm(moved - points, axis=1).mean() == pytest.approx(0.5 * spacing, rel=0.15)


def _rows(monkeypatch, tmp_path, change: str, **other: object) -> str:
    """What the row of perturbations says where one change gives other values."""
    def measured(task: tuple[str, str, int]) -> dict:
        return {"length_m": 1.0, "length_interval_m": [0.9, 1.1], "volume_m3": 1e-4,
                "volume_interval_m3": [0.5e-4, 2e-4]} | (other if task[1] == change else {})

    monkeypatch.setattr(sparse_scans, "measured", measured)
    monkeypatch.setattr(sparse_scans, "present", lambda names: [])
    monkeypatch.setattr("benchmarks.trials.core_budget", lambda: 1)
    tmp_path.mkdir(exist_ok=True)
    row, = sparse_scans.perturbation_rows(Setting(3, False, Budget(60.0), SILENT, tmp_path))
    assert row.count == 12 * 6
    return f"{row.met} {row.measured}"


def test_a_change_that_moves_a_scan_far_is_not_met(monkeypatch, tmp_path) -> None:
    told = _rows(monkeypatch, tmp_path, AS_IT_IS)
    assert told.startswith("True") and "0 of 144 intervals do not overlap" in told
    told = _rows(monkeypatch, tmp_path / "far", "two less", volume_m3=9e-4,
                 volume_interval_m3=[4e-4, 2e-3])
    assert told.startswith("False") and "volume: median 0.0%, worst 800%, 48 of 60 within" in told
    assert "12 of 144 intervals do not overlap: drooping" in told
    # Half of the points may move a length by a tenth.
    told = _rows(monkeypatch, tmp_path / "half", "half", length_m=1.09)
    assert told.startswith("True") and "half length: median 9.0%" in told


def test_true_axes_of_another_program_are_found_whole(tmp_path) -> None:
    """Written in the frame that a program gets, they come back to the scan's, with their radii."""
    known = subject("drooping:one-sided", 4)
    truth, (turn, shift) = known.truth, peers._frame(known)
    nodes = (truth.nodes - shift) @ turn.T
    segments = np.stack([nodes[truth.parent[1:]], nodes[1:]], axis=1)
    assert abs(nodes[0]).max() < 1e-12 and nodes[:, 2].mean() > 0
    np.savez(tmp_path / "one.npz", segments=segments, radii=1.1 * truth.radius[1:], seconds=2.0)
    told = peers._numbers(known, tmp_path / "one.npz")
    assert told["found"] == told["own"] == 1 and told["cpu_s"] == 2
    assert told["length_m"] == pytest.approx(told["true_length_m"], rel=1e-6)
    assert told["radius_bias"] == pytest.approx(0.1, abs=0.02)
    assert told["volume_m3"] == pytest.approx(1.21 * known.volume, rel=0.1)
    (tmp_path / "two.txt").write_text("ValueError: no stem")
    row = peers._row(peers.PEERS[0], [told, peers._numbers(known, tmp_path / "two.npz")])
    assert row.measured.startswith("100 / 100 %; length 1.00; ")
    assert row.measured.endswith("1 failed: ValueError: no stem") and row.count == 2


def test_without_the_registry_other_programs_are_skipped_with_a_word(monkeypatch, tmp_path):
    def environment() -> None:
        raise subprocess.CalledProcessError(1, "pip", stderr="notice\nno matching distribution")

    monkeypatch.setattr(peers, "environment", environment)
    told = peers.rows(Setting(3, True, Budget(60.0), SILENT, tmp_path))
    assert len(told) == len(peers.PEERS)
    assert all(row.count == 0 and "no matching distribution" in row.measured for row in told)
