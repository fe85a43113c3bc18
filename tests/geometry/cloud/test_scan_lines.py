"""The camera of a depth image, told by its file's order wherever the cloud was moved to."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from limber.geometry.cloud.camera import D455, depth_to_cloud
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.preparation import PreparationSettings, prepare
from limber.geometry.cloud.single_view import scan_line_view


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
