"""A worker that is killed, hangs, prints rubbish, is of another version or is missing: each is said
in words, and the next one works."""

import json
import os
import sys
import threading
import time
from types import SimpleNamespace

import pytest
from tests.addon.conftest import part

from limber.store import Branch

GOOD = "print(json.dumps({'status': 'done', 'seconds': 0.1}))"
BAD = {
    "killed": ("print(json.dumps({'progress': 0.5}), flush=True); os.kill(os.getpid(), 9)",
               "exit code -9. It was killed"),
    "rubbish": ("sys.stdout.buffer.write(bytes(range(256)) * 40 + b'\\n[[[[\\n{\\n'); "
                "print('null'); print('[1]'); print('{\"progress\": \"half\"}')",
                "ended without a result"),
    "rubbish, and an end": ("sys.stderr.write('\\x00' * 5000); sys.exit(7)", "exit code 7"),
    "another version": ("sys.exit('Error: No such option: --progress')",
                        "No such option: --progress If its version differs"),
    "deep": ("print('[' * 100000)", "ended without a result")}


@pytest.fixture()
def use(bpy, registered, tmp_path, monkeypatch):
    """A function that lets a program be the worker; the scene has a branch folder."""
    Branch.create(tmp_path / "a.branch")
    bpy.context.scene.limber.branch_folder = str(tmp_path / "a.branch")

    def use(body):
        script = tmp_path / "worker.py"
        script.write_text(f"import json, os, signal, sys, time\n{body}\n")
        monkeypatch.setattr(part("preferences"), "worker_command",
                            lambda: [sys.executable, str(script)])
    return use


@pytest.mark.parametrize("kind", BAD)
def test_what_is_wrong_is_said_and_the_next_one_works(bpy, use, kind):
    """As the operator's error, in the step's panel, and gone with the next run that ends well."""
    body, words = BAD[kind]
    steps, scene = part("panels.steps"), bpy.context.scene
    use(body)
    with pytest.raises(RuntimeError, match=words):
        bpy.ops.limber.report()
    assert steps.state_of(scene, "report")[0] is steps.StepState.FAILED
    assert words in part("jobs.jobs").current().error
    use(GOOD)
    assert bpy.ops.limber.report() == {"FINISHED"}
    assert steps.state_of(scene, "report")[0] is not steps.StepState.FAILED


def test_a_worker_that_is_missing(bpy, use, monkeypatch, tmp_path):
    """No such program: said, with where to name one; then one that is there."""
    monkeypatch.setattr(part("preferences"), "worker_command",
                        lambda: [str(tmp_path / "no" / "python")])
    with pytest.raises(RuntimeError, match="No such file"):
        bpy.ops.limber.report()
    use(GOOD)
    assert bpy.ops.limber.report() == {"FINISHED"}


@pytest.mark.slow
def test_a_worker_that_hangs(bpy, use, monkeypatch):
    """It says nothing and does not end when asked: that is told, and it is ended all the same."""
    from tests.addon.test_panels import _draw

    jobs, panel = part("jobs.jobs"), part("panels.job").LIMBER_PT_job
    monkeypatch.setattr(jobs, "_SILENT_SECONDS", 0.3)
    monkeypatch.setattr(jobs, "_GRACE_SECONDS", 0.3)
    job = jobs.start("Trying", [sys.executable, "-c", (
        "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN);"
        "print('{\"progress\": 0.1}', flush=True); time.sleep(60)")])
    end = time.monotonic() + 15
    while job.fraction == 0 and time.monotonic() < end:
        job.poll()
        time.sleep(0.02)
    time.sleep(0.4)
    job.poll()
    assert any("has not responded" in text for text in _draw(panel, bpy.context).names("label"))
    job.cancel()
    assert job.wait() is jobs.JobState.CANCELLED
    use(GOOD)
    assert bpy.ops.limber.report() == {"FINISHED"}


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc"), reason="reads /proc")
def test_nothing_of_a_job_stays_open(bpy, use):
    """Pipes and threads of twenty jobs are gone with them."""
    use(GOOD)
    bpy.ops.limber.report()
    before = len(os.listdir("/proc/self/fd")), threading.active_count()
    for _ in range(20):
        bpy.ops.limber.report()
    after = len(os.listdir("/proc/self/fd")), threading.active_count()
    assert after[0] <= before[0] + 1 and after[1] <= before[1] + 2


def test_panels_look_for_the_worker_now_and_then(bpy, registered, monkeypatch):
    """Not at every redraw: it may have to be sought in every folder of the PATH."""
    preferences, looked = part("preferences"), []
    monkeypatch.setattr(preferences, "worker_command", lambda: looked.append(1) or ["limber"])
    preferences._looked.clear()
    for _ in range(50):
        assert preferences.has_worker()
    assert len(looked) == 1


def test_a_running_job_redraws_the_sidebar_alone(bpy, registered, monkeypatch):
    """Not the view beside it, which may show a million points."""
    drawn = []

    def region(kind):
        return SimpleNamespace(type=kind, tag_redraw=lambda: drawn.append(kind))
    area = SimpleNamespace(type="VIEW_3D", regions=[region("WINDOW"), region("UI")],
                           tag_redraw=lambda: drawn.append("all of it"))
    window = SimpleNamespace(screen=SimpleNamespace(areas=[area]))
    operator = part("jobs.worker_operator")
    with monkeypatch.context() as patched:
        patched.setattr(operator, "bpy", SimpleNamespace(context=SimpleNamespace(
            window_manager=SimpleNamespace(windows=[window]))))
        operator.redraw_sidebars()
    assert drawn == ["UI"]


def test_what_is_opened_is_what_the_job_filled(bpy, use, monkeypatch, tmp_path):
    """Whatever folder the scene names by the time it ends."""
    run_stage, opened = part("jobs.run_stage"), []
    in_a_window = SimpleNamespace(
        app=SimpleNamespace(background=False), ops=SimpleNamespace(limber=SimpleNamespace(
            open_result=lambda _, directory: opened.append(directory))))
    operator = SimpleNamespace(
        report=lambda *_: None, title="Plan Path", stage_name="plan", _name="p",
        _folder=tmp_path / "a.branch", stage=part("jobs.stages").stages()["plan"],
        _show_what_was_made=lambda _: None)
    bpy.context.scene.limber.branch_folder = str(tmp_path / "another.branch")
    with monkeypatch.context() as patch:
        patch.setattr(run_stage, "bpy", in_a_window)
        run_stage.StageOperator.finish(operator, bpy.context, json.loads('{"seconds": 1}'))
    assert opened == [str(tmp_path / "a.branch")]
