"""A program that is killed, at whatever step, leaves a branch folder before or after its stage."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from limber.owner import is_owned_name, owned_name
from limber.store import Branch

# Every change of a name on the disk is counted; the process dies before the one asked for.
_DYING = """
import os, pathlib, shutil, sys
from limber.store import Branch
folder, deadly = sys.argv[1], int(sys.argv[2])
count = 0
def counted(function):
    def call(*arguments, **options):
        global count
        count += 1
        if count == deadly:
            os._exit(9)
        return function(*arguments, **options)
    return call
def watch():
    for name in ("replace", "rename", "unlink", "rmdir", "mkdir"):
        setattr(os, name, counted(getattr(os, name)))
    shutil.rmtree = counted(shutil.rmtree)
"""
_STAGE = _DYING + """
branch = Branch.open(folder)
watch()
with branch.stage("a", {"n": 2}) as stage:
    stage.path("x.txt").write_text("new")
    stage.path("deep/y.txt").write_text("new")
    stage.remove("old.txt")
"""
_CREATE = _DYING + """
watch()
Branch.create(folder)
"""


def die(program: str, folder: Path, deadly: int) -> bool:
    """Run a program that dies at its step ``deadly``; False if it has fewer steps."""
    done = subprocess.run([sys.executable, "-c", program, str(folder), str(deadly)],
                          check=False, capture_output=True, text=True)
    assert done.returncode in (0, 9), done.stderr
    return done.returncode == 9


def litter(folder: Path) -> list[str]:
    return [p.name for p in folder.rglob("*") if is_owned_name(p.name) or p.name == ".commit"]


@pytest.fixture
def fresh(tmp_path: Path):
    """Makes a branch folder whose stage `a` wrote x.txt and old.txt."""
    def make(name: str) -> Path:
        branch = Branch.create(tmp_path / f"{name}.branch")
        with branch.stage("a", {"n": 1}) as stage:
            stage.path("x.txt").write_text("old")
            stage.path("old.txt").write_text("old")
        return branch.folder
    return make


@pytest.mark.slow
def test_a_kill_at_every_step_of_a_stage_leaves_the_folder_before_or_after(fresh):
    """At each change of a name: opened again all files are of one run; no litter after the next."""
    found = []
    deadly = 1
    while die(_STAGE, folder := fresh(str(deadly)), deadly):
        branch = Branch.open(folder, verify=True)
        state = branch.manifest.stages["a"].settings["n"]
        texts = {name: branch.path(name).read_text() for name in sorted(branch.manifest.files)}
        assert texts == ({"old.txt": "old", "x.txt": "old"} if state == 1
                         else {"deep/y.txt": "new", "x.txt": "new"}), deadly
        assert (folder / "old.txt").exists() == (state == 1)
        with branch.stage("b") as stage:
            stage.path("b.txt").write_text("b")
        assert litter(folder) == []
        Branch.open(folder, verify=True)
        found.append(state)
        deadly += 1
    # All of before, then all of after: there is one moment in which the stage comes to count.
    assert found == sorted(found)
    assert set(found) == {1, 2}
    assert len(found) >= 8


@pytest.mark.slow
def test_a_kill_at_every_step_of_create_leaves_a_folder_that_opens(tmp_path: Path):
    """New or empty before: what is there afterwards can be made a branch folder again, or is one.
    """
    for made_before in (False, True):
        deadly = 1
        while True:
            folder = tmp_path / f"{made_before}-{deadly}.branch"
            if made_before:
                folder.mkdir()
            if not die(_CREATE, folder, deadly):
                break
            Branch.create(folder)
            Branch.open(folder, verify=True)
            assert litter(folder) == []
            assert not [p for p in tmp_path.iterdir() if p.name.startswith(f".{folder.name}")]
            deadly += 1
        assert deadly > 1


@pytest.mark.slow
def test_a_commit_that_another_program_left_half_done_comes_first(fresh):
    """An opener from before the kill, who never looked at the journal, still loses nothing."""
    folder = fresh("left")
    early = Branch.open(folder)
    deadly = 1
    while die(_STAGE, folder, deadly) and not (folder / ".commit").exists():
        deadly += 1
    assert (folder / ".commit").exists()
    with early.stage("b") as stage:
        stage.path("b.txt").write_text("b")
    branch = Branch.open(folder, verify=True)
    assert set(branch.manifest.stages) == {"a", "b"}
    assert branch.path("x.txt").read_text() == "new"
    assert branch.path("b.txt").read_text() == "b"


def test_only_what_dead_processes_left_is_swept(fresh):
    """A living process's unfinished files stay; one whose process id was given again goes."""
    folder = fresh("sweep")
    living = folder / owned_name("stage-long")
    living.mkdir()
    host, process_id, start, token = living.name.rsplit(".", 1)[1].split("-")
    again = folder / f".stage-old.{host}-{process_id}-{int(start) - 100}-{token}"
    again.mkdir()
    (again / "half.vtu").write_text("half")
    sleeper = subprocess.Popen([sys.executable, "-c", "from limber.owner import owned_name\n"
                                "print(owned_name('x.json'), flush=True)\nimport time\n"
                                "time.sleep(60)"], stdout=subprocess.PIPE, text=True)
    theirs = folder / sleeper.stdout.readline().strip()
    theirs.write_text("half")
    try:
        with Branch.open(folder).stage("b"):
            pass
        assert living.exists() and theirs.exists() and not again.exists()
    finally:
        sleeper.kill()
        sleeper.wait()
        sleeper.stdout.close()
    with Branch.open(folder).stage("b"):
        pass
    assert living.exists() and not theirs.exists()


def test_files_of_another_machine_stay_for_a_week(fresh):
    """Whether a process of another machine lives cannot be seen: its age decides."""
    folder = fresh("far")
    new, old = (folder / f".x.json.abcdef-1-1-0000000{n}" for n in range(2))
    for path in (new, old):
        path.write_text("half")
    os.utime(old, (0, 0))
    with Branch.open(folder).stage("b"):
        pass
    assert new.exists() and not old.exists()
