"""A depth image with its camera, and a mask of the branch, as a cloud."""

from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.pixels import read_pixels


def read_depth(depth_path: Path, camera_path: Path, mask_path: Path | None = None) -> Cloud:
    """Back-project a depth image; coordinates in metres, in the frame of the camera's pose.

    Args:
        depth_path: 16-bit PNG; a value divided by the camera's ``depth_scale`` is in metres.
        camera_path: ``camera.toml`` (see :mod:`limber.geometry.cloud.camera`).
        mask_path: PNG of the same size, over 0 on the branch; None takes every reading.

    Raises:
        InputError: an image or the camera cannot be read, or they do not belong together.
    """
    from limber.geometry.cloud.camera import depth_to_cloud, read_camera

    camera = read_camera(camera_path)
    depth = _image(depth_path).astype(float) / camera.depth_scale
    mask = None if mask_path is None else _image(mask_path) > 0
    seen = depth_to_cloud(camera, depth, mask)
    if len(seen.points) == 0:
        raise InputError(f"{depth_path} has no reading within the mask.",
                         "A cloud needs depths greater than 0.",
                         "Check the mask and the depth image.")
    return Cloud(seen.points, {"sigma": seen.sigma}, unit="m")


def _image(path: Path) -> np.ndarray:
    image = read_pixels(path, "a PNG")
    return image if image.ndim == 2 else image.max(axis=2)
