"""The branch folder: atomic stages, checksums, formats, and what must never be lost."""

import json
import os
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from limber.core.alignment import Alignment
from limber.core.errors import BranchFolderError, InputError, WorkError
from limber.core.files.atomic import write_atomically
from limber.core.json_values import plain
from limber.core.settings import Settings
from limber.store import FORMAT_VERSION, Branch, disk_errors
from limber.store import branch as module


@pytest.fixture
def branch(tmp_path: Path) -> Branch:
    """A branch folder with one finished stage."""
    branch = Branch.create(tmp_path / "apple.branch")
    with branch.stage("first", {"size": 3}) as stage:
        stage.path("data.txt").write_text("one")
        stage.result["count"] = np.int64(1)
    return branch


def test_stage_enters_folder_and_manifest(branch: Branch):
    """A finished stage's file, checksum, settings and result can be read back by another opener."""
    again = Branch.open(branch.folder)
    assert again.path("data.txt").read_text() == "one"
    assert again.manifest.stages["first"].result == {"count": 1}
    assert again.manifest.files["data.txt"].stage == "first"
    assert again.name == "apple"
    assert not list(branch.folder.glob(".first*"))


def test_what_no_reader_takes_is_not_written(branch: Branch):
    """The end of an open interval may be any number: beyond all quantities it is unknown."""
    with branch.stage("wide") as stage:
        stage.result["interval"] = [1.0, 5.9e44, float("inf")]
    again = Branch.open(branch.folder)
    assert again.manifest.stages["wide"].result == {"interval": [1.0, None, None]}


@pytest.mark.parametrize("failure", [ValueError, KeyboardInterrupt])
def test_a_branch_that_failed_to_begin_leaves_no_folder(tmp_path: Path, failure, branch: Branch):
    """One with a result, or with a file of somebody's own, stays as it is."""
    new = Branch.create(tmp_path / "new.branch")
    for begun in (new, branch, Branch.create(tmp_path / "own.branch")):
        if begun.name == "own":
            (begun.folder / "notes.txt").write_text("mine")
        before = {path.name for path in begun.folder.iterdir()}
        with pytest.raises(failure), begun.dropped_if_empty(), begun.stage("made") as stage:
            stage.path("half.txt").write_text("half")
            raise failure
        if begun is new:
            assert not begun.folder.exists()
        else:
            kept = {path.name for path in begun.folder.iterdir()}
            assert before <= kept and "half.txt" not in kept
            assert Branch.open(begun.folder).name == begun.name


@pytest.mark.parametrize("failure", [ValueError, KeyboardInterrupt, SystemExit])
def test_failed_stage_leaves_everything_as_it_was(branch: Branch, failure: type[BaseException]):
    """An error or Ctrl-C in the middle of a stage changes no file and leaves no litter."""
    before = {p.name: p.read_bytes() for p in branch.folder.iterdir() if p.is_file()}
    with pytest.raises(failure), branch.stage("first", {"size": 4}) as stage:
        stage.path("data.txt").write_text("half")
        raise failure
    assert {p.name: p.read_bytes() for p in branch.folder.iterdir() if p.is_file()} == before
    assert not [p for p in branch.folder.iterdir() if p.is_dir()]


def test_is_current_follows_settings_inputs_and_files(branch: Branch):
    """A stage is run again exactly when its settings, its inputs or its files have changed."""
    with branch.stage("second", {"k": 1}, reads=["data.txt"], digests={"cloud": "abc"}) as stage:
        stage.path("out.txt").write_text("two")
    current = {"reads": ["data.txt"], "digests": {"cloud": "abc"}}
    assert branch.is_current("second", {"k": 1}, **current)
    assert not branch.is_current("second", {"k": 2}, **current)
    assert not branch.is_current("second", {"k": 1}, reads=["data.txt"], digests={"cloud": "x"})
    with branch.stage("first", {"size": 5}) as stage:
        stage.path("data.txt").write_text("changed")
    assert not branch.is_current("second", {"k": 1}, **current)
    (branch.folder / "data.txt").write_text("by hand")
    assert not branch.is_current("first", {"size": 5})


def test_damaged_file_is_named(branch: Branch):
    """Changed bytes of the same length are found by checksum; the message names file and stage."""
    branch.path("data.txt").write_text("eno")
    with pytest.raises(BranchFolderError, match=r"data\.txt \(other content\).*first"):
        Branch.open(branch.folder, verify=True)


def test_gravity_that_is_no_vector_is_refused(branch: Branch):
    with branch.stage("mesh", {}) as stage:
        stage.result["gravity_m_s2"] = False
    with pytest.raises(InputError, match="gravity"):
        _ = Branch.open(branch.folder).gravity


def test_damaged_file_stops_its_readers_but_not_its_maker(branch: Branch):
    """A damaged file cannot be read or built on; the stage that makes it puts things right."""
    branch.path("data.txt").write_text("eno")
    again = Branch.open(branch.folder)
    for use in (lambda: again.path("data.txt"), lambda: again.require("data.txt", "x"),
                lambda: again.stage("second", reads=["data.txt"]).__enter__()):
        with pytest.raises(BranchFolderError, match="other content"):
            use()
    with again.stage("first", {"size": 3}) as stage:
        stage.path("data.txt").write_text("one")
    assert Branch.open(branch.folder, verify=True).path("data.txt").read_text() == "one"


def test_missing_file_is_named(branch: Branch):
    """A file that was deleted is reported as missing."""
    branch.path("data.txt").unlink()
    with pytest.raises(BranchFolderError, match=r"data\.txt \(missing\)"):
        Branch.open(branch.folder).path("data.txt")


def test_a_file_made_anew_meanwhile_is_not_called_damaged(branch: Branch):
    """A reader whose file another program replaced is told so, not that the folder is broken."""
    reader = Branch.open(branch.folder)
    with branch.stage("first", {"size": 4}) as stage:
        stage.path("data.txt").write_text("newer")
    with pytest.raises(BranchFolderError, match=r"replaced or removed data\.txt"):
        reader.path("data.txt")
    assert Branch.open(branch.folder).path("data.txt").read_text() == "newer"


def test_every_branch_has_a_uuid_of_its_own(branch: Branch, tmp_path: Path):
    """It is there from the first moment, stays when stages write, and differs between branches."""
    uuid = Branch.open(branch.folder).uuid
    with branch.stage("second"):
        pass
    assert Branch.open(branch.folder).uuid == uuid
    assert Branch.create(tmp_path / "pear.branch").uuid not in (uuid, None)


def test_newer_format_is_refused(branch: Branch):
    """A folder of a newer format is refused with both versions and what to do."""
    path = branch.folder / "branch.json"
    content = json.loads(path.read_text()) | {"format_version": FORMAT_VERSION + 1}
    path.write_text(json.dumps(content))
    with pytest.raises(BranchFolderError, match=f"format {FORMAT_VERSION + 1}.*Update Limber"):
        Branch.open(branch.folder)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"name": 3}', '{"format_version": 1}'])
def test_damaged_manifest_is_refused(branch: Branch, text: str):
    """A manifest that is empty, cut off or of another shape gives a clear error, not a trace."""
    (branch.folder / "branch.json").write_text(text)
    with pytest.raises(BranchFolderError, match="damaged"):
        Branch.open(branch.folder)


def test_foreign_folder_is_not_written_to(tmp_path: Path):
    """A folder with other files is never taken for a branch folder."""
    (tmp_path / "photo.jpg").write_bytes(b"x")
    with pytest.raises(BranchFolderError, match="not a branch folder"):
        Branch.create(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["photo.jpg"]


def test_place_that_cannot_be_written(tmp_path: Path):
    """An output path below a file is reported as such."""
    (tmp_path / "file").write_text("")
    with pytest.raises(BranchFolderError, match="cannot be written"):
        Branch.create(tmp_path / "file" / "x.branch")


def test_no_such_folder(tmp_path: Path):
    """Opening what is not there says how to make one."""
    with pytest.raises(BranchFolderError, match="limber reconstruct"):
        Branch.open(tmp_path / "nothing.branch")


@pytest.mark.parametrize("name", ["../x", "/etc/x", "", "branch.json", ".lock", "a\\b"])
def test_names_stay_inside(branch: Branch, name: str):
    """No file name leads out of the folder or onto the manifest."""
    with pytest.raises(InputError):
        branch.path(name)


def test_removed_and_listed(branch: Branch):
    """A stage can drop files of its earlier run; `names` lists what is below a folder."""
    with branch.stage("pull:a") as stage:
        stage.path("pulls/a/robot.csv").write_text("t")
        stage.path("pulls/a/clouds/0.ply").write_text("t")
    with branch.stage("pull:b") as stage:
        stage.path("pulls/b/robot.csv").write_text("t")
    assert branch.names("pulls") == ["a", "b"]
    with branch.stage("pull:a") as stage:
        stage.path("pulls/a/robot.csv").write_text("t")
        stage.remove("pulls/a/clouds/0.ply")
    assert not branch.path("pulls/a/clouds/0.ply").exists()
    Branch.open(branch.folder, verify=True)


def test_two_openers_do_not_lose_each_others_stages(branch: Branch):
    """A stage that began before another one ended still keeps the other's entry."""
    other = Branch.open(branch.folder)
    with branch.stage("second") as stage:
        stage.path("b.txt").write_text("b")
        with other.stage("third") as inner:
            inner.path("c.txt").write_text("c")
    again = Branch.open(branch.folder)
    assert set(again.manifest.stages) == {"first", "second", "third"}


def test_write_atomically_keeps_the_old_file_on_failure(tmp_path: Path, monkeypatch):
    """When the last step fails, the old content stays and no temporary file is left."""
    path = tmp_path / "a.json"
    write_atomically(path, "old")

    def refuse(*_paths: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, "new")
    monkeypatch.undo()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_alignment_can_be_undone():
    """Points far from the origin in millimetres come back to within a micrometre."""
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    alignment = Alignment(scale=1e-3, origin=(4.2e5, 5.3e6, 100.0), rotation=turn.tolist())
    points = np.array([[4.2e8 + 1.25, 5.3e9 - 7.5, 1.0e5 + 3.0]])
    assert np.abs(alignment.undo(alignment.apply(points)) - points).max() < 1e-3


def test_plain_makes_json():
    """numpy values, paths and models become JSON; what is not finite becomes null."""
    value = {"a": np.float32(1.5), "b": np.arange(2), "c": (Path("x"), np.nan), "d": np.True_}
    assert json.loads(json.dumps(plain(value))) == {
        "a": 1.5, "b": [0, 1], "c": ["x", None], "d": True}


def test_paths_too_long_for_windows(tmp_path: Path, monkeypatch):
    """Refused with a sentence, before any work: to make, to write to and to read a folder. Read are
    paths that just fit."""
    folder = tmp_path / ("n" * 100) / "apple.branch"
    folder.parent.mkdir()
    with Branch.create(folder).stage("first") as stage:
        stage.path("plans/path.csv").write_text("one")
    monkeypatch.setattr(disk_errors, "limits_paths", lambda: True)
    just = len(str(folder / "plans/path.csv"))
    monkeypatch.setattr(disk_errors, "_LONGEST_PATH", just)
    assert Branch.read(folder).has("plans/path.csv")
    for act in (Branch.open, Branch.create):
        with pytest.raises(BranchFolderError, match=f"at most {just} characters.*LongPathsEnabled"):
            act(folder)
    monkeypatch.setattr(disk_errors, "_LONGEST_PATH", just - 1)
    with pytest.raises(BranchFolderError, match=f"would have {just} characters"):
        Branch.read(folder)
    with pytest.raises(BranchFolderError, match="shorter path"):
        Branch.create(folder.with_name("pear.branch"))
    assert not folder.with_name("pear.branch").exists()
    monkeypatch.setattr(disk_errors, "_LONGEST_PATH", just + disk_errors.NAME_ROOM)
    assert Branch.open(folder).name == "apple"


# When a stage counts as out of date though nothing was changed, and when it does not begin.


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
