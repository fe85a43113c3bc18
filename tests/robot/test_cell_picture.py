"""The drawing of a cell: what a cell file states is where the picture shows it."""


import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from tests.subjects.commands import robot_answer

from limber.cell.cell_file import Cell, write_cell
from limber.cell.obstacles import Box
from limber.core.numerics.rigid import matrices
from limber.geometry.skeleton.skeleton import Skeleton
from limber.results.cell_picture import cell_picture

CELL = Cell(robot={"model": "ur5e"}, base={"pose": (0.55, 0.1, 0, 0, 0, 1.2)},
            tool={"grasp_pose": (0, 0, 0.15, 0, 0, 0),
                  "parts": [{"start_m": (0, 0, 0), "end_m": (0, 0, 0.12), "radius_m": 0.04}]},
            camera={"pose": (0, -0.9, 0.5, -np.pi / 2, 0, 0)},
            second_arm={"model": "ur3e", "base_pose": (-0.6, 0, 0, 0, 0, 0)},
            workspace={"low_m": (-0.4, -0.4, 0), "high_m": (0.4, 0.4, 0.9)},
            obstacles=[{"kind": "box", "name": "table", "size_m": (1.6, 1.2, 0.04),
                        "pose": (0.3, 0, -0.03, 0, 0, 0)}])
HOME = np.array(CELL.arm.home)


def test_arm_gripper_camera_and_obstacles_are_drawn_where_they_are():
    branch = Skeleton(np.array([[0, 0, 0], [0.0, 0.05, 0.6]]), np.array([-1, 0]),
                      np.array([0.01, 0.005]))
    table = Box("table", np.array([0.8, 0.6, 0.02]), np.array([0.3, 0, -0.03]), np.eye(3))
    front, side, above = cell_picture(CELL, HOME, [table], branch).axes
    legend = {text.get_text() for text in front.figure.legends[0].get_texts()}
    assert legend == {"obstacles", "second arm (ur3e) at its home", "arm (ur5e)", "gripper",
                      "branch", "camera's view", "workspace of the grasp"}
    # The gripper's tip, seen from each side, is inside the outline of its part.
    tip = (matrices(np.array(CELL.base.pose)) @ CELL.arm.forward(HOME)
           @ matrices(np.array([0, 0, 0.12, 0, 0, 0])))[:3, 3]
    for axes, seen in ((front, [0, 2]), (side, [1, 2]), (above, [0, 1])):
        gripper = next(each for each in axes.collections if isinstance(each, PolyCollection)
                       and each.get_label() == "gripper")
        assert gripper.get_paths()[0].contains_point(tip[seen])
        assert axes.get_aspect() == 1.0
    assert front.texts[0].get_text() == "table"
    assert front.texts[0].xy == pytest.approx((0.3, -0.03))


@pytest.mark.slow
def test_the_command_writes_a_picture_without_a_robot(tmp_path, capfd):
    """Slow: matplotlib writes a picture, which takes a second."""
    write_cell(tmp_path / "cell.toml", CELL)

    def run(*arguments: str) -> tuple[int, dict]:
        return robot_answer(capfd, "draw", tmp_path / "cell.toml", *arguments)
    picture = tmp_path / "cell.png"
    code, told = run("-o", str(picture), "--joints", ",".join(map(str, HOME)))
    assert code == 0 and told["obstacles"] == 1
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert run("--joints", "1,2")[0] == 2
    code, told = run("-o", str(tmp_path / "cell.xyz"))
    assert code == 2 and "cannot be drawn" in told["error"]
    assert not list(tmp_path.glob("*xyz*"))
