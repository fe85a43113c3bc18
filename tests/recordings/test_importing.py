"""Recordings of other programs."""

import json
import sys
import types

import numpy as np
import pytest
from PIL import Image

from limber.cli.main import call
from limber.core.errors import InputError
from limber.geometry.cloud.camera import D455, read_camera, read_mask, write_camera
from limber.geometry.io.depth_images import depth_metres
from limber.perception.observe import list_frames, write_depth
from limber.recordings.import_request import ImportRequest
from limber.recordings.recording import POSE_COLUMNS, WRENCH_COLUMNS, read_pull, write_pull
from limber.recordings.recording_formats import RECORDINGS
from limber.recordings.settings import ImportSpec
from limber.recordings.time_series import Stream, read_stream, write_stream
from limber.stages.pulls.import_pull import ImportPull
from limber.store import Branch
from limber.store.loading import load_mesh


@pytest.fixture
def source(tmp_path, plain_pull):
    """The hand-made pull as two tables, markers in millimetres, forces in gram-force."""
    write_pull(tmp_path / "made", plain_pull)
    robot = read_stream(tmp_path / "made" / "robot.csv")
    scaled = robot.values / np.r_[np.ones(6), np.full(6, 9.80665e-3)]
    write_stream(tmp_path / "robot.csv", Stream(robot.times, scaled, robot.columns))
    seen = plain_pull.observations
    write_stream(tmp_path / "markers.csv", Stream(
        seen.times - 0.05, seen.positions.reshape(60, -1) * 1e3,
        tuple(f"tip{k}_{axis}_mm" for k in range(2) for axis in "xyz")))
    return tmp_path


def test_markers_in_millimetres_and_gram_force(bare_folder, source, plain_pull):
    """Units are converted at the door; the pull in the folder is in metres and newtons."""
    result = ImportPull(branch_folder=bare_folder, source=source / "markers.csv", name="m",
                        robot=str(source / "robot.csv"), unit="mm", force_unit="gf",
                        time_offset=0.05, torque_sigma=0.002).run()
    assert result["frame_count"] == 60 and result["point_count"] == 2
    pull = read_pull(bare_folder / "pulls" / "m")
    assert np.allclose(pull.observations.positions, plain_pull.observations.positions, atol=1e-6)
    assert np.allclose(pull.wrenches, plain_pull.wrenches, atol=1e-6)
    assert pull.entry.time_offset_s == 0.05
    assert pull.entry.sensor.torque_sigma_nm == 0.002
    assert pull.entry.grasp.point_m == (0.0, 0.0, 0.5)


def test_entries_of_the_users_file_replace_the_imports(bare_folder, source, tmp_path):
    """Table by table, also those of a whole pull; a wrong key is named."""
    stated = tmp_path / "mine.toml"
    stated.write_text("[calibration]\ncamera_sigma_m = 0.004\n[sensor]\ntared = false\n")
    settings = ImportSpec(robot=str(source / "robot.csv"), unit="mm", force_unit="gf",
                              time_offset=0.05, pull_toml=str(stated))
    ImportPull.of(settings, branch_folder=bare_folder, source=source / "markers.csv",
                  name="m").run()
    entry = read_pull(bare_folder / "pulls" / "m").entry
    assert entry.calibration.camera_sigma_m == 0.004
    assert not entry.sensor.tared and entry.sensor.position_sigma_m == 1e-3
    stated.write_text("[calibration]\ncamera_sigma_m = 0.005\n")
    ImportPull(branch_folder=bare_folder, source=bare_folder / "pulls" / "m", name="whole",
               pull_toml=str(stated)).run()
    whole = read_pull(bare_folder / "pulls" / "whole").entry
    assert whole.calibration.camera_sigma_m == 0.005 and whole.sensor == entry.sensor
    stated.write_text("[calibration]\ncamera_sigma = 0.005\n")
    with pytest.raises(InputError, match=r"mine.toml: calibration.camera_sigma: "):
        ImportPull.of(settings, branch_folder=bare_folder, source=source / "markers.csv",
                      name="m").run()


def test_tables_with_the_same_stamps_have_one_clock(bare_folder, source, plain_pull):
    """No offset is estimated from noise where both tables have each other's stamps."""
    seen = plain_pull.observations
    times = plain_pull.times[::3]
    at = np.stack([np.interp(times, seen.times, column)
                   for column in seen.positions.reshape(60, -1).T], axis=1)
    write_stream(source / "same.csv", Stream(times, at, tuple(
        f"tip{k}_{axis}_m" for k in range(2) for axis in "xyz")))
    result = ImportPull(branch_folder=bare_folder, source=source / "same.csv", name="s",
                        robot=str(source / "robot.csv"), force_unit="gf").run()
    assert result["time_offset_s"] == 0.0


def test_markers_in_another_frame_are_refused(branch_folder, source, small):
    """Without their nominal positions they would count as displacements."""
    write_stream(source / "robot.csv", Stream(
        np.array([0.0, 4.0]), np.hstack([np.tile(small.skeleton.nodes[-3], (2, 1)),
                                         np.zeros((2, 9))]), POSE_COLUMNS + WRENCH_COLUMNS))
    seen = np.full((2, 3), 3.0)
    write_stream(source / "far.csv", Stream(np.array([0.0, 4.0]), seen,
                                            ("tip_x_m", "tip_y_m", "tip_z_m")))
    with pytest.raises(InputError, match="--nominal"):
        ImportPull(branch_folder=branch_folder, source=source / "far.csv", name="m",
                   robot=str(source / "robot.csv")).run()


def test_a_robot_table_is_needed_and_its_columns_are_named(bare_folder, source):
    """What is missing is said, with the columns that are expected."""
    with pytest.raises(InputError, match="--robot"):
        ImportPull(branch_folder=bare_folder, source=source / "markers.csv", name="m",
                   unit="mm").run()
    with pytest.raises(InputError, match="x_m"):
        ImportPull(branch_folder=bare_folder, source=source / "markers.csv", name="m", unit="mm",
                   robot=str(source / "markers.csv")).run()
    with pytest.raises(InputError, match="no "):
        ImportPull(branch_folder=bare_folder, source=source / "nothing.csv", name="m").run()
    assert "m" not in json.loads((bare_folder / "branch.json").read_text())["files"]


def test_rgbd_folder_in_the_layout_of_tum(bare_folder, source):
    """depth.txt gives stamps, groundtruth.txt the camera's pose, masks go along."""
    folder = source / "rgbd"
    (folder / "depth").mkdir(parents=True)
    (folder / "mask").mkdir()
    camera = D455.model_copy(update={
        "width": 8, "height": 6, "cx": 3.5, "cy": 2.5, "depth_scale": 5000.0})
    write_camera(folder / "camera.toml", camera)
    depth = np.full((6, 8), 1.25)
    lines = ["# depth maps"]
    for k in range(3):
        write_depth(folder / "depth" / f"f{k}.png", depth + 0.01 * k, camera)
        write_depth(folder / "mask" / f"f{k}.png", depth, camera)
        lines.append(f"{10.0 + 0.5 * k:.6f} depth/f{k}.png")
    (folder / "depth.txt").write_text("\n".join(lines) + "\n")
    (folder / "groundtruth.txt").write_text("10.0 1 2 3 0 0 0.70710678 0.70710678\n")
    ImportPull(branch_folder=bare_folder, source=folder, name="rgbd",
               robot=str(source / "robot.csv")).run()
    target = bare_folder / "pulls" / "rgbd"
    frames = list_frames(target, "depth")
    assert [time for time, _ in frames] == [10.0, 10.5, 11.0]
    moved = read_camera(target / "camera.toml")
    assert np.allclose(moved.pose, [1, 2, 3, 0, 0, np.pi / 2], atol=1e-6)
    assert np.allclose(depth_metres(frames[1][1], moved), 1.26, atol=1e-4)
    assert len(list((target / "mask").iterdir())) == 3


def test_folder_of_clouds(bare_folder, source):
    """PLY files with numbers for names need a rate, and become metres with time stamps."""
    from limber.geometry.cloud.cloud import Cloud

    folder = source / "clouds"
    folder.mkdir()
    for k in range(3):
        Cloud(np.full((20, 3), 100.0 * k)).write_ply(folder / f"cloud_{k}.ply")
    robot = str(source / "robot.csv")
    with pytest.raises(InputError, match="--rate-hz"):
        ImportPull(branch_folder=bare_folder, source=folder, name="c", robot=robot, unit="mm").run()
    ImportPull(branch_folder=bare_folder, source=folder, name="c", robot=robot, unit="mm",
               rate_hz=10).run()
    assert [t for t, _ in list_frames(bare_folder / "pulls" / "c", "clouds")] == [0.0, 0.1, 0.2]


def test_a_force_table_gives_a_slope_and_the_reason_why_no_modulus(recorded_data, tmp_path, capsys):
    """A recorded cane push through the command: a slope with interval, and the explanation."""
    source = sorted((recorded_data / "blueberry_cane_push").glob("*.csv"))[5]
    assert call(["import-pull", str(tmp_path / "cane.branch"), str(source), "--name", "push",
                 "--json", "--progress", "none"]) == 0
    line = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    low, high = line["slope_interval_n_per_m"]
    assert low < line["slope_n_per_m"] < high
    assert "fourth power" in line["why_no_modulus"]


def test_c3d_holds_what_its_table_holds(recorded_data):
    """The silicone beam's C3D file and its CSV table are the same motion."""
    folder = recorded_data / "silicone_beam"
    path = folder / "beam_load52_V2_a.c3d"
    stream, labels = RECORDINGS.read(path, request=ImportRequest(path))
    table = read_stream(folder / "beam_load52_V2_a.csv")
    assert labels[0] == "Tip - 1" and len(labels) == 6
    assert np.allclose(stream.values, table.values, atol=2e-6)
    assert np.allclose(stream.times, table.times, atol=1e-6)


def test_masks_of_a_yolo_model_of_ones_own(bare_folder, source, monkeypatch, capsys):
    """Colour images of an RGB-D folder go through ultralytics' interface (a stand-in here, with
    its call and its shapes); each depth image gets the mask of the colour image nearest in time.
    """
    class StandIn:
        names = {58: "potted plant"}  # noqa: RUF012

        def __init__(self, _weights):
            self.classes = None

        def set_classes(self, classes):
            self.classes = classes

        def predict(self, image, **_options):
            assert self.classes == ["branch"]
            data = np.zeros((1, *image.shape[:2]))
            data[0, :, image[0, 0, 2] // 50] = 1.0
            return [types.SimpleNamespace(masks=types.SimpleNamespace(data=data))]

    module = types.ModuleType("ultralytics")
    module.YOLO = StandIn
    monkeypatch.setitem(sys.modules, "ultralytics", module)
    folder = source / "rgbd"
    for sub in ("depth", "rgb"):
        (folder / sub).mkdir(parents=True)
    camera = D455.model_copy(update={
        "width": 8, "height": 6, "cx": 3.5, "cy": 2.5, "depth_scale": 5000.0})
    write_camera(folder / "camera.toml", camera)
    lists = {"depth": [], "rgb": []}
    for k in range(3):
        write_depth(folder / "depth" / f"d{k}.png", np.full((6, 8), 1.25), camera)
        Image.fromarray(np.full((6, 8, 3), 50 * k, np.uint8)).save(folder / "rgb" / f"c{k}.png")
        lists["depth"].append(f"{k:.6f} depth/d{k}.png")
        lists["rgb"].append(f"{k + 0.02:.6f} rgb/c{k}.png")
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    weights = source / "mine.pt"
    weights.write_bytes(b"weights")
    arguments = ["import-pull", str(bare_folder), str(folder), "--name", "seen", "--robot",
                 str(source / "robot.csv"), "--yolo-weights", str(weights), "--yolo-prompt",
                 "branch", "--json", "--progress", "none"]
    assert call(arguments) == 0
    masks = [read_mask(path) for path in sorted(
        (bare_folder / "pulls" / "seen" / "mask").iterdir())]
    assert [np.flatnonzero(mask.any(axis=0)).tolist() for mask in masks] == [[0], [1], [2]]
    monkeypatch.setitem(sys.modules, "ultralytics", None)
    capsys.readouterr()
    arguments[4] = "unseen"
    assert call(arguments) != 0
    assert "ultralytics" in json.loads(capsys.readouterr().out.strip().splitlines()[-1])["error"]


@pytest.mark.slow
def test_a_swing_by_its_own_weight_needs_no_grasp_point(branch_folder, tmp_path):
    """No load hangs anywhere: the place that is seen to swing farthest stands for it."""
    nodes = load_mesh(Branch.open(branch_folder)).nodes
    places = nodes[np.argsort(nodes[:, 2])[[len(nodes) // 2, -1]]]
    times = np.arange(400) / 100
    swing = np.where(times > 0.5, 1 - np.cos(12 * (times - 0.5)) * np.exp(0.5 - times), 0.0)
    seen = places + swing[:, None, None] * np.array([[0.002, 0, 0], [0.01, 0, 0]])
    seen[-1, 1] = np.nan
    write_stream(tmp_path / "swing.csv", Stream(times, seen.reshape(400, -1), tuple(
        f"m{k}_{axis}_m" for k in range(2) for axis in "xyz")))
    ImportPull(branch_folder=branch_folder, source=tmp_path / "swing.csv", name="swing", weight=0,
               own_weight=True, motion="swing").run()
    entry = read_pull(branch_folder / "pulls" / "swing").entry
    assert np.allclose(entry.grasp.point_m, places[1], atol=1e-3)
    assert entry.swing.load_mass_kg == 0
