"""Motions of the arm by itself: past what is in its way, slow near the branch, dry by default."""


import numpy as np
import pytest
from tests.subjects.commands import robot_answer

from benchmarks.robot_cells import cell_file, standing_at
from benchmarks.robot_faults import cell_for, set_off, straight
from limber.cell.cell_file import Cell, WorkspaceEntry
from limber.cell.obstacles import Box
from limber.cell.reach_and_collision import ArmSurroundings
from limber.cli.closed_loop.cell_layout import grasp_of
from limber.core.errors import NoPathError
from limber.core.numerics.rigid import matrices
from limber.geometry.skeleton.skeleton import Skeleton
from limber.robot.driver.link import RobotLink
from limber.robot.motion.joint_path import joint_space_path, to_joints
from limber.robot.motion.trajectory import along_bounded
from limber.store import Branch
from limber.store.loading import load_skeleton

GRASP = (0, 0, 0.15, 0, 0, 0)
CELL = Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6},
            tool={"grasp_pose": GRASP,
                  "parts": [{"start_m": (0, 0, 0), "end_m": (0, 0, 0.15), "radius_m": 0.04}]})
HOME = np.array(CELL.arm.home)
ASIDE = HOME + [1.6, 0, 0, 0, 0, 0]


def tip(joints: np.ndarray) -> np.ndarray:
    return (CELL.arm.forward(joints) @ matrices(np.array(CELL.tool.grasp_pose)))[..., :3, 3]


def a_box(half: float) -> Box:
    """In the middle of the straight way from home aside."""
    return Box("pot", np.full(3, half), tip(HOME + [0.8, 0, 0, 0, 0, 0]), np.eye(3))


def test_a_way_leads_past_a_box_and_keeps_every_speed():
    free_of = ArmSurroundings(CELL, (a_box(0.08),), None)
    direct = HOME + np.linspace(0, 1, 30)[:, None] * (ASIDE - HOME)
    assert not free_of.free(direct).all()
    motion = to_joints(CELL, HOME, ASIDE, free_of)
    assert motion.joints[0] == pytest.approx(HOME) and motion.joints[-1] == pytest.approx(ASIDE)
    between = np.array([motion.angles(t) for t in np.linspace(0, motion.duration, 400)])
    assert free_of.clearance(between).min() > 0.015
    speeds = np.abs(np.diff(between, axis=0)) / (motion.duration / 399)
    assert speeds.max() < 0.45
    assert motion.greatest_speeds[0] <= CELL.limits.speed_m_s * 1.001
    assert motion.greatest_speeds[1] <= CELL.limits.turn_speed_rad_s


def test_a_goal_inside_something_is_refused_and_so_is_a_wall_all_around():
    with pytest.raises(NoPathError, match="goal is in collision"):
        to_joints(CELL, HOME, HOME + [0.8, 0, 0, 0, 0, 0],
                  ArmSurroundings(CELL, (a_box(0.08),), None))
    with pytest.raises(NoPathError, match="beyond its limit"):
        to_joints(CELL, HOME, HOME + [7.0, 0, 0, 0, 0, 0], ArmSurroundings(CELL, (), None))
    low, high = tip(HOME) - 0.1, tip(HOME) + 0.1
    narrow = CELL.model_copy(update={"workspace": WorkspaceEntry(low_m=low, high_m=high)})
    with pytest.raises(NoPathError, match="outside the workspace"):
        to_joints(narrow, HOME, ASIDE, ArmSurroundings(narrow, (), None))
    with pytest.raises(NoPathError, match="No free way"):
        joint_space_path(np.zeros(2), np.ones(2), np.array([[-1.0, 2.0]] * 2),
                         lambda angles: np.abs(angles.sum(axis=1) - 1.0) > 0.1)


def test_an_arm_does_not_go_through_itself_or_the_branch():
    """A folded elbow puts the gripper into the upper arm; a branch at the tip is met."""
    around = ArmSurroundings(CELL, (), None)
    assert around.free(HOME[None])[0]
    folded = HOME.copy()
    folded[2] = 2.75
    assert not around.free(folded[None])[0]
    place = tip(ASIDE)
    branch = Skeleton(np.array([place - [0, 0, 0.2], place + [0, 0, 0.2]]), np.array([-1, 0]),
                      np.array([0.01, 0.01]))
    assert not ArmSurroundings(CELL, (), branch).free(ASIDE[None])[0]


def test_it_is_slow_near_the_branch():
    place = tip(ASIDE) + [0, 0, -0.12]
    branch = Skeleton(np.array([place - [0, 0, 0.3], place]), np.array([-1, 0]),
                      np.array([0.01, 0.01]))
    open_air = to_joints(CELL, HOME, ASIDE, ArmSurroundings(CELL, (), None))
    beside = to_joints(CELL, HOME, ASIDE, ArmSurroundings(CELL, (), branch))
    assert beside.duration > 1.2 * open_air.duration
    assert beside.joints == pytest.approx(open_air.joints)


def test_times_on_a_bounded_way_keep_speeds_and_acceleration():
    steps, bounds = np.full(100, 0.005), np.r_[np.full(50, 0.05), np.full(51, 0.01)]
    times = along_bounded(steps, bounds, 0.1)
    speeds = steps / np.diff(times)
    assert speeds.max() <= 0.05 * (1 + 1e-9) and speeds[51:].max() <= 0.01 * (1 + 1e-9)
    assert speeds.max() > 0.049
    middles = 0.5 * (times[1:] + times[:-1])
    assert np.abs(np.diff(speeds) / np.diff(middles)).max() <= 0.1 * 1.01
    assert along_bounded(np.array([0.01]), np.full(2, 0.05), 0.1)[1] > 0


@pytest.mark.slow
def test_home_and_retreat_move_only_when_armed(stepped, tmp_path, capfd):
    """Back along the way of a killed program; then home from there, joints exact."""
    cell = cell_for(stepped.address)
    cell = cell.model_copy(update={"tool": cell.tool.model_copy(update={
        "grasp_pose": GRASP, "mass_kg": 0.0, "gripper": "digital_output",
        "grip_seconds": 0.1})})
    path = str(cell_file(cell, tmp_path))
    with RobotLink(cell) as link:
        begin = np.array(stepped.state["pose"])
        set_off(stepped, link, straight(stepped, (0.0, 0.1, 0.0), expected=False))
        link.process.kill()
    while np.linalg.norm(stepped.state["tool_speed"]) > 1e-3:
        stepped.rest(0.02)
    before = stepped.state["joints"]
    code, told = robot_answer(capfd, "retreat", path)
    assert code == 0 and not told["armed"] and told["way_m"] > 0.002 and told["tare_known"]
    code, told = robot_answer(capfd, "retreat", path, "--arm", "--confirm", "nothing")
    assert code == 2 and stepped.state["joints"] == before
    code, told = robot_answer(capfd, "retreat", path, "--arm", "--confirm", "retreat")
    assert code == 0 and told["retreated"] and not told["gripper_opened"]
    assert np.allclose(stepped.state["pose"][:3], begin[:3], atol=2e-3)
    stepped.ask("stand", joints=list(np.array(cell.arm.home) + [0.1, 0, 0, 0.1, 0, 0]))
    code, told = robot_answer(capfd, "home", path, "--arm", "--confirm", "home")
    assert code == 0 and told["reached"]
    assert stepped.state["joints"] == pytest.approx(cell.arm.home, abs=1e-4)


@pytest.mark.slow
def test_release_opens_the_gripper_and_goes_away_from_the_branch(stepped, tmp_path, capfd):
    cell = cell_for(stepped.address)
    cell = cell.model_copy(update={
        "tool": cell.tool.model_copy(update={
            "grasp_pose": GRASP, "mass_kg": 0.0, "grip_seconds": 0.1,
            "gripper": "digital_output"}),
        "approach": cell.approach.model_copy(update={"distance_m": 0.02})})
    path = str(cell_file(cell, tmp_path))
    stepped.ask("outputs", value=1)
    begin = matrices(np.array(stepped.state["pose"]))
    code, told = robot_answer(capfd, "release", path)
    assert code == 0 and not told["armed"] and stepped.state["outputs"] == 1
    code, told = robot_answer(capfd, "release", path, "--arm", "--confirm", "release")
    assert code == 0 and told["reached"] and stepped.state["outputs"] == 0
    moved = np.array(stepped.state["pose"][:3]) - begin[:3, 3]
    assert moved == pytest.approx(-0.02 * begin[:3, 2], abs=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["goto-start", "goto-grasp"])
def test_the_arm_goes_to_where_it_is_asked(command, stepped, planned_folder, tmp_path, capfd):
    """Slow: two dry runs of the plan. At the grasp the gripper is on the branch, across it."""
    cell = standing_at(Branch.open(planned_folder), stepped.address, grip_seconds=0.1)
    path = str(cell_file(cell, tmp_path))
    words = (capfd, command, path, str(planned_folder))
    code, told = robot_answer(*words)
    assert code == 0 and not told["armed"], told
    goal = np.array(told["end_joints_rad"])
    start = goal if command == "goto-start" else np.array(told["start_joints_rad"])
    stepped.ask("stand", joints=list(start + [0.03, 0, 0, 0, 0, 0.05]))
    code, told = robot_answer(*words, "--arm", "--confirm", command)
    assert code == 0 and told["reached"], told
    assert stepped.state["joints"] == pytest.approx(goal, abs=1e-4)
    if command == "goto-grasp":
        point, axis = grasp_of(load_skeleton(Branch.open(planned_folder)), 2 / 3)
        held = cell.grasp_frames(cell.arm.forward(goal))
        assert held[:3, 3] == pytest.approx(point, abs=1e-3) and abs(held[:3, 1] @ axis) > 0.99


def test_the_gripper_opens_while_the_robot_is_stopped(stepped, tmp_path, capfd):
    """After an emergency stop no program runs, and none is needed."""
    cell = cell_for(stepped.address)
    cell = cell.model_copy(update={"tool": cell.tool.model_copy(update={
        "grasp_pose": GRASP, "gripper": "digital_output", "grip_seconds": 0.1,
        "close_output": 3})})
    path = str(cell_file(cell, tmp_path))
    stepped.ask("outputs", value=0b1001)
    stepped.ask("emergency_stop")
    code, told = robot_answer(capfd, "open", path)
    assert code == 0 and stepped.state["outputs"] == 0b1001
    code, told = robot_answer(capfd, "open", path, "--arm", "--confirm", "open")
    assert code == 0 and told["armed"] and stepped.state["outputs"] == 0b0001
