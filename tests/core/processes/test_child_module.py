"""Compiled code in a process of its own: its end, its last words, its limits."""

import contextlib
import os

import psutil
import pytest
from tests.subjects.processes import left_alive

from limber.core.errors import WorkError
from limber.core.processes.child import run_module
from limber.core.processes.process_limits import Limits

CHILD = """
import subprocess, sys, time
how, parent = sys.argv[1:]
print("first", parent, sep="\\n", file=sys.stderr, flush=True)
if how == "hang":
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    time.sleep(60)
if how == "busy":
    while True:
        pass
if how == "slow":
    time.sleep(1.0)
if how == "greedy":
    kept = b"x" * 300_000_000
    time.sleep(60)
sys.exit(3)
"""


def _started_from(folder):
    """The processes that have this folder in their PYTHONPATH: the child and its own."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            if process.pid != os.getpid() and str(folder) in process.environ().get(
                    "PYTHONPATH", ""):
                found.append(process)
    return found


@pytest.fixture()
def folder(tmp_path, monkeypatch):
    (tmp_path / "limber_child.py").write_text(CHILD)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def test_its_code_and_last_line_come_back(folder):
    """It knows its parent, which it ends with."""
    assert run_module("limber_child", ["fail"], "it", Limits(seconds=60)) == (3, str(os.getpid()))


@pytest.mark.parametrize(("how", "limits", "said"), [
    ("hang", Limits(seconds=0.6), "it was stopped after 1 s"),
    ("busy", Limits(computed_seconds=0.4), "s of processor time"),
    ("hang", Limits(computed_seconds=60, idle_seconds=0.4), "it did nothing for"),
    ("greedy", Limits(seconds=60, memory_mb=200.0), "Its limit is 200 MB")])
def test_over_its_limits_it_and_its_children_are_killed(folder, how, limits, said):
    with pytest.raises(WorkError) as caught:
        run_module("limber_child", [how], "it", limits, folder=folder)
    assert said in str(caught.value)
    assert not left_alive(_started_from(folder), 5.0)


def test_time_that_others_take_is_not_its_own(folder):
    """A machine that is busy makes it late, but does not use up its processor time."""
    assert run_module("limber_child", ["slow"], "it", Limits(computed_seconds=0.9))[0] == 3


def test_who_waits_may_end_it(folder):
    """As a cancel does."""
    seen = []

    def waiting(seconds):
        seen.extend(_started_from(folder))
        if seconds > 0.2:
            raise KeyboardInterrupt
    with pytest.raises(KeyboardInterrupt):
        run_module("limber_child", ["greedy"], "it", Limits(), waiting=waiting)
    assert seen
    assert not left_alive(_started_from(folder), 5.0)
