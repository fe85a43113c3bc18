"""The cell file: round trip, frames, and errors that name line and field."""

import json
import re

import numpy as np
import pytest
import tomlkit
from tests.subjects.commands import answer

from limber.cell.cell_file import Cell, read_cell, write_cell
from limber.cli.commands.robot.new_cell import NewCell
from limber.cli.main import call
from limber.core.errors import InputError
from limber.core.numerics.rigid import matrices, pose_vectors

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
    ("mass_kg = 0.9", "mass = 0.9", r"line 13: tool\.mass: no such entry"),
    ("hard_force_n = 15.0", "hard_force_n = 5.0", r"line 16: limits: soft_force_n must be less"),
    ("high_m = [0.5, 0.5, 1.0]", "high_m = [0.5, -0.5, 1.0]", "workspace: low_m must be below"),
    ("[base]", "[base", r"line 7"),
    ('kind = "box"', 'kind = "ball"', "obstacles"),
])
def test_what_is_wrong_is_named(cell_file, old, new, told):
    cell_file.write_text(TEXT.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError, match=told):
        read_cell(cell_file)


SLIPS = {
    # an entry of the file, and what is wrong with it: the unit or the order, mostly
    "base.pose": [[0.6, 0.1, 0, 0, 0, 90], [600, 100, 0, 0, 0, 1.2], [15, 2, 0, 0, 0, 0]],
    "base.position_sigma_m": [2.0], "base.rotation_sigma_rad": [0.6], "base.residual_m": [3.0],
    "robot.pose_sigma_m": [0.05], "robot.pose_sigma_rad": [0.3],
    "robot.joint_limits_rad": [[[-180, 180]] * 6, [[1.0, -1.0]] * 6, [[0.0, 0.05]] * 6,
                               [[7.0, 9.0]] * 6, [[-1, 1]] * 5],
    "tool.grasp_pose": [[0, 0, 150, 0, 0, 0], [0, 0, 1.5, 0, 0, 0], [0, 0, 0.15, 0, 0, 45]],
    "tool.mass_kg": [900, 9.0], "tool.centre_of_mass_m": [[0, 0, 40]],
    "tool.parts": [[{"start_m": [0, 0, 0], "end_m": [0, 0, 100], "radius_m": 0.04}],
                   [{"start_m": [0, 0, 0], "end_m": [0, 0, 0.1], "radius_m": 40}]],
    "tool.compliance_m_per_n": [0.05], "tool.grip_seconds": [1000],
    "approach.distance_m": [80], "approach.direction": [[0, 0, 0]],
    "sensor.pose": [[0, 0, 80, 0, 0, 0], [0, 0, 0.04, 0, 0, 180]],
    "sensor.force_range_n": [0.1, 1e5], "sensor.torque_range_nm": [1.0, 1e4],
    "sensor.force_sigma_n": [150], "sensor.torque_sigma_nm": [20],
    "sensor.drift_n_per_minute": [800],
    "limits.hard_force_n": [1e4, 15000, 0.015], "limits.hard_torque_nm": [3000],
    "limits.soft_force_n": [20.0, 1e4], "limits.unexpected_force_n": [3000],
    "limits.speed_m_s": [50], "limits.acceleration_m_s2": [300], "limits.turn_speed_rad_s": [30],
    "limits.singularity": [5], "limits.joint_margin_rad": [3],
    "camera.pose": [[0, 800, 0, 0, 0, 0], [0, 0.8, 0, 0, 0, 90]],
    "camera.range_m": [[200, 2000], [2.0, 0.2]], "camera.focal_px": [[1.93, 1.93]],
    "camera.centre_px": [[3200, 2400]], "camera.width": [10**9],
    "second_arm.base_pose": [[800, 0, 0, 0, 0, 0], [0.8, 0, 0, 0, 0, 180]],
    "workspace.high_m": [[500, 500, 1000], [-1, -1, -1]],
    "workspace": [{"low_m": [5.0, 5.0, 0.0], "high_m": [6.0, 6.0, 1.0]}],
    "obstacles.0.pose": [[300, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 45]],
    "obstacles.0.size_m": [[1000, 1000, 20], [1, 1, -0.1]]}


def _content():
    return {"branch": "0d5a", "robot": {"model": "ur5e"},
            "base": {"pose": [0.6, 0.1, 0.0, 0.0, 0.0, 1.2]},
            "tool": {"grasp_pose": [0, 0, 0.15, 0, 0, 0], "mass_kg": 0.9}, "approach": {},
            "sensor": {}, "limits": {"hard_force_n": 15.0},
            "camera": {"pose": [0, -0.8, 0.3, -1.57, 0, 0]},
            "second_arm": {"model": "ur3e", "base_pose": [-0.6, 0.1, 0, 0, 0, 0]},
            "workspace": {"low_m": [-0.5, -0.5, 0.0], "high_m": [0.5, 0.5, 1.0]},
            "obstacles": [{"size_m": [1, 1, 0.02], "pose": [0, 0, -0.01, 0, 0, 0], "kind": "box"}]}


@pytest.mark.parametrize(("place", "value"),
                         [(place, value) for place, values in SLIPS.items() for value in values])
def test_a_slip_is_refused_and_its_entry_named(tmp_path, place, value):
    """Millimetres, degrees, grams, millinewtons, and what comes in the wrong order."""
    content = _content()
    Cell.model_validate(content)
    table = content
    *folders, last = place.split(".")
    for part in folders:
        table = table[int(part) if part.isdigit() else part]
    table[last] = value
    path = tmp_path / "cell.toml"
    path.write_text(tomlkit.dumps(content))
    with pytest.raises(InputError, match=rf"cell\.toml, line \d+: .*{last}"):
        read_cell(path)


def test_a_missing_file_is_told(tmp_path):
    with pytest.raises(InputError, match="robot calibrate"):
        read_cell(tmp_path / "none.toml")


def test_joint_limits_only_narrow_the_arms_own():
    wide = tuple((-9.0, 1.0) for _ in range(6))
    cell = Cell(robot={"model": "ur5", "joint_limits_rad": wide}, base={"pose": (0,) * 6})
    assert cell.joint_limits == pytest.approx(np.tile([-2 * np.pi, 1.0], (6, 1)))


def test_a_new_cell_shows_every_section_and_key(tmp_path, capfd):
    """As written, and with every example in force, it is a cell; an old file is kept."""
    path = tmp_path / "new.toml"

    def run(*options: str) -> int:
        code = call(["robot", "new-cell", str(path), *options])
        capfd.readouterr()
        return code
    assert run("--model", "ur10", "--mass-kg", "1.1", "--gripper", "digital_output",
               "--grasp-distance", "0.2") == 0
    cell = read_cell(path)
    assert (cell.arm.name, cell.tool.mass_kg, cell.sensor.kind) == ("ur10", 1.1, "ft300")
    assert cell.tool.grasp_pose == (0, 0, 0.2, 0, 0, 0)
    assert cell.camera is cell.second_arm is cell.workspace is None and not cell.obstacles
    text = path.read_text(encoding="utf-8")
    assert run() == 2 and path.read_text(encoding="utf-8") == text
    told = re.sub(r"^# (?=[a-z_]+ = |\[)", "", text, flags=re.MULTILINE)
    path.write_text(told, encoding="utf-8")
    whole = read_cell(path)
    assert whole.camera and whole.second_arm and whole.workspace and len(whole.obstacles) == 2
    sections = set(Cell.model_fields) - {"branch", "calibrated"}
    assert {f"[{name}]" for name in sections - {"format_version", "obstacles"}} <= set(
        told.splitlines())
    keys = set(re.findall(r"(\w+) = ", told))
    schema = Cell.model_json_schema()
    wanted = {key for entry in schema["$defs"].values() for key in entry["properties"]}
    assert wanted <= keys


@pytest.mark.parametrize("tool, told", [
    ({"gripper": "robotiq"}, r"line \d+: tool.grasp_pose is at the flange"),
    ({"gripper": "digital_output", "grasp_pose": [0, 0, 0, 0, 0, 1.5],
      "parts": [{"start_m": [0, 0, 0], "end_m": [0, 0, 0.1], "radius_m": 0.04}]},
     "tool.grasp_pose is at the flange"),
    ({"gripper": "by_hand", "mass_kg": 0.9}, "tool.grasp_pose is at the flange"),
    ({"gripper": "robotiq", "mass_kg": 0, "grasp_pose": [0, 0, 0.15, 0, 0, 0]},
     "tool.mass_kg is 0, the mass of a bare flange")])
def test_a_gripper_with_the_values_of_a_bare_flange_is_refused(tmp_path, tool, told):
    content = {"robot": {"model": "ur5e", "address": "192.168.0.10"},
               "base": {"pose": [0.6, 0.1, 0, 0, 0, 1.2]}, "tool": tool}
    path = tmp_path / "cell.toml"
    path.write_text(tomlkit.dumps(content))
    with pytest.raises(InputError, match=told):
        read_cell(path)
    content["tool"] = {"gripper": "none", "mass_kg": 0}
    path.write_text(tomlkit.dumps(content))
    assert read_cell(path).tool.gripper == "none"


def test_a_new_cell_says_what_is_to_be_filled_in_instead_of_zero(tmp_path, capfd):
    path = tmp_path / "new.toml"
    code, told = answer("robot", "new-cell", path, "--gripper", "robotiq")
    assert code == 0 and told["to_fill_in"] == ["tool.grasp_pose", "tool.mass_kg"]
    text = path.read_text(encoding="utf-8")
    assert text.count("TO FILL IN") == 2 and "\ngrasp_pose" not in text
    with pytest.raises(InputError, match="State where the branch lies between the fingers"):
        read_cell(path)
    path.write_text(text.replace("# grasp_pose =", "grasp_pose =", 1).replace(
        "# mass_kg =", "mass_kg ="), encoding="utf-8")
    assert read_cell(path).tool.mass_kg == 0.9


def test_a_new_cell_asks_at_a_terminal_for_sensor_grasp_and_base(tmp_path, monkeypatch):
    typed = {"Model": "ur10", "Force": "ft300", "How": "robotiq", "Mass": "1.1",
             "Distance": "0.2", "Pose": "0.5, 0.2 0 0 0 1.5"}
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", lambda asked: typed.get(asked.split()[0], ""))
    NewCell(cell_file=tmp_path / "new.toml").run()
    cell = read_cell(tmp_path / "new.toml")
    assert (cell.sensor.kind, cell.sensor.force_range_n, cell.tool.mass_kg) == ("ft300", 300, 1.1)
    assert cell.base.pose == (0.5, 0.2, 0, 0, 0, 1.5) and cell.tool.grasp_pose[2] == 0.2


@pytest.mark.parametrize("options, rated", [
    (["--model", "ur3e"], ("controller", 30, 10)), (["--model", "ur10"], ("ft300", 300, 30)),
    (["--model", "ur30", "--sensor", "ft300_usb"], ("ft300_usb", 300.0, 30.0))])
def test_a_new_cell_has_the_range_of_its_sensor(options, rated, tmp_path, capfd):
    assert answer("robot", "new-cell", tmp_path / "a.toml", "--gripper", "none", *options)[0] == 0
    sensor = read_cell(tmp_path / "a.toml").sensor
    assert (sensor.kind, sensor.force_range_n, sensor.torque_range_nm) == rated


def test_the_schema_of_a_cell_names_its_sections(capfd):
    assert call(["schema", "cell"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert {"robot", "sensor", "camera", "second_arm", "obstacles"} <= set(told["properties"])
