"""A path as motion of a robot, and `limber execute` on the virtual robot that holds the branch."""

import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.robot_cells import (
    GRASP_POSE,
    cell_file,
    robot_holding,
    standing_at,
    stepped_robot_holding,
)
from benchmarks.robot_faults import restored
from limber.cell.cell_file import ApproachEntry, Cell, check_plan
from limber.cell.ur_arms import ARMS
from limber.core.errors import InputError, NoPathError, SafetyStop
from limber.core.numerics.rigid import inverted, matrices, pose_vectors
from limber.core.progress import Progress
from limber.robot.calibration import fit_base
from limber.robot.motion.execution import across, followed, robot_motion
from limber.robot.motion.trajectory import Predicted
from limber.robot.recorder import NUDGE_M
from limber.stages.paths import execute_path
from limber.stages.paths.execute import ExecutePlan, _as_planned, _as_slow_as_checked
from limber.stages.paths.execute_path import planned_poses
from limber.stages.pulls.record_prediction import PullModel
from limber.store import Branch
from limber.store.loading import load_skeleton

FRACTION = 0.92


def test_a_base_is_found_from_touched_points():
    """Six points, 0.3 mm of error: found within what it says of itself, times three."""
    rng = np.random.default_rng(3)
    truth = np.array([0.6, -0.2, 0.1, 0.3, -0.4, 1.2])
    frame = matrices(truth)
    on_branch = rng.uniform(-0.2, 0.3, (6, 3))
    touched = (on_branch - frame[:3, 3]) @ frame[:3, :3] + 3e-4 * rng.standard_normal((6, 3))
    fit = fit_base(touched, on_branch)
    turn = Rotation.from_rotvec(fit.pose[3:]) * Rotation.from_rotvec(truth[3:]).inv()
    assert turn.magnitude() < 3 * fit.rotation_sigma
    middle = touched.mean(axis=0)
    off = (matrices(fit.pose) - frame) @ np.r_[middle, 1.0]
    assert np.linalg.norm(off[:3]) < 3 * np.sqrt(3) * fit.position_sigma
    assert fit.residual < 1e-3


def predicted(poses: np.ndarray, forces: np.ndarray, stiffness: float = 0.0) -> Predicted:
    """A gripper that feels forces [n, 3], as stiff [N/m] in every direction."""
    count = len(poses)
    slopes = np.zeros((count, 6, 6))
    slopes[:, range(3), range(3)] = stiffness
    return Predicted(poses, np.hstack([forces, np.zeros((count, 3))]), slopes,
                     np.zeros((count, 3, 3)))


def test_what_is_felt_gives_way_with_the_gripper_and_is_as_unsure_as_its_way():
    """A spring of k in series with the gripper's compliance; a base turned against its calibration
    moves a way of 50 mm across it."""
    cell = Cell(robot={"model": "ur5e", "pose_sigma_m": 1e-4}, base={
        "pose": (0,) * 6, "rotation_sigma_rad": 0.01}, tool={"compliance_m_per_n": 1e-4})
    poses = np.zeros((3, 6))
    poses[:, 0] = [0.0, 0.02, 0.05]
    forces = 1e4 * poses[:, :3]
    felt = predicted(poses, forces, 1e4).felt(cell, poses[0])
    assert felt.wrenches[:, 0] == pytest.approx(0.5 * forces[:, 0])
    assert felt.slopes[2, 0, 0] == pytest.approx(5e3)
    deviations = np.sqrt(np.diagonal(felt.covariance[:, :3, :3], axis1=1, axis2=2))
    assert deviations[0] == pytest.approx([0.5, 0.5, 0.5])
    assert deviations[2] == pytest.approx([0.5, np.hypot(0.5, 2.5), np.hypot(0.5, 2.5)])


def test_the_robot_holds_the_piece_along_the_whole_path():
    """From joints through the tool to the piece: where the plan has it, turned as it turns."""
    cell = Cell(robot={"model": "ur5e"}, base={"pose": (0.55, 0.1, 0.0, 0, 0, 0.4)},
                tool={"grasp_pose": (0, 0, 0.15, 0, 0, 0)})
    part = np.linspace(0, 1, 20)[:, None]
    poses = np.hstack([np.array([0.0, 0.0, 0.5]) + part * [0.08, 0.03, -0.02],
                       part * [0.1, 0.2, -0.05]])
    forces = part * np.array([4.0, 1.0, 0.0])
    motion = robot_motion(cell, predicted(poses, forces), np.array([0, 0, 1.0]), speed=0.03)
    flange = cell.arm.forward(motion.joints.joints)
    grasp = cell.grasp_frames(flange)
    first = len(motion.approach.times) - 1
    grip = inverted(matrices(poses[0])) @ grasp[first]
    last = pose_vectors(grasp[-1] @ inverted(grip))
    assert last == pytest.approx(poses[-1], abs=1e-9)
    way = grasp[first, :3, 3] - grasp[0, :3, 3]
    assert way == pytest.approx(cell.approach.distance_m * grasp[first, :3, 2], abs=1e-9)
    # The gripper comes across the branch.
    assert abs(grasp[first, :3, 2] @ [0, 0, 1]) < 1e-9
    assert motion.path.expected.wrenches[-1, :3] == pytest.approx(forces[-1])
    speed = np.linalg.norm(np.diff(motion.path.poses[:, :3], axis=0), axis=1) / np.diff(
        motion.path.times)
    assert speed.max() <= 0.03 * (1 + 1e-6)
    assert motion.joints.speed_share(cell.arm, np.concatenate(
        [motion.approach.times, motion.approach.duration + motion.path.times[1:]])) < 1


def test_a_path_out_of_reach_and_a_speed_over_the_cells_are_refused():
    cell = Cell(robot={"model": "ur3e"}, base={"pose": (2.0, 0.1, 0.0, 0, 0, 0.4)})
    poses = np.zeros((5, 6))
    poses[:, 0] = np.linspace(0, 0.1, 5)
    nothing = predicted(poses, np.zeros((5, 3)))
    with pytest.raises(NoPathError, match="reach"):
        robot_motion(cell, nothing, np.array([0, 0, 1.0]), speed=0.03)
    with pytest.raises(InputError, match="exceeds the cell"):
        robot_motion(cell, nothing, np.array([0, 0, 1.0]), speed=0.2)


def test_ways_across_a_branch_are_right_handed_and_across():
    for axis in ([0, 0, 1], [1, 0, 0], [0.3, -0.5, 0.2]):
        for vector in across(np.array(axis, float)):
            turn = Rotation.from_rotvec(vector).as_matrix()
            assert np.linalg.det(turn) == pytest.approx(1.0)
            assert abs(turn[:, 2] @ axis) < 1e-9


def test_what_was_followed_is_measured():
    samples = np.full((50, 37), np.nan)
    along = np.linspace(0, 0.1, 50)
    samples[:, 1:4] = np.column_stack([along, np.full(50, 2e-3), np.zeros(50)])
    samples[:, 13:16] = np.column_stack([10 * along, np.full(50, 0.02), np.zeros(50)])
    samples[:, 25:28] = np.column_stack([10 * along, np.zeros((50, 2))])
    found = followed(samples, np.array([[0, 0, 0], [0.1, 0, 0.0]]))
    assert found.path_error == pytest.approx(2e-3)
    assert found.force_error == pytest.approx(0.02, abs=1e-3)
    assert found.force_within == 1.0
    # 0.08 N off, 8 % of the peak: outside of an interval of 0.02 N, within one of 0.04 N.
    samples[:, 14] = 0.08
    for sigma, share in ((0.02, 0.0), (0.04, 1.0)):
        samples[:, 31:37] = np.array([1, 0, 0, 1, 0, 1]) * sigma**2
        assert followed(samples, np.array([[0, 0, 0], [0.1, 0, 0.0]])).force_within == share


@pytest.mark.slow
def test_a_dry_run_moves_nothing_and_says_what_it_would_do(planned_folder, tmp_path):
    """Nobody listens at the address: a dry run needs no robot."""
    cell = standing_at(Branch.open(planned_folder), "127.0.0.97", fraction=FRACTION)
    result = ExecutePlan(branch_folder=planned_folder, name="path",
                         cell=cell_file(cell, tmp_path)).run()
    assert result["armed"] is False and result["reached"] is None
    assert result["predicted_peak_force_n"] > 0.1
    assert result["singularity_distance"] >= cell.limits.singularity
    legs = {leg["name"]: leg for leg in result["legs"]}
    assert legs["path"]["peak_force_n"] == pytest.approx(result["predicted_peak_force_n"])
    assert legs["hold"]["duration_s"] == 2.0 and legs["path"]["branch_distance_m"] is not None
    preview = np.genfromtxt(planned_folder / "executions" / "path-preview.csv", delimiter=",",
                            names=True)
    assert np.all(np.diff(preview["t_s"]) > 0)


def test_the_plans_own_approach_is_taken(planned_folder):
    """From rest by the motion's poses before the path, not straight; without the return."""
    branch = Branch.open(planned_folder)
    rows = [("approach", 0.0), ("approach", 0.03), ("path", 0.02), ("path", 0.01), ("return", 0.05)]
    with branch.stage("plan:path") as stage:
        stage.path("plans/path-motion.csv").write_text(
            "x_m,y_m,z_m,phase\n" + "".join(f"{x},0,0.3,{phase}\n" for phase, x in rows))
    found = planned_poses(branch, "path", np.array([0, 0, 0.3]))
    np.testing.assert_allclose(found[:, 0], [0.0, 0.03, 0.02, 0.01])


def _asked(**settings):
    return ExecutePlan(branch_folder="a.branch", cell="cell.toml", **settings)


def test_a_plan_that_was_checked_in_motion_is_followed_no_faster():
    """Its pace where that is slower, with a warning; the cell's and the settings' where not."""
    cell = Cell(robot={"model": "ur5e"}, base={"pose": (0.6, 0, 0, 0, 0, 0)})
    told = []
    settings, slow = _as_slow_as_checked({"speed_m_s": 0.01, "acceleration_m_s2": 0.02},
                                         _asked(speed=0.03), cell,
                                         Progress(on_warning=told.append))
    assert settings.speed == 0.01 and "10.0 mm/s" in told[0]
    assert slow.limits.acceleration_m_s2 == pytest.approx(0.02 * np.sqrt(0.5))
    settings, same = _as_slow_as_checked({"speed_m_s": 0.2, "acceleration_m_s2": 2.0},
                                         _asked(speed=0.03), cell, Progress())
    assert settings.speed == 0.03 and same.limits == cell.limits and len(told) == 1


def test_a_plan_is_executed_at_its_own_speed_and_held_as_long_as_it_says():
    """No faster than the cell allows; what is given counts; a plan of an older program has none."""
    cell = Cell(robot={"model": "ur5e"}, base={"pose": (0.6, 0, 0, 0, 0, 0)})
    plan = {"timing": {"speed_m_s": 0.02}, "legs": [
        {"name": "path", "duration_s": 5.0}, {"name": "hold", "duration_s": 7.0}]}
    own = _as_planned(plan, _asked(), cell)
    assert (own.speed, own.hold) == (0.02, 7.0)
    fast = _as_planned({"timing": {"speed_m_s": 0.2}}, _asked(hold=0.0), cell)
    assert (fast.speed, fast.hold) == (cell.limits.speed_m_s, 0.0)
    assert _as_planned({}, _asked(), cell).speed == 0.03


def test_a_base_out_of_reach_is_refused_before_any_force_is_solved(planned_folder, tmp_path,
                                                                   monkeypatch):
    """Solving the forces of a long path takes a minute; the plan's own poses tell the reach."""
    def solved(*_arguments: object) -> None:
        raise AssertionError("forces were solved")
    monkeypatch.setattr(execute_path, "predicted_along", solved)
    cell = standing_at(Branch.open(planned_folder), "127.0.0.97", fraction=FRACTION)
    base = (cell.base.pose[0] + 3.0, *cell.base.pose[1:])
    away = cell.model_copy(update={"base": cell.base.model_copy(update={"pose": base})})
    with pytest.raises(NoPathError, match="out of the arm's reach"):
        ExecutePlan(branch_folder=planned_folder, name="path", cell=cell_file(away, tmp_path)).run()


def test_a_gripper_that_would_meet_an_obstacle_is_refused_at_once(planned_folder, tmp_path,
                                                                  monkeypatch):
    """A box around the grasp, and a gripper with a shape: refused before any force is solved."""

    monkeypatch.setattr(execute_path, "predicted_along",
                        lambda *_: pytest.fail("forces were solved"))
    branch = Branch.open(planned_folder)
    cell = standing_at(branch, "127.0.0.97", fraction=FRACTION)
    place = tuple(map(float, load_skeleton(branch).point_at(FRACTION)))
    finger = {"start_m": (0, 0, 0), "end_m": (0, 0, 0.15), "radius_m": 0.01}
    box = {"kind": "box", "name": "shelf", "size_m": (0.1, 0.1, 0.1), "pose": (*place, 0, 0, 0)}
    blocked = Cell.model_validate(cell.model_dump() | {
        "tool": cell.tool.model_dump() | {"parts": [finger]}, "obstacles": [box]})
    with pytest.raises(NoPathError, match="inside shelf"):
        ExecutePlan(branch_folder=planned_folder, name="path",
                    cell=cell_file(blocked, tmp_path)).run()


def test_the_planned_clearance_is_kept_when_executed(planned_folder, tmp_path, monkeypatch):
    """Gripper and arm keep what the plan states, not just the obstacle's surface."""
    from limber.stages.paths import execute as stage

    monkeypatch.setattr(execute_path, "predicted_along",
                        lambda *_: pytest.fail("forces were solved"))
    monkeypatch.setattr("limber.robot.motion.execution._TURNS", 2)
    branch = Branch.open(planned_folder)
    cell = standing_at(branch, "127.0.0.97", fraction=FRACTION)
    place = load_skeleton(branch).point_at(FRACTION) + [0.0, 0.0, 0.08]
    finger = {"start_m": (0, 0, 0), "end_m": (0, 0, 0.01), "radius_m": 0.01}
    box = {"kind": "box", "name": "shelf", "size_m": (0.2, 0.2, 0.01), "pose": (
        *map(float, place), 0, 0, 0)}
    near = cell_file(Cell.model_validate(cell.model_dump() | {
        "tool": cell.tool.model_dump() | {"parts": [finger]}, "obstacles": [box]}), tmp_path)
    stated = {"clearance_m": 0.2}
    monkeypatch.setattr(stage, "_stated_by_plan", lambda *_: stated)
    with pytest.raises(NoPathError, match=r"from shelf, nearer than the clearance of 200.0 mm"):
        ExecutePlan(branch_folder=planned_folder, name="path", cell=near).run()
    stated["clearance_m"] = 0.0
    with pytest.raises(pytest.fail.Exception, match="forces were solved"):
        ExecutePlan(branch_folder=planned_folder, name="path", cell=near).run()


@pytest.mark.slow
def test_what_does_not_belong_together_is_refused(planned_folder, tmp_path):
    branch = Branch.open(planned_folder)
    cell = standing_at(branch, "127.0.0.97", fraction=FRACTION)
    for changes, told in (({"branch": "other"}, "calibrated for branch other"),
                          ({"limits": cell.limits.model_copy(update={"soft_force_n": 0.05})},
                           "soft limit")):
        path = cell_file(cell.model_copy(update=changes), tmp_path)
        with pytest.raises(InputError, match=told):
            ExecutePlan(branch_folder=planned_folder, name="path", cell=path).run()
    unweighed = cell.model_copy(update={"tool": cell.tool.model_copy(update={"mass_kg": None})})
    with pytest.raises(InputError, match="payload is not set"):
        ExecutePlan(branch_folder=planned_folder, name="path", cell=cell_file(unweighed, tmp_path),
                    arm=True, confirm="path").run()
    path = cell_file(cell, tmp_path)
    with pytest.raises(InputError, match="Nobody confirmed"):
        ExecutePlan(branch_folder=planned_folder, name="path", cell=path, arm=True).run()


@pytest.mark.parametrize("changes, told", [
    ({"model": "ur10e"}, "made for a ur10e"), ({"branch": "other"}, "cell of branch other"),
    ({"base_pose": (0.602, 0.1, 0, 0, 0, 1.2)}, "2.0 mm and 0.00 degrees"),
    ({"base_pose": (0.6, 0.1, 0, 0, 0, 1.21)}, "0.57 degrees")])
def test_a_plan_for_another_robot_branch_or_base_is_refused(changes, told):
    base = (0.6, 0.1, 0, 0, 0, 1.2)
    cell = Cell(branch="this", robot={"model": "ur5e"}, base={"pose": base})
    made_for = {"model": "ur5e", "branch": "this", "base_pose": base}
    assert check_plan(made_for, cell) is None
    assert "without a cell" in check_plan(None, cell)
    with pytest.raises(InputError, match=told):
        check_plan(made_for | changes, cell)


APPROACH = ApproachEntry(distance_m=0.03)


def cell_before(folder, address, **limits) -> Cell:
    """The gripper stands where the approach begins, and comes as the cell's robot was put."""
    cell = standing_at(Branch.open(folder), address, fraction=FRACTION, back=APPROACH.distance_m,
                       grip_seconds=0.3, soft_force_n=15.0, hard_force_n=20.0, **limits)
    return cell.model_copy(update={"approach": APPROACH})


def motion_settings_at(folder) -> dict:
    skeleton = load_skeleton(Branch.open(folder))
    axis = skeleton.point_at(FRACTION) - skeleton.point_at(FRACTION - 0.05)
    return {"gripper_rotation": tuple(map(float, across(axis)[0])), "speed": 0.05, "hold": 0.2}


@pytest.fixture(scope="module")
def motion_settings(planned_template):
    return motion_settings_at(planned_template)


@pytest.fixture(scope="module")
def start_joints(planned_template, motion_settings, own_address, tmp_path_factory):
    """Where a dry run says that the arm has to stand [rad, 6]."""
    path = cell_file(cell_before(planned_template, own_address), tmp_path_factory.mktemp("dry"))
    dry = ExecutePlan(branch_folder=planned_template, name="path", cell=path,
                      **motion_settings).run()
    return np.array(dry["start_joints_rad"])


@pytest.fixture(scope="module")
def shared_robot(planned_template, own_address, tmp_path_factory):
    cell = cell_before(planned_template, own_address)
    return stepped_robot_holding(Branch.open(planned_template), cell,
                                 tmp_path_factory.mktemp("truth"))


@pytest.fixture
def robot(shared_robot):
    """With the branch before its gripper, in its own time; every test's folder is a copy of that
    branch's.
    """
    with shared_robot.here():
        yield shared_robot


@pytest.fixture
def armed_on(planned_folder, tmp_path, motion_settings, start_joints, monkeypatch):
    """Execute the plan on a robot; the arm stands with its start's joints, or those of ``stands``
    [rad, 6].
    """
    monkeypatch.setattr("limber.stages.paths.execute._TARE_SECONDS", 0.3)

    def run(robot, *, unexpected: float, stands=None):
        path = cell_file(cell_before(planned_folder, robot.address, unexpected_force_n=unexpected),
                         tmp_path)
        restored(robot)
        joints = start_joints if stands is None else stands(start_joints)
        robot.ask("stand", joints=list(map(float, joints)))
        # As it is set on the pendant: it is put back afterwards, and the pose is that tool's.
        robot.ask("tool", offset=list(GRASP_POSE))
        return ExecutePlan(branch_folder=planned_folder, name="path", cell=path, **motion_settings,
                           arm=True, confirm="path").run()
    return run


@pytest.fixture
def armed(armed_on, robot):
    return partial(armed_on, robot)


@pytest.mark.real_time
def test_an_armed_run_feels_what_was_predicted_and_ends_where_it_should(
        planned_folder, planned_template, armed_on, own_address, tmp_path):
    """Approach, hold, follow, return, let go; the force as predicted on another mesh, noise on."""
    pytest.importorskip("rtde_control")
    cell = cell_before(planned_template, own_address)
    with robot_holding(Branch.open(planned_template), cell, tmp_path) as robot:
        result = armed_on(robot, unexpected=3.0)
        time.sleep(0.2)
        state = robot.state
    off = state["extrapolation_error_n"]
    if off > 0.5:
        # On a machine with too much else to do the simulated branch itself is off, and says so.
        pytest.skip(f"the virtual branch was solved too slowly here: its force was {off:.1f} N off")
    assert result["force_within_share"] > 0.95, state
    assert result["predicted_force_sigma_n"] < 1.0
    assert result["reached"] and result["path_error_m"] < 1e-3
    assert state["branch"] == "free" and np.linalg.norm(state["tool_speed"]) < 1e-3
    assert (planned_folder / "executions" / "path" / "samples.csv").stat().st_size > 1e5
    assert np.linalg.norm(np.subtract(state["pose"][:3], result["start_pose_base"][:3])) < 1e-3


@pytest.mark.slow
def test_a_sensor_that_the_nudge_finds_wrong_stops_before_the_path(planned_folder, armed, robot,
                                                                   monkeypatch):
    """The prediction is turned round instead of the sensor: the approach and a nudge, no more."""
    predicted, motions = PullModel.predicted, []

    def turned_round(model: PullModel, trajectory):
        motions.append(trajectory)
        found = predicted(model, trajectory)
        return replace(found, forces=-found.forces)
    monkeypatch.setattr(PullModel, "predicted", turned_round)
    with pytest.raises(SafetyStop, match="implausible: the force points against") as stop:
        armed(unexpected=3.0)
    result = stop.value.result
    assert not result["reached"] and result["path_error_m"] is None
    assert 1e-3 < result["nudge_m"] <= NUDGE_M + 1e-12 and result["nudge_force_n"] <= 0.5 * 15.0
    held = motions[0].poses[0, :3]
    assert np.linalg.norm(robot.state["pose"][:3] - held) < 0.006
    assert np.linalg.norm(robot.state["tool_speed"]) < 1e-3


@pytest.mark.slow
def test_a_force_unlike_the_predicted_one_stops_an_armed_run(planned_folder, armed, monkeypatch):
    """As predicted it is reached; by a model of three times the stiffness: exit 4, a report."""
    assert armed(unexpected=3.0)["reached"]
    predicted = execute_path.predicted_along

    def stiffer(*given):
        found = predicted(*given)
        return replace(found, wrenches=3 * found.wrenches, stiffness=3 * found.stiffness)
    monkeypatch.setattr(execute_path, "predicted_along", stiffer)
    with pytest.raises(SafetyStop, match="predicted were"):
        armed(unexpected=3.0)
    assert not Branch.open(planned_folder).manifest.stages["execute:path"].result["reached"]


def by_another_branch(joints: np.ndarray) -> np.ndarray:
    """The joints as far from these as they can be with the gripper at the same pose."""
    arm = ARMS["ur5e"]
    others = arm.inverse(arm.forward(joints))
    return others[np.argmax(np.abs(others - joints).max(axis=1))]


@pytest.mark.slow
@pytest.mark.parametrize("stands, turned", [
    (by_another_branch, ""),
    (lambda joints: joints + np.r_[np.zeros(5), np.radians(50)], r"turned by 50\.0 degrees.*")])
def test_an_arm_in_another_configuration_does_not_move(planned_folder, armed, start_joints, stands,
                                                       turned):
    """At the start's pose by another branch; at its place, with the wrist turned."""
    stood = stands(start_joints)
    joint = np.abs(stood - start_joints).argmax()
    at, expected = np.degrees([stood[joint], start_joints[joint]])
    told = (rf"{turned}joint {joint + 1} \([a-z0-9 ]+\) is at {at:.1f} degrees instead "
            rf"of {expected:.1f}")
    with pytest.raises(SafetyStop, match=told) as stop:
        armed(unexpected=3.0, stands=stands)
    assert "start_joints_rad" in str(stop.value)
    assert "execute:path" not in Branch.open(planned_folder).manifest.stages
