"""Plans made in a robot's cell: reach, workspace, obstacles, and cells that do not fit."""

import shutil

import numpy as np
import pytest
from tests.stages.specified import Planned

from limber.cell.cell_file import Cell, write_cell
from limber.cell.known_arms import arm_named
from limber.cell.obstacles import Box
from limber.cell.reach_and_collision import ArmSurroundings, blocked_by, clearance_in
from limber.core.errors import InputError, NoPathError
from limber.core.numerics.rigid import angle_between, pose_vectors
from limber.geometry.tets.tet_mesh import TetMesh
from limber.planning.goals.region import View
from limber.planning.plan_file import read_plan
from limber.planning.settings import PlanSpec
from limber.stages.paths.execute import _stated_by_plan
from limber.stages.paths.execute_path import offsets_along
from limber.stages.paths.plan_cell import KeptClear, cell_positions, hiding
from limber.store import Branch

# No plan made anew because a field of 60 samples is rough.
pytestmark = pytest.mark.usefixtures("rough_plan")
SETTINGS = PlanSpec(iterations=300)


@pytest.fixture
def copied(planned_branch, tmp_path):
    return shutil.copytree(planned_branch, tmp_path / "copy.branch")


def cell_file(folder, **content):
    path = folder.parent / "cell.toml"
    write_cell(path, Cell(**{
        "branch": Branch.open(folder).uuid, "robot": {"model": "ur5e"},
        "base": {"pose": (0.55, 0.1, 0.0, 0, 0, 0.4)},
        "tool": {"grasp_pose": (0, 0, 0.15, 0, 0, 0)},
        # The branch needs 20 N to get anywhere.
        "limits": {"soft_force_n": 40.0, "hard_force_n": 60.0}} | content))
    return path


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_bound")
def test_a_plan_in_a_cell_says_how_the_arm_takes_it(copied):
    """With singularity and joint margins in the file; its force limit holds."""
    Planned.of(SETTINGS, branch_folder=copied, name="reached", cell=cell_file(copied)).run()
    plan = read_plan(copied / "plans/reached.json")
    assert plan.summary["robot"]["model"] == "ur5e"
    assert plan.summary["robot"]["singularity_distance"] > 0.05
    assert plan.summary["limits"]["force_n"]["limit"] == 40.0
    moving = plan.summary["in_motion"]
    assert 0.0 < moving["peaks"]["force_n"]["moving"] <= 40.0
    assert plan.summary["timing"]["speed_m_s"] == moving["speed_m_s"] <= 0.02
    points = np.genfromtxt(copied / "plans/reached-setpoints.csv", delimiter=",", names=True)
    assert plan.summary["setpoint_rate_hz"] == 500.0
    assert np.allclose(np.diff(points["t_s"]), 1 / 500, atol=1e-6)
    assert points["t_s"][-1] == pytest.approx(plan.motion.times[-1], abs=1 / 500)
    assert points["x_m"][-1] == pytest.approx(plan.motion.poses[-1, 0], abs=1e-6)
    legs = {leg["name"]: leg for leg in plan.summary["legs"]}
    assert list(legs) == ["approach", "grasp", "path", "hold", "return", "release", "leaving"]
    assert legs["path"]["peak_force_n"] == pytest.approx(plan.motion.force_sizes.max(), rel=0.01)
    assert legs["approach"]["peak_force_n"] == 0.0 and legs["path"]["self_distance_m"] > 0.0


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_bound")
def test_the_gripper_lags_behind_where_it_may_not_turn_with_the_branch(copied, monkeypatch):
    """Refused without a slack; with one the plan has the rotations and their torque, to second
    order and on the full model; an execution reads them."""
    there = read_plan(copied / "plans/there.json")
    turn = angle_between(there.plan.poses[-1, 3:], np.zeros(3))

    def blocked(flange, _joints):
        turned_by = angle_between(*pose_vectors(flange[[0, -1]])[:, 3:])
        return NoPathError("Turned too far.", "", "") if turned_by > 0.7 * turn else None
    monkeypatch.setattr("limber.cell.reach_and_collision.blocked_by", lambda *_: blocked)
    settings = SETTINGS.model_copy(update={
        "iterations": 100, "inertia": False, "goal": tuple(map(float, there.plan.poses[-1, :3]))})
    path = cell_file(copied)
    with pytest.raises(NoPathError, match="Turned too far"):
        Planned.of(settings, branch_folder=copied, name="stiff", cell=path).run()
    Planned.of(settings.model_copy(update={"turn_slack": turn}), branch_folder=copied,
                 name="lagging", cell=path).run()
    summary = read_plan(copied / "plans/lagging.json").summary
    turning, legs = summary["turning"], {leg["name"]: leg for leg in summary["legs"]}
    assert 0.2 * turn < turning["largest_rad"] < 0.6 * turn
    whole = turning["full_model"]
    assert 0.0 < whole["torque_error_nm"] < 0.4 * whole["peak_torque_nm"]  # a large rotation
    assert legs["path"]["peak_torque_nm"] == pytest.approx(turning["peak_torque_nm"], rel=0.2)
    told = _stated_by_plan(Branch.open(copied), "lagging")["turning"]
    ahead = there.motion.poses[np.array(there.motion.phases) != "return", :3]
    assert np.linalg.norm(offsets_along(told, ahead)[-1]) == pytest.approx(
        turning["largest_rad"], rel=1e-3)


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_bound")
def test_a_cell_that_allows_too_little_force_is_named(copied, monkeypatch):
    """The cell's force limit, not a vague word: the goal alone needs more."""
    monkeypatch.setattr("limber.planning.make_plan._REPLANS", 0)
    weak = cell_file(copied, limits={"soft_force_n": 0.1, "hard_force_n": 20.0})
    with pytest.raises(NoPathError, match="force"):
        Planned.of(SETTINGS, branch_folder=copied, name="weak", cell=weak).run()


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_bound")
def test_a_robot_too_far_away_refuses_the_plan(copied):
    far = cell_file(copied, base={"pose": (3.0, 0.1, 0.0, 0, 0, 0.4)})
    with pytest.raises(NoPathError, match="reach") as refused:
        Planned.of(SETTINGS, branch_folder=copied, name="far", cell=far).run()
    assert refused.value.exit_code == 3 and not (copied / "plans/far.json").exists()


def test_a_branch_that_meets_an_obstacle_refuses_the_plan(copied):
    """A box where the path leads; the message names it and the place."""
    path = read_plan(copied / "plans/there.json").plan.poses[:, :3]
    blocked = cell_file(copied, obstacles=({
        "kind": "box", "name": "the post", "size_m": (0.02, 0.02, 0.02),
        "pose": (*map(float, path[-1]), 0, 0, 0)},))
    goal = tuple(map(float, path[-1]))
    with pytest.raises(NoPathError, match=r"goal .* mm inside the post"):
        Planned(branch_folder=copied, iterations=300, goal=goal, name="hit", cell=blocked).run()


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_bound")
def test_a_branch_is_led_around_an_obstacle(copied):
    """A post where the free way takes the tip: planned anew, the motion keeps clear of it; one that
    the branch leans on where it hangs refuses every plan."""
    there = read_plan(copied / "plans/there.json")
    tip = there.motion.tips[len(there.motion.tips) // 4]
    ends = {"start": tuple(map(float, there.plan.poses[0, :3])),
            "goal": tuple(map(float, there.plan.poses[-1, :3]))}

    def post(place):
        return cell_file(copied, obstacles=({
            "kind": "box", "name": "the post", "size_m": (0.01, 0.01, 0.01),
            "pose": (*map(float, place), 0, 0, 0)},))

    # In motion: test_motion_check.
    Planned.of(SETTINGS.model_copy(update={"iterations": 100, "inertia": False, **ends}),
                 branch_folder=copied, name="around", cell=post(tip)).run()
    assert np.linalg.norm(read_plan(copied / "plans/around.json").motion.tips - tip,
                          axis=1).min() > 0.01
    with pytest.raises(NoPathError, match="at its rest pose"):
        Planned.of(SETTINGS, branch_folder=copied, name="leaning",
                     cell=post(there.motion.tips[0])).run()


def test_a_second_arm_reaches_as_far_as_it_can():
    """Its region is a ball about its shoulder that holds all that it takes, with its tool; within
    it inverse kinematics decides."""
    entry = {"model": "ur3e", "base_pose": (1.0, 0, 0, 0, 0, 0)}
    place, held = (cell_positions(Cell(robot={"model": "ur5e"}, base={"pose": (0, 0, 0, 0, 0, 0)},
                                       second_arm=entry | tool))["second_arm"]
                   for tool in ({}, {"grasp_pose": (0, 0, 0.1, 0, 0, 0)}))
    region = held.region
    assert region.middle == pytest.approx([1.0, 0.0, 0.15185])
    joints = np.random.default_rng(0).uniform(-np.pi, np.pi, (20_000, 6))
    flange = arm_named("ur3e").forward(joints)
    taken = flange[:, :3, 3] + 0.1 * flange[:, :3, 2] + [1.0, 0.0, 0.0]
    away = np.linalg.norm(taken - region.middle, axis=1)
    assert 0.75 * region.radius < away.max() <= region.radius
    place.require("the tip", np.array([1.0, 0.3, 0.3]), None)
    with pytest.raises(NoPathError, match="second arm"):
        place.require("the tip", np.array([1.0, 0.9, 0.3]), None)
    with pytest.raises(NoPathError, match="directions"):
        place.require("the tip", np.array([1.0, 0.0, 0.15]), None)


def test_a_tip_is_hidden_by_other_wood_but_its_own(small_mesh, small_skeleton):
    """The tip is on the axis, a radius inside the surface: a camera beside it sees it, one that
    looks along the branch from its foot does not, nor one behind a board."""
    surface = small_mesh.nodes[small_mesh.surface_faces()]
    tip = small_skeleton.nodes[-1]
    for place, obstacles, hides in (
            (tip + [0.0, -0.5, 0.0], (), ""), (np.array([-0.02, 0.0, -0.4]), (), "the branch"),
            (tip + [0.0, -0.5, 0.0], (Box("the board", np.array([0.1, 0.01, 0.1]),
                                          tip + [0.0, -0.2, 0.0], np.eye(3)),), "the board")):
        frame = np.eye(4)
        frame[:3, 3] = place
        view = View(frame, (-1.0, 1.0, -1.0, 1.0), (0.1, 2.0))
        assert hiding(view, obstacles, tip, surface) == (hides and f"{hides} hides it")


def test_an_obstacles_kind_follows_from_its_entries():
    """Without one, a file is a mesh's, and any other a box's."""
    common = {"robot": {"model": "ur5e"}, "base": {"pose": (0.5,) + (0.0,) * 5}}
    cell = Cell(**common, obstacles=[{"size_m": (0.1, 0.1, 0.1), "pose": (0, 0, 0.9, 0, 0, 0)},
                                     {"file": "post.stl"}])
    assert [one.kind for one in cell.obstacles] == ["box", "mesh"]


def test_the_distance_that_is_reported_is_no_less_than_the_clearance_kept():
    """Of the arm from an obstacle, to the half spacing of the points along its links."""
    cell = Cell(robot={"model": "ur5e"}, base={"pose": (0.0,) * 6})
    rods, joints = cell.arm.rods(np.array(cell.arm.home)[None]), np.array(cell.arm.home)[None]
    along = np.linspace(rods.starts[0], rods.ends[0], 2000)
    centre = along[1000, 2] + [0.0, 0.0, 0.3]
    box = Box("the post", np.full(3, 0.02), centre, np.eye(3))
    true = min(float((box.clearance(along[:, k]) - rods.radii[k]).min())
               for k in range(len(rods.radii)))
    assert not cell.tool.parts
    found = ArmSurroundings(cell, (box,), None).least_distances(joints)["obstacle_distance_m"]
    assert true - 0.0026 <= found <= true


def test_the_clearance_is_what_the_base_leaves_uncertain():
    """Twice the deviation at the grasp, no more than the branch has at rest, or what is asked; the
    arm and the gripper keep it too."""
    cell = Cell(robot={"model": "ur5e", "pose_sigma_m": 0.0}, base={
        "pose": (1.0, 0, 0, 0, 0, 0), "position_sigma_m": 0.003, "rotation_sigma_rad": 0.004})
    grasp, nodes = np.zeros(3), np.zeros((1, 3))
    far, near = (Box("a post", np.full(3, 0.01), np.array([away, 0, 0]), np.eye(3))
                 for away in (0.21, 0.014))
    assert clearance_in(cell, None, (far,), grasp, nodes) == pytest.approx(0.01)
    assert clearance_in(cell, None, (far, near), grasp, nodes) == pytest.approx(0.0036)
    assert clearance_in(cell, 0.05, (near,), grasp, nodes) == 0.05
    assert clearance_in(cell, None, (), grasp, nodes) == 0.0
    joints = np.array(cell.arm.home, float)[None]
    elbow = cell.arm.rods(joints).ends[0, 0] + [1.0, 0.0, 0.0]
    post = Box("a post", np.full(3, 0.01), elbow + [0.3, 0.0, 0.0], np.eye(3))
    flange = cell.arm.forward(joints)
    assert blocked_by(cell, (post,))(flange, joints) is None
    refused = blocked_by(cell, (post,), 0.25)(flange, joints)
    assert "from a post, nearer than the clearance of 250.0 mm" in refused.seen


def test_an_executed_branch_keeps_the_plans_clearance():
    """Not nearer than planned, but for what a clamped piece moves; never inside; and it is stated.
    """
    post = Box("a post", np.full(3, 0.01), np.zeros(3), np.eye(3))
    corners = np.vstack([np.zeros(3), 0.1 * np.eye(3)])
    mesh, clear = TetMesh(corners, np.array([[0, 1, 2, 3]])), KeptClear((post,), 0.02)
    clear.require(np.zeros(3), mesh, np.tile([0.0295, 0.0, 0.0], (4, 1)))
    assert clear.describe() == {"clearance_m": 0.02, "branch_clearance_m": pytest.approx(0.0195)}
    assert np.allclose(clear.surfaces, corners + [0.0295, 0.0, 0.0])
    with pytest.raises(NoPathError, match=r"15.0 mm from a post, .* clearance of 20.0 mm"):
        clear.require(np.zeros(3), mesh, np.tile([0.025, 0.0, 0.0], (4, 1)))
    with pytest.raises(NoPathError, match=r"5.0 mm inside a post"):
        KeptClear((post,), 0.0).require(np.zeros(3), mesh, np.tile([0.005, 0.0, 0.0], (4, 1)))
    assert KeptClear((), 0.0).describe()["branch_clearance_m"] is None


def test_a_workspace_is_kept_and_one_without_the_goal_refused(copied):
    path = read_plan(copied / "plans/there.json").plan.poses[:, :3]
    goal = tuple(map(float, path[-1]))
    small = cell_file(copied, workspace={"low_m": (-1, -1, path[-1, 2] + 0.05),
                                         "high_m": (1, 1, 2)})
    with pytest.raises((NoPathError, InputError), match="workspace"):
        Planned(branch_folder=copied, goal=goal, name="outside", cell=small).run()


def test_cells_that_do_not_fit_are_refused(copied):
    """Of another branch; an obstacle with a hole; one in millimetres."""
    with pytest.raises(InputError, match="calibrated for branch"):
        Planned.of(SETTINGS, branch_folder=copied, cell=cell_file(copied, branch="another")).run()
    vertices = 5.0 * np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]], float)
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    for name, kept, words in (("holed", 3, "hole|open|edge"), ("large", 4, "unit")):
        lines = [f"v {x} {y} {z}" for x, y, z in vertices]
        lines += ["f " + " ".join(str(k + 1) for k in face) for face in faces[:kept]]
        (copied.parent / f"{name}.obj").write_text("\n".join(lines) + "\n")
        cell = cell_file(copied, obstacles=({"kind": "mesh", "file": f"{name}.obj"},))
        with pytest.raises(InputError, match=words):
            Planned.of(SETTINGS, branch_folder=copied, cell=cell).run()
