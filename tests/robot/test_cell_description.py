"""The URDF of a cell: read back by an independent reader, it is the same arm in the same place."""

from xml.etree import ElementTree

import numpy as np
import pytest

from limber.cell.cell_file import Cell
from limber.cell.ur_arms import ARMS
from limber.cell.urdf_arm import arm_of_file
from limber.core.numerics.rigid import matrices
from limber.robot.ros.cell_description import cell_srdf, cell_urdf, joint_names


def cell_of(model: str) -> Cell:
    return Cell(
        robot={"model": model}, base={"pose": (0.55, 0.1, 0.2, 0.1, -0.2, 1.2)},
        tool={"grasp_pose": (0.01, 0, 0.15, 0, 0.3, 0),
              "parts": [{"start_m": (0, 0, 0), "end_m": (0, 0, 0.12), "radius_m": 0.04}]},
        camera={"pose": (0, -0.9, 0.5, -1.57, 0, 0)},
        obstacles=[{"kind": "box", "name": "table", "size_m": (1.6, 1.2, 0.04),
                    "pose": (0.3, 0, -0.03, 0, 0, 0.4)},
                   {"kind": "mesh", "file": "pot.stl", "unit": "mm"}])


@pytest.mark.parametrize("model", ARMS)
def test_the_described_arm_moves_as_the_cells_does(model, tmp_path):
    """Frames at random angles, limits, speeds, and rods where the cell's arm has its own."""
    cell = cell_of(model)
    (tmp_path / "cell.urdf").write_text(cell_urdf(cell))
    arm = arm_of_file(str(tmp_path / "cell.urdf"))
    joints = np.random.default_rng(2).uniform(-3, 3, (20, 6))
    assert arm.forward(joints) == pytest.approx(cell.arm.forward(joints), abs=1e-9)
    assert arm.joint_limits == pytest.approx(cell.arm.joint_limits)
    assert arm.joint_speed == pytest.approx(np.array(cell.arm.joint_speed))
    assert list(arm.joint_names) == joint_names(cell)
    own, described = (np.column_stack([rods.starts[0] + rods.ends[0], rods.radii, np.abs(
        rods.starts[0] - rods.ends[0])])
                      for rods in (one.rods(joints[:1]) for one in (cell.arm, arm)))
    assert np.abs(own[:, None] - described).max(axis=2).min(axis=1).max() < 1e-6


def test_joints_of_a_urdf_file_keep_their_names_and_a_prefix_comes_before(tmp_path):
    """Else a node that publishes TF would not find them in the joint states."""
    path = tmp_path / "arm.urdf"
    path.write_text(cell_urdf(cell_of("ur5e")).replace("shoulder_pan_joint", "j1"))
    assert joint_names(cell_of(str(path)))[:3] == ["j1", "shoulder_lift_joint", "elbow_joint"]
    two = cell_of("ur5e").model_dump() | {"robot": {"model": "ur5e", "ros": {"prefix": "a_"}}}
    assert '"a_elbow_joint"' in cell_urdf(Cell(**two))


def test_base_gripper_camera_and_obstacles_are_in_the_branchs_frame():
    cell = cell_of("ur5e")
    root = ElementTree.fromstring(cell_urdf(cell))
    fixed = {joint.find("child").get("link"): joint for joint in root.findall("joint")}
    for child, parent, pose in (("base", "branch", cell.base.pose),
                                ("grasp", "tool0", cell.tool.grasp_pose),
                                ("camera_optical_frame", "branch", cell.camera.pose),
                                ("obstacle_1", "branch", cell.obstacles[0].pose)):
        joint = fixed[child]
        assert joint.find("parent").get("link") == parent and joint.get("type") == "fixed"
        xyz = np.array(joint.find("origin").get("xyz").split(), float)
        assert xyz == pytest.approx(matrices(np.array(pose))[:3, 3])
    links = {link.get("name"): link for link in root.findall("link")}
    assert set(fixed) | {"branch"} == set(links)
    mesh = links["obstacle_2"].find("collision/geometry/mesh")
    assert mesh.get("filename") == "pot.stl" and mesh.get("scale") == "0.001 0.001 0.001"
    assert links["tool0"].findall("collision/geometry/cylinder")[0].get("length") == "0.12"


def test_the_group_has_the_arms_joints_at_home():
    cell = cell_of("ur5e")
    root = ElementTree.fromstring(cell_srdf(cell))
    assert root.find("group/chain").attrib == {"base_link": "base", "tip_link": "grasp"}
    told = {joint.get("name"): float(joint.get("value")) for joint in root.find("group_state")}
    assert list(told) == joint_names(cell)
    assert list(told.values()) == pytest.approx(cell.arm.home)
    pairs = [(each.get("link1"), each.get("link2")) for each in root.findall("disable_collisions")]
    assert ("base", "shoulder_pan_link") in pairs and ("tool0", "grasp") in pairs
