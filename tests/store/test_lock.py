"""Who may write to a branch folder."""

import errno
import os
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from limber.core.errors import BranchFolderError
from limber.store import Branch

_HOLDER = """
import sys, time
from limber.store import Branch
with Branch.open(sys.argv[1]).writing("limber energy"):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def branch(tmp_path: Path) -> Branch:
    branch = Branch.create(tmp_path / "apple.branch")
    with branch.stage("first") as stage:
        stage.path("data.txt").write_text("one")
    return branch


@pytest.fixture
def holder(branch: Branch):
    """A program that is writing to the branch folder."""
    process = subprocess.Popen([sys.executable, "-c", _HOLDER, str(branch.folder)],
                               stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_second_writer_is_told_who_writes_and_readers_go_on(branch: Branch, holder):
    """The message names purpose, process, machine and time; nothing is computed or changed."""
    with pytest.raises(BranchFolderError, match=(
            rf"limber energy, process {holder.pid} of .* on .*, since 20..-.* UTC")), \
            branch.stage("second"):
        pytest.fail("the stage began")
    assert Branch.open(branch.folder, verify=True).path("data.txt").read_text() == "one"


def test_an_empty_branch_that_another_begins_is_not_removed(tmp_path: Path):
    """Its own beginning failed because another program is writing there."""
    new = Branch.create(tmp_path / "new.branch")
    with subprocess.Popen([sys.executable, "-c", _HOLDER, str(new.folder)],
                          stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        with pytest.raises(BranchFolderError, match="Another Limber"), new.dropped_if_empty(), \
                new.stage("made"):
            pytest.fail("the stage began")
        process.kill()
    assert Branch.open(new.folder).name == "new"


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
def test_a_killed_writers_lock_is_taken_over(branch: Branch, holder):
    """After kill -9 the next writer goes on at once; what it said of itself is gone."""
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    with branch.stage("second") as stage:
        stage.path("b.txt").write_text("b")
    assert set(Branch.open(branch.folder).manifest.stages) == {"first", "second"}
    assert not (branch.folder / ".run.json").exists()


def test_one_program_may_nest_its_writing(branch: Branch):
    """A stage inside `writing`, and a stage inside a stage; the right ends with the outermost."""
    with branch.writing("outer"):
        with branch.stage("second"):
            pass
        assert (branch.folder / ".run.json").exists()
    assert not (branch.folder / ".run.json").exists()


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root writes everywhere")
def test_a_read_only_folder_is_read(branch: Branch):
    """Reading takes no lock; writing says what is wrong."""
    branch.folder.chmod(0o555)
    try:
        assert Branch.open(branch.folder, verify=True).path("data.txt").read_text() == "one"
        with pytest.raises(BranchFolderError, match="cannot be written"), branch.stage("second"):
            pass
    finally:
        branch.folder.chmod(0o755)


@pytest.mark.skipif(os.name == "nt", reason="POSIX locks")
@pytest.mark.parametrize("code", [errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK])
def test_a_disk_without_locks_is_told_from_another_writer(branch: Branch, monkeypatch, code):
    """Some network disks have none: nobody else is writing, and the message does not say so."""
    import fcntl

    def none(*_args):
        raise OSError(code, os.strerror(code))
    # What a killed program left, where a file stands for the lock.
    (branch.folder / ".run.lock").write_text("1\nelsewhere\n")
    monkeypatch.setattr(fcntl, "flock", none)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(BranchFolderError, match="has no file locks") as told, \
                branch.stage("second"):
            pytest.fail("the stage began")
    assert "Another Limber" not in str(told.value) and ".run.lock may help" in str(told.value)
    Branch.read(branch.folder).verify()
