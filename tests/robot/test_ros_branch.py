"""A gripper is weighed, a branch pulled and a plan followed through rosbridge, in its time."""

import numpy as np
import pytest
from tests.robot.test_execution import cell_before, motion_settings_at
from tests.robot.test_record import sideways_pull
from tests.subjects.commands import robot_answer

from benchmarks.robot_cells import cell_file, sideways, standing_at, true_branch
from benchmarks.robot_ros_stepped import SteppedRos
from benchmarks.robot_rosbridge import STEP, RosBridge
from benchmarks.robot_stepped import BranchHere
from limber.cell.cell_file import Cell
from limber.geometry.rigid_kernels import weight_wrench
from limber.recordings.recording import read_pull
from limber.stages.paths.execute import ExecutePlan
from limber.stages.pulls.record import RecordPull
from limber.store import Branch

pytestmark = pytest.mark.slow


def in_ros(cell: Cell, mass: float = 0.8) -> Cell:
    """The same cell, whose robot and gripper of ``mass`` [kg] are reached through rosbridge."""
    return cell.model_copy(update={
        "robot": cell.robot.model_copy(update={"address": "ws://stepped"}),
        "tool": cell.tool.model_copy(update={"gripper": "ros", "mass_kg": mass})})


def robot_holding(branch: Branch, cell: Cell, folder) -> SteppedRos:
    """A robot in ROS with the true branch in its gripper."""
    load, server = BranchHere(true_branch(branch, cell, folder)), RosBridge(cell.arm.home)

    def felt(joints: np.ndarray) -> np.ndarray:
        flange = cell.arm.forward(joints)
        return load.wrench(flange, STEP) + weight_wrench(
            cell.tool.mass_kg - server.payload, np.zeros(3), flange[:3, :3])
    server.load = felt
    server.gripped = lambda position: load.grasp() if position else load.release()
    return SteppedRos(server)


def test_a_gripper_is_weighed_and_a_pull_recorded_as_by_the_direct_route(branch_folder, tmp_path,
                                                                         capfd):
    """The payload in the controller is the gripper's again after it was weighed without one."""
    branch = Branch.open(branch_folder)
    cell = in_ros(standing_at(branch, "127.0.0.1", grip_seconds=0.3))
    path = cell_file(cell, tmp_path)
    with robot_holding(branch, cell, tmp_path).here() as robot:
        code, told = robot_answer(capfd, "weigh", str(path), "--arm", "--confirm", "weigh")
        assert code == 0 and told["mass_kg"] == pytest.approx(0.8, abs=0.02), told
        assert robot.server.payload == 0.8
        result = RecordPull(branch_folder=branch_folder, cell=path, name="ros",
                            **sideways_pull(branch_folder), confirm="ros").run()
        assert result["ended"] == "reached" and not robot.server.is_busy
    pull = read_pull(branch_folder / "pulls" / "ros")
    assert np.diff(pull.times) == pytest.approx(np.full(len(pull.times) - 1, 0.008), abs=1e-5)
    away = np.linalg.norm(pull.poses[:, :3] - pull.entry.grasp.point_m, axis=1)
    assert away.max() == pytest.approx(0.012, abs=3e-4) and away[-1] < 5e-4
    middle = int(away.argmax())
    assert pull.wrenches[middle - 9:middle + 9, :3].mean(axis=0) @ sideways(branch) > 0.3


def test_a_plan_is_executed_through_rosbridge(planned_folder, tmp_path, monkeypatch):
    """Approach, hold, follow, return, let go; the force as predicted."""
    monkeypatch.setattr("limber.stages.paths.execute._TARE_SECONDS", 0.3)
    monkeypatch.setattr("limber.robot.robot_state.unweighed", lambda cell: None)
    branch, cell = Branch.open(planned_folder), in_ros(cell_before(planned_folder, "127.0.0.1"))
    asked = ExecutePlan(branch_folder=planned_folder, name="path", cell=cell_file(cell, tmp_path),
                        **motion_settings_at(planned_folder))
    with robot_holding(branch, cell, tmp_path).here() as robot:
        robot.server.joints = np.array(asked.run()["start_joints_rad"])
        result = asked.model_copy(update={"arm": True, "confirm": "path"}).run()
    assert result["reached"] and not robot.server.is_busy
    assert result["force_within_share"] > 0.95 and result["path_error_m"] < 1e-3, result
    start = cell.arm.forward(np.array(result["start_joints_rad"]))
    assert cell.arm.forward(robot.server.joints) == pytest.approx(start, abs=1e-3)
