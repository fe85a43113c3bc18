"""What holds for every way of running a job: pool, stage as a process, and the add-on's job.

All relay progress, return the result, cancel, survive a crash, a hang and rubbish, and leave no
process when their own is killed.
"""

import importlib
import os
import subprocess
import sys
import threading
import time
import types
from pathlib import Path

import psutil
import pytest
from tests.subjects import behaviours
from tests.subjects.processes import left_alive

from limber.core.errors import Cancelled, LimberError
from limber.core.processes import Limits, Pool, child
from limber.core.processes import pool as pool_module
from limber.core.progress import Progress

ROOT = Path(__file__).parents[3]
PROGRAM = Path(behaviours.__file__)


class Outcome:
    """How a job ended: its result, or an error; what it reported; which processes it had."""

    def __init__(self):
        self.result: dict = {}
        self.error = ""
        self.is_cancelled = False
        self.reports: list[tuple[float, str]] = []
        self.processes: list[psutil.Process] = []

    def fail(self, error: BaseException) -> None:
        self.error = str(error)
        self.is_cancelled = isinstance(error, Cancelled)


class InPool:
    """A task of the pool."""

    name = "pool"

    def __init__(self, monkeypatch):
        monkeypatch.setattr(pool_module, "_GRACE_SECONDS", 0.3)

    def run(self, behaviour: str, cancel_at: str = "", limits: Limits | None = None,
            outcome: Outcome | None = None) -> Outcome:
        outcome = outcome or Outcome()
        with Pool(1) as pool:
            def hear(fraction: float, message: str, _numbers: dict) -> None:
                outcome.reports.append((fraction, message))
                if cancel_at and message == cancel_at:
                    threading.Thread(target=pool.cancel).start()
            future = pool.submit(getattr(behaviours, behaviour), progress=Progress(hear),
                                 limits=limits or Limits())
            while not future.done():
                known = {process.pid for process in outcome.processes}
                outcome.processes += [psutil.Process(worker.process_id)
                                      for worker in tuple(pool._workers)
                                      if worker.process_id not in known]
                time.sleep(0.02)
            try:
                outcome.result = future.result()
            except LimberError as error:
                outcome.fail(error)
        return outcome


def runs(child: psutil.Process, behaviour: str) -> bool:
    """Whether it is the program; one that ends meanwhile has no command line any more."""
    try:
        return behaviour in child.cmdline()
    except psutil.Error:
        return False


class AsProcess:
    """A program that reports as a stage does."""

    name = "process"

    def __init__(self, monkeypatch):
        monkeypatch.setattr(child, "_GRACE_SECONDS", 0.3)

    def run(self, behaviour: str, cancel_at: str = "", limits: Limits | None = None,
            outcome: Outcome | None = None) -> Outcome:
        outcome = outcome or Outcome()

        def hear(fraction: float, message: str, _numbers: dict) -> None:
            outcome.reports.append((fraction, message))
            outcome.processes = [p for p in psutil.Process().children() if runs(p, behaviour)]
            if cancel_at and message == cancel_at:
                # A hang does not report any more: the cancel has to come from elsewhere.
                threading.Timer(0.2, progress.cancel).start()
        progress = Progress(hear)
        try:
            outcome.result = child.run_json_process(
                "stage", [sys.executable, "-u", str(PROGRAM), behaviour], progress,
                limits=limits or Limits())
        except LimberError as error:
            outcome.fail(error)
        return outcome


class InAddon:
    """The add-on's job; it has no limits."""

    name = "add-on"

    def __init__(self, monkeypatch):
        package = types.ModuleType("limber_addon_without_bpy")
        package.__path__ = [str(ROOT / "addon")]
        monkeypatch.setitem(sys.modules, package.__name__, package)
        self.jobs = importlib.import_module(f"{package.__name__}.jobs.jobs")
        monkeypatch.setattr(self.jobs, "_GRACE_SECONDS", 0.3)
        # The worker's own Python finds itself; that of the tests finds this tree.
        started = importlib.import_module(f"{package.__name__}.jobs.worker_process")
        monkeypatch.setattr(started, "worker_environment", lambda: dict(os.environ))

    def run(self, behaviour: str, cancel_at: str = "", limits: Limits | None = None,
            outcome: Outcome | None = None) -> Outcome:
        assert limits is None
        outcome = outcome or Outcome()
        job = self.jobs.Job("test", [sys.executable, "-u", str(PROGRAM), behaviour])
        job.launch()
        outcome.processes = [psutil.Process(job.pid)]
        while job.poll() is self.jobs.JobState.RUNNING:
            if (job.fraction, job.message) not in outcome.reports and job.message != "starting":
                outcome.reports.append((job.fraction, job.message))
            if cancel_at and job.message == cancel_at:
                job.cancel()
            time.sleep(0.02)
        if job.state is self.jobs.JobState.DONE:
            outcome.result = job.result
        outcome.error = job.error
        outcome.is_cancelled = job.state is self.jobs.JobState.CANCELLED
        return outcome


RUNNERS = (InPool, AsProcess, InAddon)


@pytest.fixture(params=RUNNERS, ids=lambda runner: runner.name)
def runner(request, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT / "worker"), str(ROOT)]))
    return request.param(monkeypatch)


def assert_ended(outcome: Outcome) -> None:
    """None of the job's processes is left."""
    assert outcome.processes
    assert not left_alive(outcome.processes, 5)


@pytest.mark.slow
def test_progress_is_relayed_and_the_result_returned(runner):
    """Fractions come in order, with their message; the result is the job's own."""
    outcome = runner.run("steps")
    fractions = [fraction for fraction, _ in outcome.reports]
    assert fractions == sorted(fractions) and len(fractions) >= 3 and max(fractions) == 1.0
    assert ("going" in {message for _, message in outcome.reports}) and not outcome.error
    assert outcome.result["n"] == 3
    assert_ended(outcome)


def test_rubbish_on_standard_output_does_no_harm(runner):
    """Bytes that are no text, deep or endless JSON, fractions that are none: all passed over."""
    outcome = runner.run("rubbish")
    assert outcome.result["n"] == 3 and not outcome.error
    assert all(0.0 <= fraction <= 1.0 for fraction, _ in outcome.reports)


def test_an_error_keeps_its_words(runner):
    outcome = runner.run("fails")
    assert "The wood is too wet." in outcome.error
    assert not outcome.result and not outcome.is_cancelled
    assert_ended(outcome)


@pytest.mark.slow
def test_a_crash_is_an_error_and_not_the_end(runner):
    """It is told as one, with the exit code; the next job runs."""
    outcome = runner.run("crash")
    assert "exit code" in outcome.error and not outcome.is_cancelled
    assert runner.run("steps").result["n"] == 3


def test_cancel_ends_a_job_that_reports(runner):
    outcome = runner.run("patient", cancel_at="on")
    assert outcome.is_cancelled and not outcome.result
    assert_ended(outcome)


@pytest.mark.slow
def test_cancel_ends_a_job_that_hangs(runner):
    """It ignores being asked: after the grace it is killed."""
    outcome = runner.run("hang", cancel_at="about to hang")
    assert outcome.is_cancelled and not outcome.result
    assert_ended(outcome)


@pytest.mark.slow
@pytest.mark.parametrize(("behaviour", "limits", "said"), [
    ("hang", Limits(seconds=4.0), "was stopped after 4 s"),
    ("greedy", Limits(memory_mb=300.0), "Its limit is 300 MB")])
def test_limits_end_a_job(runner, behaviour: str, limits: Limits, said: str):
    if isinstance(runner, InAddon):
        pytest.skip("a user watches the add-on's job and cancels it")
    outcome = runner.run(behaviour, limits=limits)
    assert said in outcome.error and not outcome.is_cancelled
    assert_ended(outcome)


# A program that starts a job, says when the job has reported, and waits to be killed.
_PARENT = """
import sys, threading, time
import pytest
from tests.core.processes.test_conformance import RUNNERS, Outcome
if __name__ == "__main__":
    import os
    os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)
    runner = RUNNERS[int(sys.argv[1])](pytest.MonkeyPatch())
    outcome = Outcome()
    threading.Thread(target=runner.run, args=(sys.argv[2],), kwargs={"outcome": outcome},
                     daemon=True).start()
    while not outcome.reports:
        time.sleep(0.02)
    print("reported", flush=True)
    time.sleep(60)
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
@pytest.mark.parametrize("behaviour", ["patient", "hang"])
def test_a_killed_parent_leaves_nothing(runner, behaviour: str, tmp_path):
    """SIGKILL to the program that started the job: all that it started ends within seconds."""
    program = tmp_path / "parent.py"
    program.write_text(_PARENT)
    parent = subprocess.Popen([sys.executable, str(program), str(RUNNERS.index(type(runner))),
                               behaviour], stdout=subprocess.PIPE, text=True, env=os.environ)
    # The pool has a process of Python's own beside its worker; both are up when the job is.
    assert parent.stdout.readline() == "reported\n"
    started = psutil.Process(parent.pid).children(recursive=True)
    assert started and parent.poll() is None
    parent.kill()
    parent.wait()
    parent.stdout.close()
    assert not left_alive(started, 8)
