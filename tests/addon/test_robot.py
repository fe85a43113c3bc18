"""A robot moves only when its plan was checked as it is and a name was typed; its force is seen."""

import json
import shutil
import sys
import time
from pathlib import Path

import pytest
from tests.addon.conftest import part

from limber.store import Branch

EXAMPLE = Path(__file__).parents[2] / "blend_files" / "bending_branch"


@pytest.fixture()
def checked(bpy, registered, tmp_path, monkeypatch):
    """The example after a dry run; returns its folder, and a function for what the worker got."""
    folder, log = tmp_path / "twig.branch", tmp_path / "asked.json"
    shutil.copytree(EXAMPLE, folder)
    (tmp_path / "cell.toml").write_text("")
    script = tmp_path / "worker.py"
    script.write_text(
        "import json, sys\n"
        f"log = {str(log)!r}\n"
        "open(log, 'w').write(json.dumps(sys.argv[1:]))\n"
        "print(json.dumps({'status': 'done', 'armed': '--arm' in sys.argv, 'seconds': 0.1,\n"
        "                  'predicted_peak_force_n': 2.5}))\n")
    monkeypatch.setattr(part("preferences"), "worker_command",
                        lambda: [sys.executable, str(script)])
    with Branch.open(folder).stage("execute-preview:to-goal", reads=["plans/to-goal.csv"]):
        pass
    settings = bpy.context.scene.limber
    settings.branch_folder = str(folder)
    settings.execute.name, settings.execute.cell = "to-goal", str(tmp_path / "cell.toml")
    assert bpy.ops.limber.execute() == {"FINISHED"}
    assert "--arm" not in json.loads(log.read_text())
    return folder, lambda: json.loads(log.read_text())


def test_a_checked_plan_is_followed_once_its_name_is_typed(bpy, checked):
    """The worker gets what was typed, and compares it itself; a stop is held, not gone back on."""
    _, asked = checked
    assert bpy.ops.limber.arm.poll()
    with pytest.raises(RuntimeError, match="Type to-goal"):
        bpy.ops.limber.arm()
    assert "--arm" not in asked()
    bpy.ops.limber.arm(confirm="to-gaol")
    given = asked()
    assert given[0] == "execute" and "--arm" in given
    assert given[given.index("--confirm") + 1] == "to-gaol", "as it was typed"
    assert given[given.index("--after-stop") + 1] == "hold"


@pytest.mark.slow
def test_the_plan_in_sight_is_what_a_robot_would_follow(bpy, worker_here, beam):
    """Opened, its name stands in the robot's panel: the panel's default names no plan."""
    bpy.ops.limber.open_result(directory=str(beam.folder))
    assert bpy.context.scene.limber.execute.name == "to-goal"


def test_not_without_a_dry_run_of_the_same(bpy, checked, tmp_path):
    """Other settings, a plan made anew, another folder: it has to be checked again."""
    folder, _ = checked
    arming = part("plan.robot")
    given = part("properties").OPEN + "speed"  # left open, it is the plan's own
    bpy.context.scene.limber.execute.speed = 0.01
    setattr(bpy.context.scene.limber.execute, given, True)
    assert "settings have changed" in arming.why_not_armed(bpy.context)
    assert not bpy.ops.limber.arm.poll()
    setattr(bpy.context.scene.limber.execute, given, False)
    assert not arming.why_not_armed(bpy.context)
    with Branch.open(folder).stage("plan:to-goal") as stage:
        stage.path("plans/to-goal.csv").write_text("x_m,y_m,z_m\n0,0,0\n0,0,1\n")
    assert "plan has changed" in arming.why_not_armed(bpy.context)
    bpy.context.scene.limber.branch_folder = str(tmp_path / "another.branch")
    assert "Run the dry run" in arming.why_not_armed(bpy.context)


def test_a_robot_never_waits_for_its_turn(bpy, checked):
    """Queued, it would move when nobody is there any more."""
    jobs = part("jobs.jobs")
    jobs.start("Estimating", [sys.executable, "-c", "import time; time.sleep(30)"])
    operator = part("plan.robot").LIMBER_OT_arm
    moves = type("Moves", (), {"trouble": lambda *_: "", "confirm": "to-goal"})()
    with pytest.raises(ValueError, match="immediately or not at all"):
        operator.arguments(moves, bpy.context)
    jobs.forget()


def test_a_recording_asks_for_its_name(bpy, checked):
    """It moves a robot too."""
    _, asked = checked
    settings = bpy.context.scene.limber.record
    settings.cell, settings.name = bpy.context.scene.limber.execute.cell, "pull-2"
    with pytest.raises(RuntimeError, match="Type pull-2"):
        bpy.ops.limber.record()
    bpy.ops.limber.record(confirm="pull-2")
    assert asked()[0] == "record" and "--confirm pull-2 --after-stop hold" in " ".join(asked())


def _write_live(folder, **changed):
    told = {"format": 1, "title": "Following to-goal", "step": "path", "force_n": 3.25,
            "expected_n": 3.0, "peak_n": 4.5, "limit_n": 10.0, "at": time.time()}
    (folder / ".robot-live.json").write_text(json.dumps(told | changed))


def test_the_live_force_is_in_the_panel(bpy, checked):
    """Force over the limit, peak, what was expected; not what a killed worker left, not rubbish."""
    from tests.addon.test_panels import _draw_step

    folder, _ = checked
    assert not any("Peak" in text for text in _draw_step(bpy, "robot").names("label"))
    _write_live(folder)
    drawn = _draw_step(bpy, "robot")
    assert ("progress", 0.325, "3.25 N of 10 N") in drawn.calls
    assert {"Following to-goal: path", "Peak 4.50 N, expected 3.00 N"} <= set(drawn.names("label"))
    assert "limber.arm" in drawn.names("operator")
    live_force = part("plan.live_force")
    assert live_force.read(folder, now=time.time() + 60) is None
    for changed in ({"force_n": None, "expected_n": None}, {"limit_n": 0.0}, {"format": 2},
                    {"peak_n": "many"}):
        _write_live(folder, **changed)
        found = live_force.read(folder)
        assert (found is None) == ("force_n" not in changed)
    (folder / ".robot-live.json").write_text("[[[")
    assert live_force.read(folder) is None


def test_while_it_moves_there_is_a_stop(bpy, checked, tmp_path):
    """One large button, and that it is no emergency stop; its force, whichever branch is chosen."""
    from tests.addon.test_panels import _draw_step

    jobs, (folder, _) = part("jobs.jobs"), checked
    jobs.start(part("plan.robot").LIMBER_OT_arm.title,
               [sys.executable, "-c", "import time; time.sleep(30)"], str(folder))
    _write_live(folder)
    bpy.context.scene.limber.branch_folder = str(tmp_path / "another.branch")
    drawn = _draw_step(bpy, "robot")
    assert ("operator", "limber.cancel_job", "Stop Robot") in drawn.calls
    assert ("progress", 0.325, "3.25 N of 10 N") in drawn.calls
    assert "limber.arm" not in drawn.names("operator")
    assert any("Not an emergency stop" in text for text in drawn.names("label"))
    jobs.forget()


def test_the_file_is_the_workers(addon):
    """Reader and writer speak of the same file in the same way."""
    from limber.robot.driver import link as live_force

    ours = part("plan.live_force")
    assert (ours.FILE, ours.FORMAT) == (live_force.FILE, live_force.FORMAT)
