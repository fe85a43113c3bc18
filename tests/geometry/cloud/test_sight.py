"""Clouds of one depth camera: recognised as such, and rid of their flying pixels."""


import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.scan_scores import score
from limber.geometry.cloud import preparation
from limber.geometry.cloud.camera import D455, Camera, depth_to_cloud
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.preparation import PreparationSettings, prepare
from limber.geometry.cloud.single_view import Sight, find_sight, flying_pixels
from limber.geometry.generated import GeneratedBranch, generate_branch
from limber.geometry.io.clouds import read_points
from limber.geometry.skeleton.skeletonise import skeletonise
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
@pytest.mark.parametrize("seed", [64, 65])
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
