"""The cell file: round trip, frames, and errors that name line and field."""

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.core.numerics.rigid import matrices, pose_vectors
from limber.robot.cell.cell import Cell, read_cell, write_cell

TEXT = """\
branch = "0d5a"

[robot]
model = "UR5e"
address = "192.168.0.10"

[base]
pose = [0.6, 0.1, 0.0, 0.0, 0.0, 1.2]
position_sigma_m = 0.002

[tool]
grasp_pose = [0, 0, 0.15, 0, 0, 0]
mass_kg = 0.9
parts = [{start_m = [0, 0, 0], end_m = [0, 0, 0.1], radius_m = 0.04}]

[limits]
hard_force_n = 15.0

[workspace]
low_m = [-0.5, -0.5, 0.0]
high_m = [0.5, 0.5, 1.0]

[[obstacles]]
kind = "box"
name = "table"
size_m = [1.0, 1.0, 0.02]
pose = [0, 0, -0.01, 0, 0, 0]
"""


@pytest.fixture
def cell_file(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(TEXT, encoding="utf-8")
    return path


def test_read_write_read(cell_file, tmp_path):
    cell = read_cell(cell_file)
    assert cell.arm.name == "ur5e" and cell.obstacles[0].name == "table"
    write_cell(tmp_path / "again.toml", cell)
    assert read_cell(tmp_path / "again.toml") == cell


def test_frames_go_to_the_flange_and_back(cell_file):
    cell = read_cell(cell_file)
    poses = np.random.default_rng(0).uniform(-1, 1, (20, 6))
    assert pose_vectors(cell.grasp_frames(cell.flange_frames(poses))) == pytest.approx(poses)
    # By hand: base at (0.6, 0.1, 0), turned by 1.2 about z; the grasp 0.15 m before the flange.
    flange = cell.flange_frames(np.array([0.6, 0.1, 0.5, 0, 0, 0]))
    assert flange[:3, 3] == pytest.approx([0, 0, 0.35])
    assert flange[:3, :3] == pytest.approx(matrices(np.array([0, 0, 0, 0, 0, -1.2]))[:3, :3])


@pytest.mark.parametrize("old, new, told", [
    ('model = "UR5e"', 'model = "kuka"',
     r"line 4: robot\.model: is not a known arm; known arms are ur3"),
    ("pose = [0.6, 0.1, 0.0, 0.0, 0.0, 1.2]", "pose = [600, 100, 0, 0, 0, 1.2]",
     r"line 8: base\.pose: is 600 m away; it may have been given in millimetres"),
    ("pose = [0.6, 0.1, 0.0, 0.0, 0.0, 1.2]", "pose = [0.6, 0.1, nan, 0, 0, 1.2]",
     r"line 8: base\.pose.*finite"),
    ("mass_kg = 0.9", "mass_kg = 9.0", "ur5e carries at most 5 kg"),
    ("mass_kg = 0.9", "mass = 0.9", r"line 13: tool\.mass: Extra"),
    ("hard_force_n = 15.0", "hard_force_n = 5.0", r"line 16: limits: soft_force_n must be less"),
    ("high_m = [0.5, 0.5, 1.0]", "high_m = [0.5, -0.5, 1.0]", "workspace: low_m must be below"),
    ("[base]", "[base", r"line 7"),
    ('kind = "box"', 'kind = "ball"', "obstacles"),
])
def test_what_is_wrong_is_named(cell_file, old, new, told):
    cell_file.write_text(TEXT.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError, match=told):
        read_cell(cell_file)


def test_a_missing_file_is_told(tmp_path):
    with pytest.raises(InputError, match="robot calibrate"):
        read_cell(tmp_path / "none.toml")


def test_joint_limits_only_narrow_the_arms_own():
    wide = tuple((-9.0, 1.0) for _ in range(6))
    cell = Cell(robot={"model": "ur5", "joint_limits_rad": wide}, base={"pose": (0,) * 6})
    assert cell.joint_limits == pytest.approx(np.tile([-2 * np.pi, 1.0], (6, 1)))
