"""A path is planned anew where a branch stiffer than estimated stops the arm, in its own time."""

import shutil

import numpy as np
import pytest
from tests.robot.test_execution import cell_before, motion_settings_at

from benchmarks.robot_cells import GRASP_POSE, cell_file, true_branch
from benchmarks.robot_stepped import BranchHere, SteppedRobot
from limber.core.errors import SafetyStop
from limber.core.progress import Progress
from limber.estimation.simulated_pull import PullSpec
from limber.robot.virtual.controller import Controller
from limber.stages.paths.energy import SampleEnergy
from limber.stages.paths.execute import ExecutePlan
from limber.stages.paths.execute_replan import is_of_modulus
from limber.stages.paths.plan import PlanPaths
from limber.stages.pulls.virtual_pull import load_truth
from limber.store import Branch
from limber.store.loading import load_mesh

HARDER = 6.0


@pytest.fixture(scope="module")
def planned(planned_template, tmp_path_factory):
    """The small branch, of wood so hard that its path takes 8 N, and a plan on its field. It is
    slow enough to tell a stiffer branch from a push: its 29 mm take 3 s."""
    folder = shutil.copytree(planned_template, tmp_path_factory.mktemp("anew") / "anew.branch")
    branch, end = Branch.open(folder), np.genfromtxt(
        folder / "plans" / "path.csv", delimiter=",", names=True)[-1]
    mesh = load_mesh(branch)
    with branch.stage("estimate") as stage:
        mesh.with_data(cell_data={**mesh.cell_data, "young": HARDER * mesh.cell_data["young"]}
                       ).write(stage.path("mesh.vtu"))
    SampleEnergy(branch_folder=folder, samples=60).run()
    PlanPaths(branch_folder=folder, goal=tuple(float(end[name]) for name in ("x_m", "y_m", "z_m")),
              goal_tolerance=0.004, max_force=14.0, speed=0.01).run()
    return folder


@pytest.fixture
def execute(planned, tmp_path, monkeypatch):
    """Execute a copy of the plan on a robot whose branch is stiffer than the mesh; return the
    result, or that of the stop, and the warnings."""
    monkeypatch.setattr("limber.stages.paths.execute._TARE_SECONDS", 0.3)

    def run(stiffer: float, soft: float, **options):
        folder = shutil.copytree(planned, tmp_path / f"{len([*tmp_path.iterdir()])}.branch")
        branch = Branch.open(folder)
        cell = cell_before(folder, "127.0.0.1", unexpected_force_n=3.0)
        limits = cell.limits.model_copy(update={"soft_force_n": soft, "hard_force_n": soft + 5.0})
        cell = cell.model_copy(update={"limits": limits})
        young = HARDER * stiffer * np.asarray(load_truth(branch, PullSpec()).young, float)
        load = BranchHere(true_branch(branch, cell, tmp_path, tuple(map(float, young))))
        robot, told = SteppedRobot(Controller("ur5e", load=load), "127.0.0.1"), list[str]()
        asked = ExecutePlan(branch_folder=folder, name="path", cell=cell_file(cell, tmp_path),
                            **motion_settings_at(folder))
        start = asked.run()["start_joints_rad"]
        with robot.here():
            robot.ask("stand", joints=list(map(float, start)))
            robot.ask("tool", offset=list(GRASP_POSE))
            try:
                result = asked.model_copy(update={"arm": True, "confirm": "path", **options}).run(
                    Progress(on_warning=lambda text: told.append(str(text))))
            except SafetyStop as stop:
                result = stop.result
        return result, told, robot
    return run


@pytest.mark.slow
def test_a_stiffer_branch_is_taken_to_the_goal_by_another_plan(execute):
    """It stops without --replan; with it the rest is planned with 1.5 times the modulus, once."""
    result, told, _ = execute(1.5, 15.0)
    assert not result["reached"] and "the branch is stiffer" in result["stop_reason"]
    assert "replans" not in result and not any("planned anew" in text for text in told)
    result, told, robot = execute(1.5, 15.0, replan=3)
    assert result["reached"], (result["stop_reason"], told)
    (once,) = result["replans"]
    assert once["young_factor"] == pytest.approx(1.5, abs=3 * once["young_factor_sigma"])
    assert once["young_factor"] == pytest.approx(1.5, rel=0.1)
    assert result["peak_force_n"] == pytest.approx(result["predicted_peak_force_n"], rel=0.05)
    assert result["peak_force_n"] < once["peak_force_n"] < 14.0
    assert once["certificate"]["gap_percent"] < 5.0
    assert result["path_error_m"] < 1e-3
    assert any("1 of at most 3" in text for text in told)
    assert any("times the one before" in text and "Its cost is at most" in text for text in told)
    # It came back by the path that it went: to the start, with the branch let go.
    state = robot.state
    assert state["branch"] == "free" and np.linalg.norm(state["tool_speed"]) < 1e-3
    assert np.linalg.norm(np.subtract(state["pose"][:3], result["start_pose_base"][:3])) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("stiffer", "soft", "reason"), [
    (1.5, 10.0, "the branch is stiffer"), (1.08, 8.2, "soft force limit")])
def test_a_goal_beyond_the_limit_is_refused_and_the_arm_holds(execute, stiffer, soft, reason):
    """With 1.5 times the modulus the goal takes 12 N: with 10 N allowed none is followed to it."""
    result, told, robot = execute(stiffer, soft, replan=2)
    assert not result["reached"] and result["peak_force_n"] < soft and reason in result[
        "stop_reason"]
    assert any("It was not planned anew: " in text and f"{soft:g} N" in text
               for text in told), told
    assert result["after_stop"]["choice"] == "hold" and "replans" not in result
    assert robot.state["branch"] == "held" and np.linalg.norm(robot.state["tool_speed"]) < 1e-3


@pytest.mark.slow
def test_it_is_planned_anew_no_more_than_asked(execute, monkeypatch):
    """Each new plan is made with half of the modulus that was found, so each is stopped."""
    from limber.stages.paths import execute_replan

    planned_anew, count = execute_replan.planned_anew, []

    def halved(planned, event, link, progress):
        count.append(event["reason"])
        factor, deviation = event["force_factor"]
        return planned_anew(planned, event | {"force_factor": [0.6 * factor, 0.6 * deviation]},
                            link, progress)
    monkeypatch.setattr(execute_replan, "planned_anew", halved)
    result, told, _ = execute(1.5, 15.0, replan=2, after_stop="retreat")
    assert not result["reached"] and len(count) == 2
    assert len(result["replans"]) == 2 and any("2 of at most 2" in text for text in told)
    assert result["after_stop"]["retreated"] and result["after_stop"]["force_n"] < 1.0


@pytest.mark.parametrize(("reason", "is_so"), [
    ("soft force limit [N] (15.1, allowed 15)", True),
    ("the branch is stiffer than its moduli, or held elsewhere: the force has changed by", True),
    ("the gripper carries another load than was weighed; or the branch is softer than its moduli: "
     "the force has changed by 0.2 N", True),
    ("nothing is held; or the branch is softer than its moduli: the force has changed by 0 N",
     False),
    ("the branch is softer than its moduli; or it slips in the gripper: the force has changed by 1 "
     "N", False),
    ("the sensor reads a multiple of the force; or the branch is stiffer than its moduli, or held "
     "elsewhere: the force has changed by 9 N", False),
    ("hard force limit [N] (31, allowed 30)", False), ("a stop was requested", False)])
def test_what_is_planned_anew(reason, is_so):
    assert is_of_modulus(reason) == is_so
