"""When a stage counts as out of date though nothing was changed, and when it does not begin."""

from typing import ClassVar

import pytest

from limber.core.errors import WorkError
from limber.core.settings import Settings
from limber.store import Branch
from limber.store import branch as module


class First(Settings):
    """Settings of a stage."""

    size: int = 3


class Mended(First):
    """The same of a program that computes otherwise."""

    results_version: ClassVar[int] = 2


def test_a_program_whose_results_changed_runs_its_stage_again(tmp_path):
    """The same settings on the same input count as done only for the same version of results."""
    branch = Branch.create(tmp_path / "a.branch")
    with branch.stage("reconstruct", First()) as stage:
        stage.path("x.txt").write_text("1")
    assert branch.is_current("reconstruct", First())
    assert not branch.is_current("reconstruct", Mended())
    with branch.stage("reconstruct", Mended()) as stage:
        stage.path("x.txt").write_text("2")
    again = Branch.open(tmp_path / "a.branch")
    assert again.is_current("reconstruct", Mended())
    assert not again.is_current("reconstruct", First()), "an older program makes its own"


def test_no_stage_begins_on_a_full_disk(tmp_path, monkeypatch):
    """It says so before the work, and leaves the folder as it was."""
    branch = Branch.create(tmp_path / "a.branch")
    usage = module.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(module.shutil, "disk_usage", lambda _path: usage._replace(free=1_000_000))
    with pytest.raises(WorkError, match="1 MB left"):
        with branch.stage("reconstruct", First()) as stage:
            stage.path("x.txt").write_text("1")
    monkeypatch.undo()
    assert Branch.open(tmp_path / "a.branch").manifest.stages == {}
