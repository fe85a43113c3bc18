"""The worker as a process: progress, results, failures, and a cancel that leaves nothing alive."""

import importlib
import importlib.machinery
import importlib.util
import os
import subprocess
import sys
import textwrap
import time

import pytest
from tests.addon.conftest import part


@pytest.fixture()
def jobs(addon):
    module = part("jobs.jobs")
    yield module
    module.forget()


def _worker(tmp_path, body):
    script = tmp_path / "worker.py"
    script.write_text("import json, os, signal, subprocess, sys, time\n"
                      "def say(**x): print(json.dumps(x), flush=True)\n" + textwrap.dedent(body))
    return [sys.executable, str(script)]


def _poll_until(job, condition, seconds=15.0):
    end = time.monotonic() + seconds
    while not condition():
        job.poll()
        assert time.monotonic() < end, f"{job.state} {job.message} {list(job.log)}"
        time.sleep(0.02)


def _alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    with open(f"/proc/{pid}/stat") as stat:
        return stat.read().split(")")[1].split()[0] != "Z"


def test_progress_and_result(jobs, tmp_path):
    """Progress lines arrive while it runs, lines of native libraries are passed over."""
    job = jobs.start("Trying", _worker(tmp_path, """
        say(progress=0.5, message="half")
        print("Blender 4.3.2", flush=True)
        time.sleep(0.3)
        say(status="done", answer=42)
        print("Blender quit", flush=True)
        """))
    _poll_until(job, lambda: job.fraction == 0.5)
    assert job.message == "half"
    assert jobs.is_running()
    with pytest.raises(RuntimeError, match="still running"):
        jobs.start("Second", [sys.executable, "-c", ""])
    assert job.wait() is jobs.JobState.DONE
    assert job.result["answer"] == 42
    assert not jobs.is_running()


def test_failure_says_why(jobs, tmp_path):
    """The worker's own error is kept; without one, the end of its standard error is."""
    job = jobs.start("Trying", _worker(tmp_path, """
        say(status="failed", error="The cloud is empty.")
        sys.exit(2)
        """))
    assert job.wait() is jobs.JobState.FAILED
    assert job.error == "The cloud is empty."
    job = jobs.start("Trying", _worker(tmp_path, "raise ValueError('of a bug')"))
    assert job.wait() is jobs.JobState.FAILED
    assert "exit code 1" in job.error
    assert "ValueError: of a bug" in job.error


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_cancel_is_asked_first(jobs, tmp_path):
    """A cancel is SIGTERM, so that the worker can clean up; the state is then cancelled."""
    job = jobs.start("Trying", _worker(tmp_path, """
        def stop(*_):
            say(status="cancelled", cleaned=True)
            sys.exit(130)
        signal.signal(signal.SIGTERM, stop)
        say(progress=0.1)
        time.sleep(60)
        """))
    _poll_until(job, lambda: job.fraction == 0.1)
    job.cancel()
    assert job.wait() is jobs.JobState.CANCELLED
    assert job.result["cleaned"] is True


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc"), reason="reads /proc")
def test_stubborn_worker_is_killed_with_its_children(jobs, tmp_path, monkeypatch):
    """A worker that ignores SIGTERM is killed after a while, and what it started as well."""
    monkeypatch.setattr(jobs, "_GRACE_SECONDS", 0.3)
    job = jobs.start("Trying", _worker(tmp_path, """
        ignore = "import signal, time; signal.signal(15, signal.SIG_IGN); time.sleep(60)"
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        child = subprocess.Popen([sys.executable, "-c", ignore])
        time.sleep(0.3)
        say(progress=0.5, message=str(child.pid))
        time.sleep(60)
        """))
    _poll_until(job, lambda: job.fraction == 0.5)
    child = int(job.message)
    job.cancel()
    assert job.wait() is jobs.JobState.CANCELLED
    end = time.monotonic() + 5
    while _alive(child) and time.monotonic() < end:
        time.sleep(0.02)
    assert not _alive(child)


@pytest.mark.slow
def test_jobs_wait_for_their_turn(jobs, tmp_path):
    """One after the other, in order; one that is taken out is not run."""
    log = tmp_path / "log.txt"
    command = {name: _worker(tmp_path, f"""
        open({str(log)!r}, "a").write(sys.argv[1])
        time.sleep(0.1)
        """) + [name] for name in "abcd"}
    queue = [jobs.add(name, command[name], "folder") for name in "abc"]
    assert [job.state.value for job in queue] == ["running", "waiting", "waiting"]
    first = jobs.add("d", command["d"], is_next=True)
    assert jobs.waiting() == [first, queue[1], queue[2]]
    assert jobs.works_in("folder") and not jobs.works_in("another")
    queue[1].cancel()
    for job in (queue[0], first, queue[2]):
        assert job.wait() is jobs.JobState.DONE, job.error
    assert log.read_text() == "adc"
    assert queue[1].state is jobs.JobState.CANCELLED and not jobs.waiting()


def test_what_follows_a_failure_is_not_run(jobs, tmp_path):
    """A plan has nothing to go on from where the energy failed; another branch's goes on."""
    failing = jobs.add("Sample", _worker(tmp_path, "sys.exit(3)"), "a.branch")
    plan = jobs.add("Plan", [sys.executable, "-c", ""], "a.branch")
    other = jobs.add("Report", [sys.executable, "-c", ""], "b.branch")
    assert failing.wait() is jobs.JobState.FAILED
    assert plan.poll() is jobs.JobState.CANCELLED and "Sample" in plan.message
    assert other.wait() is jobs.JobState.DONE


@pytest.mark.slow
def test_a_worker_that_hangs_is_told_from_one_that_works(jobs, tmp_path, monkeypatch):
    """Signs of life with work, without work, and none; what remains by what was done."""
    monkeypatch.setattr(jobs, "_SILENT_SECONDS", 0.7)
    monkeypatch.setattr(jobs, "_IDLE_SECONDS", 0.3)
    monkeypatch.setattr(jobs, "_KNOWN_SECONDS", 0.0)
    job = jobs.start("Trying", _worker(tmp_path, """
        say(progress=0.25, best_m2=1e-6)
        for number in range(8):
            time.sleep(0.05)
            say(alive=number, cpu_s=10.0 * number)
        for number in range(8):
            time.sleep(0.06)
            say(alive=number, cpu_s=70.001)
        time.sleep(60)
        """))
    _poll_until(job, lambda: job._cpu_seconds > 60)
    assert job.life() == (jobs.Life.WORKING, 0.0)
    assert job.remaining() == pytest.approx(3 * job.elapsed(), rel=0.05)
    assert job.numbers["best_m2"] == 1e-6
    _poll_until(job, lambda: job.life()[0] is jobs.Life.IDLE)
    _poll_until(job, lambda: job.life()[0] is jobs.Life.SILENT)
    assert job.life()[1] > 0.7


def test_forget_ends_the_worker(jobs, tmp_path):
    """When the add-on goes away its worker goes too."""
    job = jobs.start("Trying", _worker(tmp_path, "say(progress=0.1)\ntime.sleep(60)"))
    _poll_until(job, lambda: job.fraction == 0.1)
    jobs.forget()
    assert job._process.poll() is not None
    assert jobs.current() is None


def test_finding_the_worker(addon, tmp_path, monkeypatch):
    """Preferences, LIMBER_PYTHON, this Python, the PATH, in this order; else a helpful error."""
    worker = part("jobs.worker")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("LIMBER_PYTHON", raising=False)
    with pytest.raises(worker.WorkerNotFound, match="preferences"):
        worker.worker_command()
    program = tmp_path / ("limber" if os.name == "posix" else "limber.exe")
    program.write_text("")
    program.chmod(0o755)
    assert worker.worker_command() == [str(program)]
    assert worker.worker_command(bundled=["here"]) == ["here"]
    monkeypatch.setenv("LIMBER_PYTHON", sys.executable)
    assert worker.worker_command() == [sys.executable, "-m", "limber"]
    other = tmp_path / "python"
    other.write_text("")
    assert worker.worker_command(str(other)) == [str(other), "-m", "limber"]
    with pytest.raises(worker.WorkerNotFound, match="does not exist"):
        worker.worker_command(str(tmp_path / "gone"))


def test_worker_environment_is_not_blenders(addon, monkeypatch):
    """Blender's PYTHONHOME and PYTHONPATH do not reach the worker's Python."""
    worker = part("jobs.worker")
    monkeypatch.setenv("PYTHONHOME", "/blender")
    monkeypatch.setenv("PYTHONPATH", "/blender")
    environment = worker.worker_environment()
    assert not {"PYTHONHOME", "PYTHONPATH"} & set(environment)
    assert environment["PYTHONUNBUFFERED"] == "1"


def test_the_worker_of_the_extensions_own_wheels(addon, tmp_path, monkeypatch):
    """It runs in this Python, and so does all that it starts; a Python that was chosen wins."""
    worker = part("jobs.worker")
    monkeypatch.delenv("LIMBER_PYTHON", raising=False)
    package = tmp_path / "limber"
    (package / "cli").mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "cli" / "main.py").write_text(
        "import os, sys\n\n\ndef run():\n    print(sys.argv[1:], os.environ['PYTHONPATH'])\n")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: importlib.machinery.ModuleSpec(
        name, None, origin=str(package / "__init__.py")))
    command = worker.worker_command(bundled=worker.bundled_command())
    done = subprocess.run([*command, "doctor", "--json"], check=True, capture_output=True,
                          text=True)
    assert done.stdout == f"['doctor', '--json'] {tmp_path}\n"
    monkeypatch.setenv("LIMBER_PYTHON", sys.executable)
    assert worker.worker_command(bundled=command) == [sys.executable, "-m", "limber"]
