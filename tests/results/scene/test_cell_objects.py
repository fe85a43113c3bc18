"""A robot's cell in a scene: closed surfaces where the cell file says they are."""

import numpy as np
import pytest

from limber.cell.cell_file import Cell
from limber.cell.obstacles import Box, Solid
from limber.core.numerics.rigid import matrices
from limber.geometry.surface.surface import Surface
from limber.results.scene.colours import SceneData
from limber.results.scene.still_objects import add_cell

CELL = Cell(robot={"model": "ur5e"}, base={"pose": (0.55, 0.1, 0, 0, 0, 1.2)},
            tool={"grasp_pose": (0, 0, 0.15, 0, 0, 0)},
            camera={"pose": (0, -0.9, 0.5, -np.pi / 2, 0, 0)},
            second_arm={"model": "ur3e", "base_pose": (-0.6, 0, 0, 0, 0, 0)},
            workspace={"low_m": (-0.4, -0.4, 0), "high_m": (0.4, 0.4, 0.9)})
TURN = matrices(np.array([0, 0, 0, 0.1, 0.2, 0.3]))[:3, :3]
TABLE = Box("table", np.array([0.8, 0.6, 0.02]), np.array([0.3, 0, -0.03]), TURN.T)


def shown(cell=CELL, obstacles=(TABLE,), **info) -> SceneData:
    data = SceneData({}, dict(info))
    add_cell(data, cell, obstacles)
    return data


def solid(data: SceneData, key: str) -> tuple[np.ndarray, np.ndarray]:
    return data.arrays[f"solid:{key}"], data.arrays[f"solid_faces:{key}"]


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    corner = vertices[faces]
    return float(np.einsum("ij,ij->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6)


def test_every_part_of_the_cell_is_a_closed_surface_that_faces_outwards():
    data = shown()
    assert set(data.info["cell"]) == {"arm", "tool", "second_arm", "camera", "workspace",
                                      "obstacle1"}
    for key in data.info["cell"]:
        _, faces = solid(data, key)
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        back = {(b, a) for a, b in edges.tolist()}
        assert back == {(a, b) for a, b in edges.tolist()}
        assert volume(*solid(data, key)) > 0.0


def test_a_box_and_the_gripper_are_where_the_cell_file_says():
    data = shown()
    vertices, faces = solid(data, "obstacle1")
    assert volume(vertices, faces) == pytest.approx(1.6 * 1.2 * 0.04)
    assert (vertices - TABLE.centre) @ TURN == pytest.approx(
        np.sign((vertices - TABLE.centre) @ TURN) * TABLE.half)
    assert data.info["cell"]["obstacle1"]["title"] == "Obstacle table"
    flange = matrices(np.array(CELL.base.pose)) @ CELL.arm.forward(np.array(CELL.arm.home))
    tip = (flange @ [0, 0, 0.15, 1.0])[:3]
    radius = 0.5 * CELL.arm.link_radius
    vertices, _ = solid(data, "tool")
    assert np.linalg.norm(vertices - tip, axis=1).min() == pytest.approx(radius, rel=1e-6)


def test_the_arm_of_a_dry_run_is_not_drawn_twice():
    on_flange = CELL.model_copy(update={
        "camera": CELL.camera.model_copy(update={"mount": "flange"})})
    data = shown(on_flange, robot={"name": "ur5e", "gripper_rods": 3})
    assert set(data.info["cell"]) == {"second_arm", "workspace", "obstacle1"}
    assert "camera" in shown(on_flange).info["cell"]


def test_an_obstacle_from_a_mesh_keeps_its_triangles():
    corners = np.array([[0, 0, 0], [1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    vertices, kept = solid(shown(obstacles=(Solid("post", Surface(corners, faces)),)), "obstacle1")
    assert (vertices == corners).all() and (kept == faces).all()
