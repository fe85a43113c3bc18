"""A disk that is full, or a network folder that is lost, at any step of a stage."""

import builtins
import errno
import io
import os
import re
import shutil
import weakref
from pathlib import Path

import pytest

from limber.core.errors import BranchFolderError, InputError, LimberError, WorkError
from limber.core.machine_errors import machine_error
from limber.store import Branch

_WRITING = ("mkdir", "fsync", "open")
_ALL = (*_WRITING, "stat", "replace", "rename", "unlink", "rmdir", "scandir", "listdir")


class Disk:
    """Fails from its n-th call on below ``folder``, with what the system would say."""

    def __init__(self, monkeypatch, folder: Path, code: int, names: tuple[str, ...]):
        self.folder, self.code, self.calls, self.deadly = str(folder), code, 0, 1 << 30
        for name in names:
            monkeypatch.setattr(os, name, self.failing(getattr(os, name)))
        for module in (builtins, io):
            monkeypatch.setattr(module, "open", self.failing(io.open, is_file=True))

    def failing(self, function, *, is_file=False):
        def call(*given, **named):
            mode = named.get("mode", given[1] if len(given) > 1 else "r") if is_file else "w"
            about = given[0] if given else "."
            ours = isinstance(about, int) or str(about).startswith(self.folder)
            if ours and (self.code != errno.ENOSPC or set(str(mode)) & set("wxa+")):
                self.calls += 1
                if self.calls >= self.deadly:
                    raise OSError(self.code, os.strerror(self.code),
                                  None if isinstance(about, int) else str(about))
            return function(*given, **named)
        return call


def write(branch: Branch, number: int) -> None:
    with branch.stage("a", {"n": number}) as stage:
        stage.path("x.txt").write_text(str(number))
        stage.path("deep/y.txt").write_text(str(number))


@pytest.mark.slow
@pytest.mark.parametrize(("code", "names"), [(errno.ENOSPC, _WRITING), (errno.ESTALE, _ALL)])
def test_at_every_step_the_folder_is_left_before_or_after(tmp_path, monkeypatch, code, names):
    """The error is in words, the folder whole, the right to write free again."""
    states, deadly = [], 1
    monkeypatch.setattr(os, "fsync", lambda _handle: None)  # no power cut here: it takes time
    write(Branch.create(tmp_path / "before"), 1)
    while True:
        folder = Path(shutil.copytree(tmp_path / "before", tmp_path / f"{deadly}.branch"))
        with monkeypatch.context() as patch:
            disk = Disk(patch, folder, code, names)
            try:
                branch = Branch.open(folder)
                disk.calls, disk.deadly = 0, deadly
                write(branch, 2)
                break
            except LimberError as error:
                assert isinstance(error, WorkError | BranchFolderError)
                assert os.strerror(code) in str(error), error
        branch = Branch.open(folder, verify=True)
        states.append(branch.manifest.stages["a"].settings["n"])
        assert branch.path("x.txt").read_text() == str(states[-1])
        assert branch.path("deep/y.txt").read_text() == str(states[-1])
        write(branch, 3)
        Branch.open(folder, verify=True)
        deadly += 1
    assert states == sorted(states) and set(states) == {1, 2}
    assert len(states) >= 8, "so many steps can fail"


def test_a_folder_that_goes_while_a_stage_runs(tmp_path):
    """It is not made anew where it was, and what was in it comes back with it."""
    folder, away = tmp_path / "a.branch", tmp_path / "away"
    write(Branch.create(folder), 1)
    branch = Branch.open(folder)
    with pytest.raises(WorkError, match="no longer exists"), branch.stage("b") as stage:
        folder.rename(away)
        stage.path("b.txt")
    with pytest.raises(WorkError, match="no longer exists"), branch.stage("b"):
        raise AssertionError
    with pytest.raises(BranchFolderError, match="no folder"):
        Branch.open(folder)
    assert not folder.exists()
    away.rename(folder)
    write(Branch.open(folder, verify=True), 2)
    # Gone after its last file was written, before it counts.
    branch = Branch.open(folder)
    with pytest.raises(WorkError, match="no longer exists"), branch.stage("a", {"n": 3}) as stage:
        stage.path("x.txt").write_text("3")
        folder.rename(away)
    assert not folder.exists()
    away.rename(folder)
    assert Branch.open(folder, verify=True).manifest.stages["a"].settings == {"n": 2}


@pytest.mark.slow
def test_what_a_failed_writer_has_open_is_closed(tmp_path):
    """Removed but open, it would keep its room: the next stage would find the disk as full."""
    branch, held = Branch.create(tmp_path / "a.branch"), []

    def write(path: Path) -> None:
        stream = open(path, "wb")  # as native writers leave it
        held.append(weakref.ref(stream))
        cycle = [stream]
        cycle.append(cycle)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
    with pytest.raises(WorkError, match="full") as caught, branch.stage("a") as stage:
        write(stage.path("x.bin"))
    assert caught.value.__cause__ is not None and held[0]() is None


@pytest.mark.slow
def test_a_native_writer_on_a_full_disk(tmp_path):
    """It says in its own words what happened; others of its errors stay what they are."""
    branch = Branch.create(tmp_path / "a.branch")
    for said in ("8 requested and 0 written", "Not enough free space to write 8 bytes"):
        with pytest.raises(WorkError, match=r"full.*Free some space"), branch.stage("a"):
            raise OSError(said)
    with pytest.raises(OSError, match="no such dataset"), branch.stage("a"):
        raise OSError("no such dataset")


def test_what_is_the_machines_and_what_is_not():
    full = machine_error(OSError(errno.ENOSPC, "No space left on device", "/a/b"))
    assert isinstance(full, WorkError) and "/a/b cannot be written" in str(full)
    assert isinstance(machine_error(PermissionError(errno.EROFS, "Read-only", "/a")), InputError)
    assert "memory" in str(machine_error(MemoryError()))
    lost = machine_error(ModuleNotFoundError("No module named 'numpy.exceptions'",
                                             name="numpy.exceptions"))
    assert re.match(r"numpy\.exceptions does not load .*do not fit.*install the extension's zip",
                    str(lost))
    assert machine_error(FileNotFoundError(errno.ENOENT, "No such file", "/a")) is None
    # Without a file it may be a robot's connection.
    assert machine_error(TimeoutError(errno.ETIMEDOUT, "timed out")) is None
    assert machine_error(ValueError("x")) is None
