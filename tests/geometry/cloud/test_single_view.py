"""Clouds of one depth camera: recognised as such, and rid of their flying pixels."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.scan_scores import score
from limber.core.errors import InputError
from limber.geometry.cloud import preparation
from limber.geometry.cloud.camera import (
    D455,
    Camera,
    depth_to_cloud,
    project,
    read_camera,
    write_camera,
)
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.preparation import PreparationSettings, prepare
from limber.geometry.cloud.single_view import Sight, find_sight, flying_pixels, scan_line_view
from limber.geometry.generated import GeneratedBranch, generate_branch
from limber.geometry.io.clouds import read_points
from limber.geometry.skeleton.skeletonise import skeletonise
from limber.geometry.tets.tree_sweep import straight_beam
from limber.perception.simulated_camera import render_depth, with_noise

AHEAD = np.array([1.0, 0.0, 0.1])


def seen(seed: int, flying_share: float, **spec: object,
         ) -> tuple[GeneratedBranch, Camera, np.ndarray, np.ndarray]:
    """A branch, a camera before it, its depth image, and which pixels were moved off."""
    branch = generate_branch(seed, **({"length": 0.6, "fork_count": 2} | spec))
    middle = (branch.skeleton.nodes.min(axis=0) + branch.skeleton.nodes.max(axis=0)) / 2
    camera = D455.looking(eye=middle + AHEAD, target=middle, up=(0.0, 1.0, 0.0))
    exact = render_depth(camera, branch.surface.vertices, branch.surface.faces)
    depth = with_noise(camera, exact, np.random.default_rng(seed), flying_share=flying_share)
    flies = (depth > 0) & (np.abs(depth - exact) > 0.02)
    return branch, camera, depth, flies


def in_camera_axes(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Points [m] in the camera's own frame, as an RGB-D camera's PLY file has them."""
    return depth_to_cloud(camera.model_copy(update={"pose": (0.0,) * 6}), depth).points


def test_flying_pixels_are_found_and_the_branch_stays() -> None:
    """More than 95 % of what flies 20 mm or more goes, less than 1 % of what is on the branch."""
    _, camera, depth, flies = seen(61, 0.05)
    sight = find_sight(in_camera_axes(camera, depth))
    assert sight is not None
    assert sight.pitch == pytest.approx(1 / camera.fx, rel=1e-3)
    found = flying_pixels(sight, 78.0, 3)
    truth = flies[depth > 0]
    assert found[truth].mean() > 0.95
    assert found[~truth].mean() < 0.01


def test_thin_twigs_in_pieces_stay() -> None:
    """A twig one pixel wide, with steps of 30 mm between its pieces of three pixels, and a pixel
    by itself stay; a pixel behind a stem's edge flies.
    """
    row, column = (grid.ravel() for grid in np.mgrid[0:100, 0:6])
    twig = np.stack([np.full(90, 50), np.arange(7, 97)], axis=1)
    pixels = np.vstack([np.stack([row, column], axis=1), twig, [[80, 60], [20, 6]]]).astype(float)
    depth = np.concatenate([np.ones(len(row)), 1 + 0.03 * (np.arange(90) // 3 % 2), [1.2, 1.1]])
    flies = flying_pixels(Sight(pixels, depth, 1e-3), 78.0, 3)
    assert np.flatnonzero(flies).tolist() == [len(pixels) - 1]


def test_a_thinned_image_says_how_many_of_its_pixels_are_left() -> None:
    """Of half of the pixels no more of the branch flies: 13 % did."""
    _, camera, depth, flies = seen(61, 0.05)
    points, truth = in_camera_axes(camera, depth), flies[depth > 0]
    assert find_sight(points).fill > 0.97
    half = np.random.default_rng(2).uniform(size=len(points)) < 0.5
    sight = find_sight(points[half])
    assert sight.fill == pytest.approx(0.5, abs=0.03)
    found = flying_pixels(sight, 78.0, 3)
    assert found[truth[half]].mean() > 0.9
    assert found[~truth[half]].mean() < 0.01


@pytest.mark.slow
def test_the_image_is_found_in_turned_axes_and_beside_nothing_else() -> None:
    """An image stays one when its frame is turned; a scan from all around is none."""
    branch, camera, depth, _ = seen(62, 0.0)
    points = in_camera_axes(camera, depth)
    turn = Rotation.from_rotvec([0.4, 1.9, -0.3]).as_matrix()
    assert find_sight(points @ turn.T) is not None
    assert find_sight(branch.cloud.points) is None
    assert find_sight(branch.cloud.points + [0.0, 0.0, 3.0]) is None
    assert find_sight(points + [0.3, 0.0, 0.5]) is None  # seen from where no camera stood
    assert find_sight(points + [0.3, 0.0, 0.5], np.array([0.3, 0.0, 0.5])) is not None


def test_scans_from_many_sides_are_no_depth_images(coffeetree, tomato) -> None:
    """Laser scans from many sides and map coordinates are not mistaken for one camera's."""
    assert find_sight(read_points(coffeetree).points) is None
    assert find_sight(tomato.points) is None


@pytest.mark.parametrize("name", ["frame_00025", "frame_00125"])
def test_real_depth_images_are_recognised(recorded_data, name) -> None:
    """Parts of 3,000 points of two RGB-D images of apple trees."""
    with np.load(recorded_data / "apple_rgbd" / f"{name}.npz") as file:
        assert find_sight(file["points_mm"].astype(float)) is not None


def test_flying_pixels_are_counted() -> None:
    """They are counted and reported; the camera's position can be given."""
    _, camera, depth, _ = seen(63, 0.05)
    points = in_camera_axes(camera, depth)
    prepared = prepare(Cloud(points), 1.0)
    assert prepared.counts["flying"] > 0.03 * len(points)
    assert any("flying" in text for text in prepared.warnings)
    kept = prepare(Cloud(points), 1.0, PreparationSettings(keep=("flying",)))
    assert "flying" not in kept.counts and len(kept.cloud.points) > len(prepared.cloud.points)
    twice = prepare(Cloud(np.concatenate([points, points[::5]])), 1.0)
    assert twice.counts["flying"] == prepared.counts["flying"]
    assert np.array_equal(twice.cloud.points, prepared.cloud.points)
    moved = PreparationSettings(camera_at=(500.0, 100.0, 20.0))
    away = prepare(Cloud(1000 * points + np.array(moved.camera_at)), 1e-3, moved)
    assert away.counts["flying"] == prepared.counts["flying"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [64, pytest.param(65, marks=pytest.mark.campaign)])
def test_flying_pixels_grow_no_twigs(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the rule they made false forks; with it the true ones alone are found."""
    branch, camera, depth, _ = seen(seed, 0.05)
    points = in_camera_axes(camera, depth)
    false = []
    for angle in (78.0, 90.0):
        monkeypatch.setattr(preparation, "_FLYING_ANGLE", angle)
        prepared = prepare(Cloud(points), 1.0)
        root = camera.to_camera(branch.skeleton.nodes[:1])[0]
        found = skeletonise(prepared.cloud.points, root=root - prepared.origin,
                            up=np.array([0.0, 0.0, 1.0]) @ camera.rotation).skeleton
        scored = score(branch.skeleton, found.moved(
            camera.to_branch(found.nodes + prepared.origin)))
        false.append(scored["forks_false"])
        if angle < 90.0:
            assert scored["forks_found"] == scored["forks"]
    assert false[0] == 0 < false[1]


# The camera of a depth image, told by its file's order wherever the cloud was moved to.


def image() -> np.ndarray:
    """Points [m] of a wavy surface with a hole, as a camera at the origin sees it along z."""
    row, column = np.mgrid[:D455.height, :D455.width]
    depth = 1.0 + 0.1 * np.sin(column / 40) * np.cos(row / 30)
    depth = np.where((np.abs(row - 400) < 70) & (np.abs(column - 700) < 60), depth, 0.0)
    depth[360:380, 680:720] = 0.0
    depth = np.round(depth, 3)  # as sensors have it: whole millimetres
    return depth_to_cloud(D455, depth).points


@pytest.mark.parametrize("columns_first", [False, True])
def test_the_camera_is_found_where_the_cloud_was_moved(columns_first: bool) -> None:
    """Place within 1 mm and direction within 0.1 degrees, row by row or column by column."""
    points = image()
    if columns_first:
        points = points[np.lexsort([np.round(points[:, 1] / points[:, 2], 6),
                                    np.round(points[:, 0] / points[:, 2], 6)])]
    turn, shift = Rotation.from_rotvec([0.3, 1.2, -0.5]).as_matrix(), np.array([3.0, -2.0, 7.0])
    eye, forward = scan_line_view(points @ turn.T + shift)
    assert eye == pytest.approx(shift, abs=1e-3)
    assert forward @ (turn @ [0, 0, 1]) > np.cos(np.deg2rad(0.1))


def test_scans_in_another_order_tell_no_camera() -> None:
    """A shuffled image, a cloud sorted along a grid and points by chance show none."""
    rng = np.random.default_rng(1)
    points = image()
    assert scan_line_view(rng.permutation(points)) is None
    assert scan_line_view(rng.uniform(0, 1, (3000, 3))) is None
    grid = np.round(rng.uniform(0, 1, (3000, 3)), 2)
    assert scan_line_view(grid[np.lexsort(grid.T)]) is None


def test_a_moved_image_loses_its_flying_pixels_too() -> None:
    """What flies is dropped from the shifted cloud as from the cloud in the camera's frame."""
    points = image()
    flying = np.random.default_rng(2).random(len(points)) < 0.03
    points = points * np.where(flying, 1.1, 1.0)[:, None]
    at_camera = prepare(Cloud(points), 1.0, PreparationSettings())
    moved = prepare(Cloud(1000 * points + [4000.0, -900.0, 2500.0]), 1e-3, PreparationSettings())
    assert at_camera.counts["flying"] > 0.9 * flying.sum()
    assert moved.counts["flying"] == at_camera.counts["flying"]
    assert moved.view.eye + moved.origin == pytest.approx([4.0, -0.9, 2.5], abs=2e-3)


# Pixels to points and back.


def test_back_projection_undoes_projection():
    """Every pixel's point projects onto that pixel again, whatever the camera's pose."""
    camera = D455.looking(eye=np.array([0.4, -0.9, 0.7]), target=np.array([0.0, 0.1, 0.3]))
    depth = np.zeros((camera.height, camera.width))
    rows, columns = np.array([5, 300, 700]), np.array([9, 640, 1200])
    depth[rows, columns] = [0.8, 1.1, 1.9]
    cloud = depth_to_cloud(camera, depth)
    pixels, z = project(camera, cloud.points)
    assert np.allclose(pixels, np.column_stack([columns, rows]), atol=1e-9)
    assert np.allclose(z, depth[rows, columns])


def test_target_is_in_the_middle_and_up_is_up():
    """The camera looks at its target, with z of the branch upwards in the image."""
    camera = D455.looking(eye=np.array([0.0, -1.0, 0.3]), target=np.array([0.0, 0.0, 0.3]))
    pixels, depth = project(camera, np.array([[0.0, 0.0, 0.3], [0.0, 0.0, 0.4], [0.1, 0.0, 0.3]]))
    assert np.allclose(pixels[0], (camera.cx, camera.cy)) and np.allclose(depth, 1.0)
    assert pixels[1, 1] < pixels[0, 1] and pixels[2, 0] > pixels[0, 0]


def test_rendered_beam_lies_on_its_surface():
    """Points of a noiseless depth image of a beam are a radius from its axis."""
    mesh = straight_beam(0.4, 0.02, sides=24, quadratic=False)
    camera = D455.looking(eye=np.array([0.1, -0.8, 0.2]), target=np.array([0.0, 0.0, 0.2]))
    cloud = depth_to_cloud(camera, render_depth(camera, mesh.nodes, mesh.surface_faces()))
    side = np.abs(cloud.points[:, 2] - 0.2) < 0.15
    distance = np.hypot(*cloud.points[side, :2].T)
    assert len(distance) > 2000
    assert abs(np.median(distance) - 0.02) < 3e-4 and distance.max() < 0.0205
    # One side only: the camera sees no point of the far half.
    assert np.max(cloud.points @ [0.0, 1.0, 0.0]) < 0.01


def test_noise_has_the_stated_size_and_share():
    """Depth noise of a plane follows disparity_sigma z^2 / (f b), readings go missing."""
    depth = np.full((720, 1280), 1.5)
    noisy = with_noise(D455, depth, np.random.default_rng(0), flying_share=0.0)
    seen = noisy > 0
    assert abs(np.mean(~seen) - 0.02) < 0.002
    assert np.std(noisy[seen]) == pytest.approx(D455.depth_sigma(1.5), rel=0.02)


def test_images_of_another_size_are_refused():
    """Intrinsics of another image would silently misplace every point."""
    with pytest.raises(InputError, match="640x480"):
        depth_to_cloud(D455, np.zeros((480, 640)))


def test_camera_file_round_trip_and_named_error(tmp_path):
    """camera.toml keeps every number; a wrong entry is named."""
    camera = D455.looking(eye=np.array([0.4, -0.9, 0.7]), target=np.zeros(3))
    write_camera(tmp_path / "camera.toml", camera)
    assert read_camera(tmp_path / "camera.toml") == camera
    (tmp_path / "bad.toml").write_text("width = 10\nheight = 10\nfx = -3\nfy = 1\ncx = 0\ncy = 0\n")
    with pytest.raises(InputError, match="fx"):
        read_camera(tmp_path / "bad.toml")
    with pytest.raises(InputError, match="intrinsics"):
        read_camera(tmp_path / "none.toml")
    assert Camera(width=4, height=3, fx=1, fy=1, cx=0, cy=0).depth_scale == 1000


def test_numbers_that_no_camera_has_are_refused(tmp_path):
    """With them a pixel would lie at no finite place; true is none at all."""
    for line in ("fy = 1e-300", "cx = 1e10", "depth_scale = 1e-12", "width = true",
                 "fx = true", "height = 10000000", "pose = [0, 0, 0, 0, 0, 90]"):
        text = {"width": "32", "height": "24", "fx": "40.0", "fy": "40.0", "cx": "15.5",
                "cy": "11.5"} | dict([line.split(" = ", 1)])
        path = tmp_path / "camera.toml"
        path.write_text("".join(f"{name} = {value}\n" for name, value in text.items()))
        with pytest.raises(InputError, match=line.split()[0]):
            read_camera(path)
