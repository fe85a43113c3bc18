"""`limber cache` and `limber bug-report`."""

import json
import os
import shutil
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest

from limber.cli.main import call
from limber.core.files import caches

EXAMPLE = Path(__file__).parents[2] / "blend_files" / "bending_branch"


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """A cache of three files of 1,000 bytes, the first used longest ago."""
    monkeypatch.setattr(caches, "cache_folder", lambda: tmp_path / "cache")
    (tmp_path / "cache" / "tetrahedra").mkdir(parents=True)
    for age, name in enumerate(("new", "middle", "old")):
        path = tmp_path / "cache" / "tetrahedra" / f"{name}.npz"
        path.write_bytes(bytes(1000))
        os.utime(path, (1e9 - 100 * age,) * 2)
    return tmp_path / "cache" / "tetrahedra"


def _result(capsys):
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def test_a_cache_keeps_what_was_used_last(kept, capsys):
    """Shown, trimmed to a size, cleared; a size that is none is refused."""
    assert call(["cache", "--json"]) == 0
    assert _result(capsys)["caches"] == {"tetrahedra": {"file_count": 3, "byte_count": 3000}}
    assert call(["cache", "--limit", "0.002 MB", "--json"]) == 0
    assert _result(capsys)["freed_bytes"] == 1000
    assert sorted(path.stem for path in kept.iterdir()) == ["middle", "new"]
    assert call(["cache", "--limit", "much"]) == 2
    assert call(["cache", "--clear"]) == 0 and not list(kept.iterdir())


def test_a_bug_report_holds_the_manifest_and_no_data_unasked(tmp_path, capsys):
    """A damaged folder is told as such; with --data its files go along."""
    folder = shutil.copytree(EXAMPLE, tmp_path / "a.branch")
    (folder / "mesh.vtu").write_text("cut short")
    out = tmp_path / "bug.zip"
    assert call(["bug-report", str(folder), "-o", str(out), "--note", "it broke", "--json"]) == 0
    assert _result(capsys)["damaged_count"] == 1
    with zipfile.ZipFile(out) as archive:
        assert archive.namelist() == ["report.json", "branch/branch.json"]
        told = json.loads(archive.read("report.json"))
    assert told["note"] == "it broke" and told["damages"][0]["name"] == "mesh.vtu"
    assert told["doctor"]["python"] and told["files"]["cloud.ply"]["bytes"] > 0
    (folder / "branch.json").write_text("{")
    assert call(["bug-report", str(folder), "-o", str(out), "--data", "--json"]) == 0
    assert not _result(capsys)["opens"]
    with zipfile.ZipFile(out) as archive:
        assert "branch/cloud.ply" in archive.namelist()


def test_a_bug_report_of_a_scan(tmp_path, capsys):
    """One that no branch came of: its size and checksum, with --data the file."""
    scan, out = tmp_path / "scan.ply", tmp_path / "bug.zip"
    scan.write_bytes(b"ply, more or less")
    for words, names in (((), ["report.json"]), (("--data",), ["report.json", "scan.ply"])):
        assert call(["bug-report", str(scan), "-o", str(out), *words, "--json"]) == 0
        with zipfile.ZipFile(out) as archive:
            assert archive.namelist() == names
            assert json.loads(archive.read("report.json"))["files"]["scan.ply"]["bytes"] == 17
    assert call(["bug-report", str(tmp_path / "none"), "-o", str(out)]) == 2
    capsys.readouterr()


def test_doctor_names_what_is_wrong_with_a_cache(tmp_path, monkeypatch, capsys):
    """Empty files, and a disk without room."""
    (tmp_path / "numba").mkdir()
    (tmp_path / "numba" / "a.nbi").write_bytes(b"")
    (tmp_path / "numba" / "b.nbi").write_bytes(bytes(2_000_000))
    monkeypatch.setattr(caches, "cache_folder", lambda: tmp_path)
    assert call(["doctor", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["caches"]["numba"]
    assert told.startswith("2 files, 2 MB; 1 of them empty")
    monkeypatch.setattr("shutil.disk_usage", lambda _place: SimpleNamespace(free=5e6))
    assert call(["doctor", "--json"]) == 0
    assert "its disk has 5 MB left" in json.loads(capsys.readouterr().out)["caches"]["numba"]
