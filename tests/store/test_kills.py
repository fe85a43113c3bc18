"""A program that is killed, at whatever step, leaves a branch folder before or after its stage."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from limber.core.files.atomic import is_owned_name, owned_name
from limber.store import Branch

# Every change of a name on the disk is counted; the process dies before the one asked for.
_DYING = """
import os, shutil
from limber.store import Branch
os.fsync = lambda handle: None
count = 0
def counted(function, deadly):
    def call(*arguments, **options):
        global count
        count += 1
        if count == deadly:
            os._exit(9)
        return function(*arguments, **options)
    return call
def watch(deadly):
    for name in ("replace", "rename", "unlink", "rmdir", "mkdir"):
        setattr(os, name, counted(getattr(os, name), deadly))
    shutil.rmtree = counted(shutil.rmtree, deadly)
def write(folder, deadly):
    branch = Branch.open(folder)
    watch(deadly)
    with branch.stage("a", {"n": 2}) as stage:
        stage.path("x.txt").write_text("new")
        stage.path("deep/y.txt").write_text("new")
        stage.remove("old.txt")
def create(folder, deadly):
    watch(deadly)
    Branch.create(folder)
"""
# Loads what they need once, and is each of them in a process of its own.
_FORKING = _DYING + """
import json, sys
for line in sys.stdin:
    name, folder, deadly = json.loads(line)
    child = os.fork()
    if not child:
        globals()[name](folder, deadly)
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


@pytest.fixture(scope="module")
def die():
    """A function that does ``write`` or ``create`` in a process that dies at a step; False if it
    has fewer steps.
    """
    if not hasattr(os, "fork"):
        def start(name: str, folder: Path, deadly: int) -> bool:
            program = f"{_DYING}\n{name}({str(folder)!r}, {deadly})"
            done = subprocess.run([sys.executable, "-c", program], check=False)
            return _has_died(done.returncode)
        yield start
        return
    with subprocess.Popen([sys.executable, "-c", _FORKING], stdin=subprocess.PIPE,
                          stdout=subprocess.PIPE, text=True) as server:
        def fork(name: str, folder: Path, deadly: int) -> bool:
            server.stdin.write(json.dumps([name, str(folder), deadly]) + "\n")
            server.stdin.flush()
            return _has_died(int(server.stdout.readline()))
        yield fork


def _has_died(code: int) -> bool:
    assert code in (0, 9)
    return code == 9


@pytest.fixture(autouse=True)
def without_waiting_for_the_disk(monkeypatch):
    """A process is killed here, no power is cut: what was written need not reach the disk."""
    monkeypatch.setattr(os, "fsync", lambda _handle: None)


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
def test_a_kill_at_every_step_of_a_stage_leaves_the_folder_before_or_after(fresh, die):
    """At each change of a name: opened again all files are of one run; no litter after the next."""
    found = []
    deadly = 1
    while die("write", folder := fresh(str(deadly)), deadly):
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


def test_a_kill_at_every_step_of_create_leaves_a_folder_that_opens(tmp_path: Path, die):
    """New or empty before: what is there afterwards can be made a branch folder again, or is one.
    """
    for made_before in (False, True):
        deadly = 1
        while True:
            folder = tmp_path / f"{made_before}-{deadly}.branch"
            if made_before:
                folder.mkdir()
            if not die("create", folder, deadly):
                break
            Branch.create(folder)
            Branch.open(folder, verify=True)
            assert litter(folder) == []
            assert not [p for p in tmp_path.iterdir() if p.name.startswith(f".{folder.name}")]
            deadly += 1
        assert deadly > 1


@pytest.mark.slow
def test_a_commit_that_another_program_left_half_done_comes_first(fresh, die):
    """An opener from before the kill, who never looked at the journal, still loses nothing."""
    folder = fresh("left")
    early = Branch.open(folder)
    deadly = 1
    while die("write", folder, deadly) and not (folder / ".commit").exists():
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
    sleeper = subprocess.Popen([sys.executable, "-c", "from limber.core.files.atomic "
                                "import owned_name\n"
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
