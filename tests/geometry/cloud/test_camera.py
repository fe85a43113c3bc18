"""Pixels to points and back."""

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.cloud.camera import (
    D455,
    Camera,
    depth_to_cloud,
    project,
    read_camera,
    write_camera,
)
from limber.geometry.tets.tree_sweep import straight_beam
from limber.perception.simulated_camera import render_depth, with_noise


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
