"""The arm's links as rods: where a URDF of others has its parts, and what stands in their way."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from limber.cell.cell_file import Cell
from limber.cell.obstacles import Box, cell_obstacles
from limber.cell.reach_and_collision import blocked_by
from limber.cell.ur_arms import ARMS
from limber.core.errors import NoPathError
from limber.core.numerics.rigid import matrices
from limber.robot.motion.execution import robot_motion
from limber.robot.motion.trajectory import Predicted


@pytest.mark.parametrize("name", sorted(ARMS))
def test_rods_are_one_chain_from_the_shoulder_to_the_flange(name):
    arm = ARMS[name]
    joints = np.random.default_rng(4).uniform(-np.pi, np.pi, (40, 6))
    rods = arm.rods(joints)
    assert rods.starts[:, 1:] == pytest.approx(rods.ends[:, :-1], abs=1e-12)
    assert rods.starts[:, 0] == pytest.approx(np.tile([0, 0, arm.d[0]], (40, 1)), abs=1e-12)
    flange = arm.forward(joints)
    last = rods.ends[:, -1] + rods.radii[-1] * flange[:, :3, 2]
    assert last == pytest.approx(flange[:, :3, 3], abs=1e-12)
    lengths = np.linalg.norm(rods.ends - rods.starts, axis=2)
    assert lengths == pytest.approx(np.tile(lengths[0], (40, 1)), abs=1e-12)
    assert lengths[0, [1, 3]] == pytest.approx([-arm.a[1], -arm.a[2]])


def test_tubes_lie_where_the_urdf_of_others_has_them(recorded_data):
    """A UR5's upper arm and forearm have their middles where the URDF says."""
    root = ElementTree.parse(recorded_data / "ur5_urdf" / "ur5.urdf").getroot()
    origins = {joint.get("name"): joint.find("origin") for joint in root.findall("joint")}
    middles = {link.get("name"): np.array(link.find("inertial/origin").get("xyz").split(), float)
               for link in root.findall("link") if link.find("inertial/origin") is not None}
    joints = np.random.default_rng(5).uniform(-np.pi, np.pi, 6)
    rods = ARMS["ur5"].rods(joints[None])
    frame = np.eye(4)
    for joint, angle, link, rod in (("shoulder_pan", joints[0], None, None),
                                    ("shoulder_lift", joints[1], "upper_arm_link", 1),
                                    ("elbow", joints[2], "forearm_link", 3)):
        origin = origins[f"{joint}_joint"]
        step = np.eye(4)
        step[:3, 3] = np.array(origin.get("xyz").split(), float)
        step[:3, :3] = (Rotation.from_euler("xyz", np.array(origin.get("rpy").split(), float))
                        * Rotation.from_rotvec([0, 0, angle])).as_matrix()
        frame = frame @ step
        if link is not None:
            there = (frame @ np.r_[middles[link], 1.0])[:3]
            ours = 0.5 * (rods.starts[0, rod] + rods.ends[0, rod])
            assert np.linalg.norm(there - ours) < 1e-3


BASE = (0.55, 0.1, 0.0, 0, 0, 0.4)


def carried(cell: Cell, **asked):
    poses = np.tile(np.r_[0.0, 0.0, 0.45, 0, 0, 0], (5, 1))
    poses[:, 0] = np.linspace(0, 0.05, 5)
    predicted = Predicted.of_forces(poses, np.zeros((5, 3)))
    return robot_motion(cell, predicted, np.array([0, 0, 1.0]), speed=0.03, **asked)


def cell_with(*obstacles: dict) -> Cell:
    return Cell(robot={"model": "ur5e"}, base={"pose": BASE},
                tool={"grasp_pose": (0, 0, 0.15, 0, 0, 0)}, obstacles=obstacles)


def test_a_link_in_a_box_is_named_and_another_way_is_taken(tmp_path):
    """A small box in the forearm of the best way: that way is blocked, another one is not."""
    free = cell_with()
    best = carried(free)
    base = matrices(np.array(BASE))
    rods = free.arm.rods(best.joints.joints)
    middle = base @ np.r_[0.5 * (rods.starts[-1, 3] + rods.ends[-1, 3]), 1.0]
    cell = cell_with({"kind": "box", "name": "lamp", "size_m": (0.02, 0.02, 0.02),
                      "pose": (*map(float, middle[:3]), 0, 0, 0)})
    blocked = blocked_by(cell, cell_obstacles(cell, tmp_path))
    tool = np.linalg.inv(matrices(np.array(cell.tool.grasp_pose)))
    flange = matrices(np.vstack([best.approach.poses, best.path.poses[1:]])) @ tool
    met = blocked(flange, best.joints.joints)
    assert met is not None and "forearm would be inside lamp" in str(met)
    other = carried(cell, blocked=blocked)
    flange = matrices(np.vstack([other.approach.poses, other.path.poses[1:]])) @ tool
    assert blocked(flange, other.joints.joints) is None
    assert other.joints.singularity <= best.joints.singularity
    # That one hangs its elbow below what the arm stands on: told of the table it is not taken.
    table = Box("table", np.array([2.0, 2.0, 0.1]), np.array([0.55, 0.1, -0.1]), np.eye(3))
    both = blocked_by(cell, (*cell_obstacles(cell, tmp_path), table))
    lowest = [cell.arm.rods(motion.joints.joints).ends[..., 2].min()
              for motion in (other, carried(cell, blocked=both))]
    assert lowest[0] < 0.06 < lowest[1]


def test_no_way_past_an_obstacle_is_refused(tmp_path):
    """A wall between base and branch: whichever way the arm turns, it is in it."""
    wall = {"kind": "box", "name": "wall", "size_m": (0.05, 3.0, 3.0),
            "pose": (0.3, 0.0, 0.0, 0, 0, 0)}
    cell = cell_with(wall)
    with pytest.raises(NoPathError, match=r"inside wall, by up to .* blocked as well"):
        carried(cell, blocked=blocked_by(cell, cell_obstacles(cell, tmp_path)))
