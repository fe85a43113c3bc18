"""A branch folder from anybody: it writes, removes and gives away nothing outside itself."""

import hashlib
import json
import os
import shutil
import threading
import time
import zipfile
from pathlib import Path

import pytest

from limber.cli.main import call
from limber.core.errors import BranchFolderError, InputError
from limber.core.files.safe_names import FOLLOW_LINKS, inside, relative_name
from limber.store import Branch, journal
from limber.store.lock import commit_lock
from limber.store.manifest import checked_name

OUTSIDE = ["../victim.txt", "../../victim.txt", "pulls/../../victim.txt", "/etc/victim.txt", "..",
           "", ".", "a\\..\\..\\victim.txt", "C:/victim.txt", "C:victim.txt", "pulls/C:victim.txt",
           "//server/share/victim.txt", "\\\\server\\victim.txt", "pulls/.. /victim.txt", "a\0b",
           "a\nb", "\ud800"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A branch folder with one file, and beside it a victim."""
    (tmp_path / "victim.txt").write_text("precious")
    branch = Branch.create(tmp_path / "in" / "a.branch")
    with branch.stage("a", {"n": 1}) as stage:
        stage.path("x.txt").write_text("old")
    return branch.folder


def _changed(folder: Path, **files: str | None) -> str:
    """The folder's manifest with files added, or removed where the content is None."""
    content = json.loads((folder / "branch.json").read_text())
    for name, text in files.items():
        content["files"].pop(name, None)
        if text is not None:
            content["files"][name] = {"sha256": hashlib.sha256(text.encode()).hexdigest(),
                                      "bytes": len(text), "stage": "a"}
    return json.dumps(content)


def _interrupt(folder: Path, **files: str) -> None:
    """Leave what a program leaves that was killed as it began to move its files into place."""
    pending = folder / ".commit"
    for name, text in files.items():
        (pending / name).parent.mkdir(parents=True, exist_ok=True)
        (pending / name).write_text(text)
    (pending / "branch.json").write_text(_changed(folder, **files))


def _state(place: Path) -> dict[str, object]:
    return {str(path): (os.readlink(path) if path.is_symlink() else
                        (path.read_bytes() if path.is_file() else None, path.stat().st_mtime_ns))
            for path in [place, *sorted(place.rglob("*"))]}


@pytest.mark.parametrize("name", OUTSIDE)
def test_names_that_lead_out_are_refused(tmp_path, name):
    """Upwards, absolute, with a drive or a backslash, or no name at all; on every system."""
    with pytest.raises(InputError):
        relative_name(name)
    with pytest.raises(InputError):
        inside(tmp_path, name)


@pytest.mark.parametrize("name", [
    "NUL", "frames/con.pc2", "aux/x", "COM1", "Lpt9 .log", "a.", "frames/a ", "a. /b",
    "branch.json::$DATA", "branch.json:x", "branch.json.", "Branch.JSON "])
def test_names_that_mean_another_file_on_windows_are_refused(name):
    """Devices, hidden streams, and what is the manifest without its last character."""
    with pytest.raises(InputError):
        checked_name(name)
    assert checked_name("consul/auxin.nul") == "consul/auxin.nul"


def test_plain_names_are_taken(tmp_path):
    """What stages write: folders, dots, colons, spaces and letters of any alphabet."""
    for name in ("x.txt", "pulls/pull-1/depth/0.5.png", "plans/12:30.json", "pulls/my pull/é.csv",
                 "pulls/a..b/..c"):
        assert inside(tmp_path, name) == tmp_path / name


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in OUTSIDE if name not in ("", ".", "..")])
@pytest.mark.parametrize("listed_by", ["manifest", "commit", "old manifest"])
def test_no_file_outside_is_removed_or_written(folder, name, listed_by):
    """The manifest, or that of an interrupted commit, lists a file elsewhere."""
    name = str(folder.parents[1] / "victim.txt") if name == "/etc/victim.txt" else name
    if listed_by == "manifest":
        (folder / "branch.json").write_text(_changed(folder, **{name: "evil"}))
    else:
        _interrupt(folder, **{"new.txt": "new"})
        target = folder if listed_by == "old manifest" else folder / ".commit"
        (target / "branch.json").write_text(_changed(folder, **{name: "evil"}))
    before = _state(folder.parents[1])
    for arguments in (["verify"], ["verify", "--finish"], ["report"]):
        assert call([*arguments, str(folder)]) == 2, arguments
    after = _state(folder.parents[1])
    # A command that writes may have taken its lock.
    changed = {path for path in before.keys() | after.keys() if before.get(path) != after.get(path)}
    assert {Path(path) for path in changed} <= {folder, folder / ".lock"}
    assert (folder.parents[1] / "victim.txt").read_text() == "precious"


@pytest.mark.parametrize("where", ["pulls", ".commit", ".commit/pulls", ".streams", ".lock",
                                   ".run.lock", ".run.json", "branch.json", "x.txt", "deep/down"])
def test_links_are_refused_and_nothing_goes_through_them(folder, tmp_path, where):
    """A link in the place of a folder or of a file, of the branch or of Limber's own."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    if where == ".commit":
        # A whole commit stands where the link leads.
        _interrupt(folder, **{"pulls/p/pull.toml": "evil"})
        elsewhere.rmdir()
        shutil.move(folder / ".commit", elsewhere)
    else:
        _interrupt(folder, **{"pulls/p/pull.toml": "evil"})
    link = folder / where
    if link.is_dir():
        shutil.rmtree(link)
    link.unlink(missing_ok=True)
    link.parent.mkdir(exist_ok=True)
    is_file = where.endswith((".lock", ".json", ".txt"))
    link.symlink_to(tmp_path / "victim.txt" if is_file else elsewhere)
    before = _state(tmp_path)
    for arguments in (["verify"], ["verify", "--finish"], ["report"]):
        assert call([*arguments, str(folder)]) == 2, arguments
    with pytest.raises(BranchFolderError, match="is a link"):
        Branch.open(folder)
    with pytest.raises(BranchFolderError, match="is a link"):
        Branch.create(folder)
    assert _state(tmp_path) == before


def test_a_folder_with_nothing_but_a_link_for_a_lock_is_refused(tmp_path):
    """Taking the lock would empty the file that the link leads to."""
    (tmp_path / "victim.txt").write_text("precious")
    (tmp_path / "a.branch").mkdir()
    (tmp_path / "a.branch" / ".lock").symlink_to(tmp_path / "victim.txt")
    with pytest.raises(BranchFolderError, match="is a link"):
        Branch.create(tmp_path / "a.branch")
    assert (tmp_path / "victim.txt").read_text() == "precious"


def test_links_are_followed_where_the_user_says_so(folder, tmp_path):
    """A large file that is kept on another disk; a name that leads out is refused all the same."""
    shutil.move(folder / "x.txt", tmp_path / "large.txt")
    (folder / "x.txt").symlink_to(tmp_path / "large.txt")
    assert call(["--follow-links", "verify", str(folder)]) == 0
    assert FOLLOW_LINKS not in os.environ and call(["verify", str(folder)]) == 2
    (folder / "branch.json").write_text(_changed(folder, **{"../../victim.txt": "evil"}))
    assert call(["--follow-links", "verify", str(folder)]) == 2
    report = tmp_path / "bug.zip"
    assert call(["--follow-links", "bug-report", str(folder), "-o", str(report), "--data"]) == 0
    with zipfile.ZipFile(report) as archive:
        assert "branch/x.txt" not in archive.namelist()


def test_a_branch_folder_may_itself_be_a_link(folder, tmp_path):
    """Where the user keeps it is the user's business."""
    (tmp_path / "b.branch").symlink_to(folder)
    Branch.open(tmp_path / "b.branch", verify=True)
    Branch.read(tmp_path / "b.branch").verify()


def test_reading_an_interrupted_folder_changes_nothing(folder, capsys):
    """verify compares as-if finished, others say which command finishes; that one does."""
    _interrupt(folder, **{"pulls/p/pull.toml": "new", "x.txt": "new"})
    before = _state(folder)
    assert call(["verify", str(folder), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["is_unfinished"] and told["file_count"] == 2 and not told["unlisted"]
    report = folder.parent / "bug.zip"
    assert call(["bug-report", str(folder), "-o", str(report)]) == 0
    with zipfile.ZipFile(report) as archive:
        assert json.loads(archive.read("report.json"))["is_unfinished"]
    for arguments in (["scene", str(folder), "--data", str(folder.parent / "s.npz")],
                      ["export", str(folder), "-o", str(folder.parent / "b.urdf")],
                      ["predict", str(folder), "--weight", "0.1"], ["skeleton", str(folder)],
                      ["load", str(folder), "--wind", "1", "0", "0"]):
        call(arguments)
        said = capsys.readouterr().err
        assert f"limber verify {folder} --finish" in said, said
    assert _state(folder) == before
    assert call(["verify", str(folder), "--finish"]) == 0
    assert not (folder / ".commit").exists()
    assert (folder / "pulls/p/pull.toml").read_text() == "new"
    Branch.read(folder).verify()


def test_damage_of_an_interrupted_folder_is_found(folder, capsys):
    """A file that waits to be put in place is compared too."""
    _interrupt(folder, **{"x.txt": "new"})
    (folder / ".commit" / "x.txt").write_text("bad")
    assert call(["verify", str(folder)]) == 2
    assert "x.txt (other content)" in capsys.readouterr().err


def test_texts_of_a_folder_do_not_steer_the_terminal(folder, capsys):
    """A stage's name that would set the window's title, printed as the one to run again."""
    content = json.loads((folder / "branch.json").read_text())
    content["files"]["x.txt"]["stage"] = "a\x1b]0;title\x07\x9b31m"
    (folder / "branch.json").write_text(json.dumps(content))
    (folder / "x.txt").write_text("new")
    assert call(["verify", str(folder)]) == 2
    assert "a?]0;title??31m" in capsys.readouterr().err


def test_a_bug_report_takes_nothing_through_links(folder, tmp_path):
    """A file elsewhere that a link names stays at home, also with --data."""
    (folder / "notes.txt").symlink_to(tmp_path / "victim.txt")
    (folder / "more").symlink_to(tmp_path)
    report = tmp_path / "bug.zip"
    assert call(["bug-report", str(folder), "-o", str(report), "--data"]) == 0
    with zipfile.ZipFile(report) as archive:
        packed = {name for name in archive.namelist() if not name.endswith(".lock")}
        assert packed == {"branch/branch.json", "branch/x.txt", "report.json"}
        assert not json.loads(archive.read("report.json"))["opens"]


def test_a_second_name_of_a_file_elsewhere_is_left_alone(folder, tmp_path):
    """An archive may make one: a stream goes on with a copy, a bug report keeps it at home."""
    for name in (".streams/pulls/p/robot.csv", "pulls/p/note.txt"):
        (folder / name).parent.mkdir(parents=True)
        os.link(tmp_path / "victim.txt", folder / name)
    branch = Branch.open(folder)
    with branch.stream("pulls/p/robot.csv") as stream:
        stream.append("1,2")
    assert (folder / ".streams/pulls/p/robot.csv").read_text() == "1,2\n"
    assert (tmp_path / "victim.txt").read_text() == "precious"
    report = tmp_path / "bug.zip"
    assert call(["bug-report", str(folder), "-o", str(report), "--data"]) == 0
    with zipfile.ZipFile(report) as archive:
        assert "branch/pulls/p/note.txt" not in archive.namelist()
        assert json.loads(archive.read("report.json"))["not_packed"] == ["pulls/p/note.txt"]


@pytest.mark.parametrize("way", ["folder for a file", "file for a folder"])
def test_what_is_in_the_way_of_a_commit_stops_it_before_it_begins(folder, way):
    """An interrupted one stays as it is, a new one leaves no trace."""
    _interrupt(folder, **{"a.txt": "new", "pulls/p": "new", "z.txt": "new"})
    if way == "folder for a file":
        (folder / "pulls/p").mkdir(parents=True)
    else:
        (folder / "pulls").write_text("x")
    before = _state(folder)
    assert call(["verify", str(folder), "--finish"]) == 2
    before[str(folder)] = before[str(folder / ".lock")] = None
    assert {**_state(folder), str(folder): None, str(folder / ".lock"): None} == before
    shutil.rmtree(folder / ".commit")
    branch = Branch.open(folder)
    with pytest.raises(BranchFolderError, match="in the way of the file pulls/p"), \
            branch.stage("b") as stage:
        stage.path("pulls/p").write_text("new")
    assert not (folder / ".commit").exists() and "b" not in Branch.read(folder).manifest.stages


def test_endless_folders_are_refused(folder):
    """Links that no path can name any more could hide in them."""
    (folder / "/".join("d" * 40)).mkdir(parents=True)
    for opened in (Branch.open, Branch.read, Branch.create):
        with pytest.raises(BranchFolderError, match="nested more than 32 deep"):
            opened(folder)


def test_a_recording_with_links_is_not_imported(folder, tmp_path, capsys):
    """The files that they lead to would come into the branch, and from there to others."""
    (tmp_path / "pull").mkdir()
    (tmp_path / "pull" / "pull.toml").write_text("grasp = 1")
    (tmp_path / "pull" / "force.csv").symlink_to(tmp_path / "victim.txt")
    assert call(["import-pull", str(folder), str(tmp_path / "pull"), "--name", "p"]) == 2
    assert "force.csv is a link" in capsys.readouterr().err
    assert not (folder / "pulls").exists()


def test_who_reads_waits_for_a_program_that_enters_its_results(folder):
    """It then sees all of them; no time is lost where that program is dead."""
    _interrupt(folder, **{"x.txt": "new"})
    begun, seen = threading.Event(), []

    def enter() -> None:
        with commit_lock(folder):
            begun.set()
            time.sleep(0.3)
            journal.roll_forward(folder)
    writer = threading.Thread(target=enter)
    writer.start()
    begun.wait()
    branch = Branch.read(folder)
    seen.append(branch.path("x.txt").read_text())
    writer.join()
    assert seen == ["new"] and not branch.is_unfinished
