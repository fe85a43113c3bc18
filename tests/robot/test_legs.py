"""The legs of a whole motion: their order, times, loads and distances."""

import numpy as np
import pytest

from limber.cell.cell_file import Cell
from limber.cell.obstacles import Box
from limber.core.progress import Progress
from limber.planning.plan_file import PlanPath
from limber.robot.motion.execution import described, legs_of, robot_motion
from limber.robot.motion.trajectory import Predicted
from limber.stages.paths.plan_cell import legs_in_cell, legs_without_cell

CELL = Cell(robot={"model": "ur5e"}, base={"pose": (0.55, 0.1, 0.0, 0, 0, 0.4)},
            tool={"grasp_pose": (0, 0, 0.15, 0, 0, 0), "grip_seconds": 0.5},
            limits={"contact_n_per_m": 1000.0})
ALONG = np.array([0.0, 0.0, 0.5]) + np.linspace(0, 1, 12)[:, None] * [0.08, 0.03, -0.02]


@pytest.fixture(scope="module")
def motion():
    share = np.linspace(0, 1, 12)[:, None]
    predicted = Predicted.of_forces(np.hstack([ALONG, 0 * ALONG]), share * [4.0, 0, 3.0],
                                    share * [0.0, 0.2, 0.0])
    return robot_motion(CELL, predicted, np.array([0, 0, 1.0]), speed=0.03,
                        rotation=np.array([0.0, -np.pi / 2, 0.0]))


def test_legs_follow_each_other_and_carry_their_loads(motion):
    """Held at the path's end the branch pushes as there; an empty gripper feels nothing."""
    rows = described(legs_of(CELL, motion, 3.0), CELL)
    assert [row["name"] for row in rows] == ["approach", "grasp", "path", "hold", "return",
                                             "release", "leaving"]
    ends = [row["start_s"] + row["duration_s"] for row in rows]
    assert [row["start_s"] for row in rows[1:]] == pytest.approx(ends[:-1])
    assert [row["peak_force_n"] for row in rows] == pytest.approx([0, 0, 5, 5, 5, 0, 0])
    assert rows[3]["peak_torque_nm"] == pytest.approx(0.2) and rows[3]["duration_s"] == 3.0
    assert rows[2]["length_m"] == pytest.approx(np.linalg.norm(ALONG[-1] - ALONG[0]))
    assert rows[2]["peak_speed_m_s"] == pytest.approx(0.03, rel=0.02)
    assert rows[0]["length_m"] == pytest.approx(CELL.approach.distance_m)


def test_each_leg_is_checked_for_collisions(motion):
    """Of a branch that moves with the gripper where it is then; a link in it is warned of."""
    told, elbow = [], CELL.arm.rods(motion.path.joints[-1:]).ends[0, 1]
    base = np.array([np.cos(0.4), np.sin(0.4)])
    elbow = np.array([0.55 + base[0] * elbow[0] - base[1] * elbow[1],
                      0.1 + base[1] * elbow[0] + base[0] * elbow[1], elbow[2]])
    surfaces = np.tile([[[0.0, 0.0, 3.0]]], (len(ALONG), 1, 1))
    surfaces[-1] = elbow
    far = Box("a post", np.full(3, 0.01), np.array([3.0, 0, 0]), np.eye(3))
    rows = {row["name"]: row for row in legs_in_cell(
        CELL, (far,), motion, ALONG, surfaces, 2.0, Progress(on_warning=told.append))}
    assert rows["approach"]["branch_distance_m"] > 1.0 > 0.0 > rows["path"]["branch_distance_m"]
    assert rows["return"]["branch_distance_m"] == pytest.approx(rows["path"]["branch_distance_m"],
                                                                abs=0.02)
    assert 1.0 < rows["path"]["obstacle_distance_m"] < 4.0
    assert rows["grasp"]["obstacle_distance_m"] is None
    assert len(told) == 2 and "inside the branch" in told[0]


def test_a_plan_without_a_robot_has_the_legs_of_the_branch():
    count = np.arange(5.0)
    motion = PlanPath(np.column_stack([0.01 * np.array([0, 1, 2, 1, 0]), *np.zeros((5, 5))]), count,
                      count, np.outer([0.0, 1, 3, 1, 0], [0.0, 0, 1]), torques=np.zeros((5, 3)),
                      times=np.array([0.0, 1, 3, 5, 6]),
                      phases=("approach", "path", "path", "return", "return"))
    path, hold, back = legs_without_cell(motion, 2.5)
    assert (path["duration_s"], hold["start_s"], back["start_s"]) == (3.0, 3.0, 5.5)
    assert path["length_m"] == back["length_m"] == pytest.approx(0.02)
    assert hold["peak_force_n"] == 3.0 and path["peak_speed_m_s"] == pytest.approx(0.01)
