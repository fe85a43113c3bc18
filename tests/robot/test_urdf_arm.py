"""Arms of URDF files: a UR5's against its analytic kinematics, one of seven joints, bad files."""

import re
import shutil

import numpy as np
import pytest
from tests.robot.conftest import Registers, dry_run

from benchmarks.robot_cells import standing_at
from benchmarks.robot_faults import cell_for, straight, tared
from benchmarks.robot_stepped import SteppedRobot
from limber.cell.cell_file import Cell, read_cell, write_cell
from limber.cell.known_arms import arm_named
from limber.cell.ur_arms import ARMS
from limber.core.errors import InputError, NoPathError
from limber.core.numerics.rigid import matrices, pose_vectors
from limber.robot.driver.controls import control_of
from limber.robot.driver.link import RobotLink
from limber.robot.motion.joint_path import follow, joint_path
from limber.robot.motion.trajectory import densely
from limber.robot.ros.cell_description import joint_names
from limber.robot.ros.messages import JointStates
from limber.robot.virtual.controller import Controller
from limber.store import Branch

UR5 = ARMS["ur5"]


@pytest.fixture(scope="module")
def ur5_file(recorded_data):
    return recorded_data / "ur5_urdf" / "ur5.urdf"


@pytest.fixture(scope="module")
def arm(ur5_file):
    return arm_named(str(ur5_file))


def random_joints(count: int, seed: int = 5) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (count, 6))


def turns_apart(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.abs((first - second + np.pi) % (2 * np.pi) - np.pi).max(axis=-1)


def test_a_ur5s_file_has_the_analytic_kinematics(arm):
    """Base and flange are the controller's: the file's own rounding is left, below 1e-9."""
    joints = random_joints(500)
    assert np.abs(arm.forward(joints) - UR5.forward(joints)).max() < 1e-9
    assert np.abs(arm.jacobian(joints) - UR5.jacobian(joints)).max() < 1e-9
    assert arm.shoulder == pytest.approx(UR5.shoulder)
    assert UR5.reach < arm.reach < 1.2 * UR5.reach
    assert arm.joint_speed == pytest.approx(UR5.joint_speed)
    assert arm.joint_limits[[0, 1, 3, 4, 5]] == pytest.approx(UR5.joint_limits[[0, 1, 3, 4, 5]])
    assert arm.joint_limits[2] == pytest.approx([-np.pi, np.pi])


@pytest.mark.parametrize("tip", ["", "#left_tool0"])
def test_an_arm_with_a_prefix_is_the_same_arm(arm, ur5_file, tmp_path, tip):
    """Base and flange are found by their usual names; joints that have the prefix get no second."""
    path = tmp_path / "left.urdf"
    path.write_text(re.sub(r'((?:name|link)=")(?!world)', r"\1left_", ur5_file.read_text("utf-8")),
                    encoding="utf-8")
    left = arm_named(f"{path}{tip}")
    assert np.abs(left.forward(random_joints(20)) - arm.forward(random_joints(20))).max() < 1e-12
    cell = cell_for("127.0.0.1", f"{path}{tip}")
    cell = cell.model_copy(update={"robot": cell.robot.model_copy(update={
        "ros": {"prefix": "left_"}})})
    assert joint_names(cell) == list(left.joint_names) == JointStates(cell, "left_").wanted


@pytest.mark.slow
def test_its_configurations_are_the_analytic_ones(arm):
    """Each that is found is one of the eight, and of a hundred poses few miss any."""
    frames = UR5.forward(random_joints(100))
    found, analytic = arm.inverse(frames), UR5.inverse(frames)
    exist = np.isfinite(found).all(axis=-1)
    assert np.abs(arm.forward(np.nan_to_num(found)) - frames[:, None])[exist].max() < 1e-9
    for ours, theirs in zip(found, analytic, strict=True):
        for joints in ours[np.isfinite(ours).all(axis=1)]:
            assert np.nanmin(turns_apart(theirs, joints)) < 1e-5
    assert exist.sum() > 0.95 * np.isfinite(analytic).all(axis=-1).sum()


def test_the_nearest_configuration_is_found_from_near(arm):
    joints = random_joints(50)
    frames = arm.forward(joints)
    found = arm.inverse(frames, joints + 0.02)
    assert np.nanmin(np.abs(found - joints[:, None]).max(axis=-1), axis=1).max() < 1e-4
    assert np.isnan(arm.inverse(frames[0] + 5.0 * np.eye(4)[:, [3, 3, 3, 0]])).all()


def test_paths_are_those_of_the_analytic_kinematics(arm):
    start = pose_vectors(UR5.forward(np.array(UR5.home)))
    frames = matrices(densely(np.array([start, start + [0.1, 0.05, 0, 0, 0.1, 0]])))
    paths, _refused = follow(arm, frames)
    others, _refused = follow(UR5, frames)
    assert len(paths) == len(others) == 8
    for path in paths:
        off = [turns_apart(path.joints, other.joints).max() for other in others]
        assert min(off) < 1e-8
    away = frames.copy()
    away[5:, 2, 3] += 2.0
    with pytest.raises(NoPathError, match="ends at pose 6 of"):
        joint_path(arm, away)


def test_singular_poses_are_near_to_a_singularity(arm):
    """Stretched, or with the wrist's axes in line; the best pose is 1."""
    stretched, in_line = np.array(UR5.home), np.array(UR5.home)
    stretched[2], in_line[4] = 0.0, 0.0
    assert arm.singularity_distance(np.array([stretched, in_line])).max() < 1e-6
    assert arm.singularity_distance(arm.home) == pytest.approx([1.0])
    assert arm.singularity_distance(np.array(UR5.home))[0] > 0.2


def test_its_links_go_from_joint_to_joint(arm):
    """The file has meshes alone: upper arm and forearm are as long as the table says."""
    rods = arm.rods(random_joints(20))
    lengths = np.linalg.norm(rods.ends - rods.starts, axis=-1)
    assert lengths[:, 0] == pytest.approx(-UR5.a[1])
    assert lengths[:, 1] == pytest.approx(np.hypot(UR5.a[2], UR5.d[3]))
    assert rods.names[0] == "link behind shoulder_lift_joint" and (rods.radii > 0.055).all()


# Seven joints

_SHAPES = {1: '<cylinder radius="0.06" length="0.3"/>', 3: '<box size="0.05 0.3 0.04"/>',
           5: '<sphere radius="0.05"/>'}


def urdf(count: int, *, kind: str = "revolute", limit: str = 'velocity="2.0"',
         end: str = "tool0") -> str:
    """An arm whose joints turn about z and y by turns, a link of 0.2 m up after each."""
    links, joints = ['<link name="foot"/>'], []
    for number in range(count):
        shape = _SHAPES.get(number)
        body = "" if shape is None else (
            f'<collision><origin xyz="0 0 0.1"/><geometry>{shape}</geometry></collision>')
        axis = "0 1 0" if number % 2 else "0 0 2"
        links.append(f'<link name="link{number}">{body}</link>')
        joints.append(f'<joint name="j{number}" type="{kind}"><origin xyz="0 0 0.2"/>'
                      f'<parent link="{f"link{number - 1}" if number else "foot"}"/>'
                      f'<child link="link{number}"/><axis xyz="{axis}"/>'
                      f'<limit lower="-2.9" upper="2.8" {limit}/></joint>')
    joints.append(f'<joint name="end" type="fixed"><origin xyz="0 0 0.1"/>'
                  f'<parent link="link{count - 1}"/><child link="{end}"/></joint>')
    return f'<robot name="r">{"".join(links)}<link name="{end}"/>{"".join(joints)}</robot>'


@pytest.fixture
def seven(tmp_path):
    (tmp_path / "seven.urdf").write_text(urdf(7), encoding="utf-8")
    return arm_named(str(tmp_path / "seven.urdf"))


def test_seven_joints_are_planned_with(seven):
    joints = np.array([0.3, 0.6, -0.2, 1.1, 0.4, 0.7, 0.1])
    start = pose_vectors(seven.forward(joints))
    frames = matrices(densely(np.array([start, start + [0.05, 0.08, -0.03, 0, 0, 0.1]])))
    path = joint_path(seven, frames)
    assert path.joints.shape == (len(frames), 7) and path.limit_margin > 0.05
    assert np.abs(seven.forward(path.joints) - frames).max() < 1e-9
    assert np.abs(np.diff(path.joints, axis=0)).max() < 0.1
    slopes = np.column_stack([(seven.forward(joints + 1e-6 * unit) - seven.forward(joints))[:3, 3] /
                              1e-6 for unit in np.eye(7)])
    assert seven.jacobian(joints)[:3] == pytest.approx(slopes, abs=1e-5)


def test_simple_shapes_are_its_rods(seven):
    """A cylinder as it is, a box within a rod along its longest edge, a sphere, lines between."""
    rods = seven.rods(np.zeros((1, 7)))
    found = dict(zip(rods.names, zip(rods.starts[0], rods.ends[0], rods.radii, strict=True),
                     strict=True))
    assert set(found) == {"link1", "link3", "link5", "link behind j2", "link behind j4",
                          "link behind j6"}
    start, end, radius = found["link1"]
    assert np.r_[start, end] == pytest.approx([0, 0, 0.35, 0, 0, 0.65]) and radius == 0.06
    start, end, radius = found["link3"]
    assert np.r_[start, end] == pytest.approx([0, -0.15, 0.9, 0, 0.15, 0.9])
    assert radius == pytest.approx(0.5 * np.hypot(0.05, 0.04))
    assert found["link5"][2] == 0.05 and found["link5"][0] == pytest.approx([0, 0, 1.3])


def test_seven_joints_are_refused_where_six_are_needed(seven):
    cell = Cell(robot={"model": seven.name, "joint_limits_rad": [(-1, 1)] * 7},
                base={"pose": (0,) * 6})
    assert cell.joint_limits == pytest.approx(np.tile([-1.0, 1.0], (7, 1)))
    with pytest.raises(InputError, match=r"has 7 joints.*recordings of a motion hold exactly 6"):
        control_of(cell)
    with pytest.raises(InputError, match="six-joint arm"):
        Controller(seven.name)


# Files

@pytest.mark.parametrize("text, told", [
    ("<robot", "does not describe a supported arm: "),
    ('<!DOCTYPE robot [<!ENTITY a "aaaa">]>' + urdf(6), "declares a document type"),
    ("<sdf/>", "its root is <sdf>, not <robot>"),
    (urdf(5), "has only 5 revolute joints between base and flange"),
    (urdf(6, kind="prismatic"), "joint 'j0' has type 'prismatic'"),
    (urdf(6, limit=""), "joint 'j0' states no velocity limit"),
    (urdf(6, limit='velocity="fast"'), "could not convert string to float"),
    (urdf(6).replace('<parent link="foot"/>', '<parent link="link3"/>'), "form a loop"),
    (urdf(6).replace('<link name="foot"/>', ""), "refers to the link 'foot', which does not exist"),
    (urdf(6).replace('xyz="0 0 0.2"', 'xyz="0 0 nan"'), "not a list of three finite numbers"),
    (urdf(6).replace('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>'),
     "the axis of its joint 'j1' is zero"),
    (urdf(6).replace('lower="-2.9"', 'lower="2.9"'), "is not below the upper limit"),
    (urdf(6).replace("<child", "<kid"), "has no <child>"),
])
def test_a_file_that_is_no_arm_is_refused(tmp_path, text, told):
    text = text.replace("</child", "</kid") if "<kid" in text else text
    (tmp_path / "bad.urdf").write_text(text, encoding="utf-8")
    (tmp_path / "cell.toml").write_text(
        '[robot]\nmodel = "bad.urdf"\n[base]\npose = [0, 0, 0, 0, 0, 0]\n', encoding="utf-8")
    with pytest.raises(InputError, match=f"robot.model.*{told}"):
        read_cell(tmp_path / "cell.toml")


def test_the_only_long_chain_ends_at_the_flange(tmp_path):
    path = tmp_path / "hand.urdf"
    path.write_text(urdf(6, end="hand"), encoding="utf-8")
    assert len(arm_named(str(path)).joint_names) == 6
    path.write_text(urdf(6, end="hand").replace("</robot>", (
        '<link name="cup"/><joint name="c" type="fixed"><parent link="link5"/><child link="cup"/>'
        "</joint></robot>")), encoding="utf-8")
    heights = [arm_named(f"{path}{tip}").forward(np.zeros(6))[2, 3]
               for tip in ("", "#hand", "#cup")]
    assert heights == pytest.approx([1.3, 1.3, 1.2])
    with pytest.raises(InputError, match="the link 'lid', which does not exist"):
        arm_named(f"{path}#lid")


def test_an_arms_file_lies_beside_the_cell_and_moves_with_it(tmp_path, ur5_file):
    (tmp_path / "here").mkdir()
    shutil.copy(ur5_file, tmp_path / "here" / "arm.urdf")
    path = tmp_path / "here" / "cell.toml"
    path.write_text('[robot]\nmodel = "arm.urdf"\n[base]\npose = [0, 0, 0, 0, 0, 0]\n',
                    encoding="utf-8")
    cell = read_cell(path)
    assert cell.arm.forward(random_joints(1)) == pytest.approx(UR5.forward(random_joints(1)))
    write_cell(path, cell)
    (tmp_path / "here").rename(tmp_path / "there")
    assert read_cell(tmp_path / "there" / "cell.toml").robot.model == str(
        tmp_path / "there" / "arm.urdf")


def test_a_missing_file_is_said(tmp_path):
    with pytest.raises(InputError, match=r"none.urdf cannot be read"):
        arm_named(str(tmp_path / "none.urdf"))


# Motion

@pytest.mark.slow
def test_a_plan_is_checked_for_it_and_its_dry_run_written(planned_folder, tmp_path, arm):
    cell = standing_at(Branch.open(planned_folder), "127.0.0.97", model=arm.name)
    assert dry_run(planned_folder, cell, tmp_path)["predicted_peak_force_n"] > 0.1


def test_the_virtual_controller_moves_it_as_a_ur5(ur5_file):
    """The same line, from the same pose, in the same joints."""
    joints = np.array(UR5.home)
    ends = []
    for model in (str(ur5_file), "ur5"):
        registers = Registers(Controller(model, joints=joints, seed=3))
        target = registers.controller.pose + [0.05, 0.03, -0.02, 0, 0.1, 0]
        registers.line(target)
        assert matrices(registers.controller.pose) == pytest.approx(matrices(target), abs=1e-6)
        ends.append(registers.controller.joints)
    assert ends[0] == pytest.approx(ends[1], abs=1e-7)


def test_an_address_elsewhere_is_refused(ur5_file):
    cell = Cell(robot={"model": str(ur5_file), "address": "192.0.2.7"}, base={"pose": (0,) * 6})
    with pytest.raises(InputError, match="has no driver for the controller"):
        control_of(cell)


def test_the_driver_moves_it_on_the_virtual_robot(ur5_file):
    """Tare, a line under the guard, and a stop, as with any arm."""
    model = str(ur5_file)
    robot = SteppedRobot(Controller(model))
    with robot.here(), RobotLink(cell_for(robot.address, model)) as link:
        tared(link)
        event = link.follow(straight(robot, (0.0, 0.0, -0.03)))
        assert event["event"] == "reached" and event["error_m"] < 1e-3
        link.start(straight(robot, (0.0, 0.0, 0.1)))
        link.stop()
        assert "a stop was requested" in link.wait("stopped", seconds=5)["reason"]
