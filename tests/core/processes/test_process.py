"""A stage as a process: result, progress, errors by exit code, crash, cancel."""

import subprocess
import sys
import threading
import time

import psutil
import pytest

from limber.core.errors import BranchFolderError, Cancelled, InputError, SafetyStop, WorkError
from limber.core.processes import child
from limber.core.progress import Progress


@pytest.fixture
def stand_in(monkeypatch, tmp_path):
    """Let run_stage start a small program of the test instead of ``python -m limber``."""
    def use(body: str) -> None:
        path = tmp_path / "stage.py"
        path.write_text("import json, os, sys, time\n" + body)
        real = subprocess.Popen
        monkeypatch.setattr(
            subprocess, "Popen",
            lambda command, **options: real([sys.executable, "-u", str(path)], **options))
    return use


@pytest.mark.slow
def test_real_command_returns_its_result():
    """`limber doctor` run as a process gives its JSON result."""
    result = child.run_stage(["doctor"])
    assert result["status"] == "done"
    assert result["packages"]["numpy"].startswith(("1.", "2."))


def test_progress_is_relayed_and_noise_is_skipped(stand_in):
    """Progress lines reach the parent's progress; other lines of native libraries do not harm."""
    stand_in("print('fTetWild says hello'); print('[1, 2]'); print('{broken')\n"
             "print(json.dumps({'progress': 0.5, 'message': 'half', 'seconds': 1, 'loss': 2.0}))\n"
             "print(json.dumps({'command': 'x', 'status': 'done', 'error': None, 'n': 3}))\n")
    seen = []
    sink = Progress(lambda fraction, message, numbers: seen.append((fraction, message, numbers)))
    result = child.run_stage(["x"], sink.part(0.0, 0.5))
    assert seen == [(0.25, "half", {"loss": 2.0})]
    assert result["n"] == 3


@pytest.mark.parametrize(("code", "kind"), [(2, InputError), (3, WorkError), (4, SafetyStop),
                                            (130, Cancelled)])
def test_errors_keep_their_kind(stand_in, code, kind):
    """The child's exit code and message become the same kind of error here."""
    stand_in("print(json.dumps({'command': 'x', 'status': 'failed', 'error': 'too wet'}))\n"
             f"sys.exit({code})\n")
    with pytest.raises(kind, match="too wet"):
        child.run_stage(["x"])


def test_a_crash_shows_the_last_words(stand_in):
    """A child that dies without a result is an error that shows its last words and a way on."""
    stand_in("print('segfault in mesher', file=sys.stderr); os._exit(139)\n")
    with pytest.raises(WorkError, match=r"139.*segfault in mesher.*limber mesh a\.stl"):
        child.run_stage(["mesh", "a.stl"])


def test_cancel_ends_the_child(stand_in):
    """A cancelled progress ends the child process, at its next line, and raises."""
    stand_in("while True:\n"
             "    print(json.dumps({'progress': 0.1, 'message': 'on'})); time.sleep(0.05)\n")
    progress = Progress()
    timer = threading.Timer(0.3, progress.cancel)
    timer.start()
    with pytest.raises(Cancelled):
        child.run_stage(["x"], progress)
    time.sleep(0.1)
    commands = [p.as_dict(["cmdline"])["cmdline"] or [] for p in psutil.Process().children()]
    assert not [words for words in commands if "stage.py" in " ".join(words)]


@pytest.mark.slow
def test_missing_branch_folder_is_an_input_error(tmp_path):
    """Through the real command line: exit code 2 with what to do becomes InputError."""
    with pytest.raises(InputError, match="limber reconstruct") as error:
        child.run_stage(["verify", "--", str(tmp_path / "none.branch")])
    assert not isinstance(error.value, BranchFolderError)
