"""From a pull's folder of images or clouds to control points over time."""

import numpy as np
import pytest
from PIL import Image

from limber.core.errors import InputError
from limber.geometry.cloud.camera import depth_to_cloud, write_camera
from limber.geometry.cloud.cloud import Cloud
from limber.perception.observe import list_frames, observe, write_depth
from limber.recordings.image_folders import segment_by_depth
from limber.recordings.recording import GraspEntry, Pull, PullEntry

FRACTIONS = (0.2, 0.4, 0.6, 0.8)
BENDS = np.linspace(0.0, 0.6, 6)


@pytest.fixture
def pull(scene) -> Pull:
    """The gripper holds the last control point and is where that point is."""
    poses = np.zeros((len(BENDS), 6))
    poses[:, :3] = [scene.control_points(bend)[3] for bend in BENDS]
    held = tuple(float(x) for x in poses[0, :3])
    entry = PullEntry(observation="depth", grasp=GraspEntry(
        point_m=held, radius_m=0.008, mode="point"))
    return Pull("seen", entry, np.arange(len(BENDS)) * 0.5, poses, np.full((len(BENDS), 6), np.nan))


def recorded(folder, scene, camera=None):
    """Write depth images and masks as a recorder would, with a D455's noise."""
    for sub in ("depth", "mask"):
        (folder / sub).mkdir(parents=True)
    write_camera(folder / "camera.toml", camera or scene.camera)
    rng = np.random.default_rng(8)
    for index, bend in enumerate(BENDS):
        depth = scene.depth(bend, rng)
        write_depth(folder / "depth" / f"{0.5 * index:.6f}.png", depth, scene.camera)
        mask = segment_by_depth(depth)
        Image.fromarray(mask.astype(np.uint8) * 255).save(
            folder / "mask" / f"{0.5 * index:.6f}.png")
    return folder


def errors(scene, observations):
    true = np.array([scene.control_points(bend) for bend in BENDS])
    return np.linalg.norm(observations.positions - true, axis=2)


def test_depth_frames_with_an_empty_mask(tmp_path, scene, pull):
    """All frames but the empty one give points to within a millimetre; the empty one is told."""
    folder = recorded(tmp_path / "seen", scene)
    blank = folder / "mask" / "1.500000.png"
    Image.fromarray(np.zeros((720, 1280), np.uint8)).save(blank)
    seen, warnings = observe(folder, pull, scene.skeleton, FRACTIONS)
    assert np.isnan(seen.positions[3]).all()
    assert np.nanmax(errors(scene, seen)) < 1.5e-3
    assert any("1 of 6 frames do not show the branch" in warning for warning in warnings)


@pytest.mark.slow
def test_a_camera_pose_that_is_off_is_corrected(tmp_path, scene, pull):
    """25 mm sideways: told with its size, and the points are right nevertheless."""
    off = np.array(scene.camera.pose)
    off[:3] += [0.02, 0.015, 0.0]
    folder = recorded(tmp_path / "seen", scene, scene.camera.model_copy(update={
        "pose": tuple(float(x) for x in off)}))
    seen, warnings = observe(folder, pull, scene.skeleton, FRACTIONS)
    assert any("an error of up to 2" in warning and "mm" in warning for warning in warnings)
    assert np.nanmedian(errors(scene, seen)) < 1.5e-3


def test_clouds_without_a_camera(tmp_path, scene, pull):
    """One-sided PLY clouds and no camera: the line of sight is guessed from the seen side."""
    folder = tmp_path / "seen"
    (folder / "clouds").mkdir(parents=True)
    rng = np.random.default_rng(9)
    for index, bend in enumerate(BENDS):
        depth = scene.depth(bend, rng)
        cloud = depth_to_cloud(scene.camera, depth, segment_by_depth(depth))
        Cloud(cloud.points).write_ply(folder / "clouds" / f"{0.5 * index:.6f}.ply")
    entry = pull.entry.model_copy(update={"observation": "clouds"})
    pull = Pull("seen", entry, pull.times, pull.poses, pull.wrenches)
    seen, _ = observe(folder, pull, scene.skeleton, FRACTIONS)
    assert np.nanmax(errors(scene, seen)) < 3e-3


def test_a_branch_in_no_frame_is_an_error(tmp_path, scene, pull):
    """All masks empty: nothing to follow, and the depth scale is suspected."""
    folder = recorded(tmp_path / "seen", scene)
    for path in (folder / "mask").iterdir():
        Image.fromarray(np.zeros((720, 1280), np.uint8)).save(path)
    with pytest.raises(InputError, match="depth_scale"):
        observe(folder, pull, scene.skeleton, FRACTIONS)


def test_frames_are_named_by_time(tmp_path):
    """Names that are no numbers are refused; one frame is no recording."""
    (tmp_path / "depth").mkdir()
    (tmp_path / "depth" / "first.png").write_bytes(b"")
    with pytest.raises(InputError, match="time stamps"):
        list_frames(tmp_path, "depth")
    (tmp_path / "depth" / "first.png").rename(tmp_path / "depth" / "1.5.png")
    with pytest.raises(InputError, match="1 frames"):
        list_frames(tmp_path, "depth")
