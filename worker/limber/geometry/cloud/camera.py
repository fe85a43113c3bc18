"""A pinhole depth camera: its file, and the mapping between pixels and points.

Camera axes: x right, y down, z forward, as OpenCV and TUM's RGB-D data have them.
"""

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from limber.core.errors import InputError
from limber.core.files.reading import checked_as, read_toml
from limber.core.numerics.rigid import rotation_matrix, rotation_vector

_MOST = 1e6
"""Largest number of a camera, whatever its unit; the smallest is one over it."""
_MOST_PIXELS = 100_000
_Pixels = Annotated[float, Field(ge=1 / _MOST, le=_MOST)]


class Camera(BaseModel):
    """Content of ``camera.toml``.

    ``pose`` takes camera coordinates to the branch's: position [m] and rotation vector [rad].
    A pixel's depth in metres is its value divided by ``depth_scale`` (5000 in TUM's data, 1000
    for millimetres). The noise of a stereo camera's depth is ``disparity_sigma_px z^2 / (fx b)``.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    width: int = Field(gt=0, le=_MOST_PIXELS)
    height: int = Field(gt=0, le=_MOST_PIXELS)
    fx: _Pixels
    fy: _Pixels
    cx: float = Field(ge=-_MOST, le=_MOST)
    cy: float = Field(ge=-_MOST, le=_MOST)
    depth_scale: float = Field(1000.0, ge=1 / _MOST, le=_MOST)
    baseline_m: float = Field(0.095, ge=1 / _MOST, le=_MOST)
    disparity_sigma_px: float = Field(0.08, gt=0, le=_MOST)
    pose: tuple[float, float, float, float, float, float] = (0.0,) * 6

    @field_validator("pose")
    @classmethod
    def _in_radians(cls, pose: tuple[float, ...]) -> tuple[float, ...]:
        if (turn := math.hypot(*pose[3:])) > 2 * math.pi + 1e-6:
            raise ValueError(f"it is turned by {turn:g} rad, more than a whole turn; was the "
                             "rotation given in degrees?")
        return pose

    @property
    def rotation(self) -> np.ndarray:
        return rotation_matrix(np.array(self.pose[3:]))

    @property
    def origin(self) -> np.ndarray:
        return np.array(self.pose[:3])

    def to_branch(self, points: np.ndarray) -> np.ndarray:
        """Take points [m] from camera to branch coordinates, shape [n, 3]."""
        return points @ self.rotation.T + self.origin

    def to_camera(self, points: np.ndarray) -> np.ndarray:
        """Take points [m] from branch to camera coordinates, shape [n, 3]."""
        return (points - self.origin) @ self.rotation

    def depth_sigma(self, depth: np.ndarray) -> np.ndarray:
        """Standard deviation [m] of a depth reading at ``depth`` [m]."""
        return self.disparity_sigma_px * depth**2 / (self.fx * self.baseline_m)

    def looking(self, *, eye: np.ndarray, target: np.ndarray,
                up: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> "Camera":
        """Return the camera at ``eye`` [m] with ``target`` [m] in the middle of its view."""
        forward = np.asarray(target, float) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        turn = np.column_stack([right, np.cross(forward, right), forward])
        pose = (*map(float, eye), *rotation_vector(turn))
        return self.model_copy(update={"pose": pose})


D455 = Camera(width=1280, height=720, fx=640.0, fy=640.0, cx=639.5, cy=359.5)
"""Intel RealSense D455 at its full depth resolution (87 degrees wide, 95 mm baseline)."""


@dataclass(frozen=True)
class SeenCloud:
    """Points [n, 3] [m] of one frame with ``sigma`` [n] [m] along the lines of sight, and ``view``
    [n, 3], unit vectors from the camera to them; all in the branch's frame."""

    points: np.ndarray
    sigma: np.ndarray
    view: np.ndarray


def depth_to_cloud(camera: Camera, depth: np.ndarray, mask: np.ndarray | None = None) -> SeenCloud:
    """Back-project a depth image [height, width] [m] (0 or NaN: no reading) where ``mask`` is True;
    None takes every reading. InputError if an image does not have the camera's size."""
    for name, image in (("depth image", depth), ("mask", mask)):
        if image is not None and image.shape != (camera.height, camera.width):
            raise InputError(f"The {name} has {image.shape[1]}x{image.shape[0]} pixels, but the "
                             f"camera has {camera.width}x{camera.height}.",
                             "Image and intrinsics must have the same size.",
                             "Give the intrinsics of this image, not those of the colour camera.")
    chosen = np.isfinite(depth) & (depth > 0)
    if mask is not None:
        chosen &= mask
    row, column = np.nonzero(chosen)
    z = depth[row, column].astype(float)
    ray = np.column_stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy,
                           np.ones(len(z))])
    length = np.linalg.norm(ray, axis=1)
    points = camera.to_branch(ray * z[:, None])
    view = (ray / length[:, None]) @ camera.rotation.T
    return SeenCloud(points, camera.depth_sigma(z) * length, view)


def project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pixel coordinates (column, row), shape [n, 2], and depths [m], shape [n]."""
    seen = camera.to_camera(points)
    depth = seen[:, 2]
    pixels = seen[:, :2] / depth[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return pixels, depth


def read_camera(path: Path) -> Camera:
    """Read ``camera.toml``. InputError if it is missing, or an entry is invalid, which it names."""
    what = "a file of camera intrinsics (depth images need it)"
    return checked_as(path, Camera, read_toml(path, what), what)


def write_camera(path: Path, camera: Camera) -> None:
    """Write ``camera.toml``."""
    import tomlkit

    Path(path).write_text(tomlkit.dumps(camera.model_dump(mode="json")), encoding="utf-8")


# Images of a depth camera: a common reader of depths and masks.

_PNG = b"\x89PNG\r\n\x1a\n"
LARGEST_PIXELS = 100_000_000
"""Most pixels of an image: no camera has more, and a small file may claim to."""


def read_pixels(path: Path, what: str) -> np.ndarray:
    """Return the pixels of an image, shape [height, width] or [height, width, channels]. InputError
    if the file is no image, or claims to be larger than any camera's."""
    from PIL import Image

    try:
        _check_chunks(path)
        with warnings.catch_warnings():
            # Its size is checked here.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path) as image:
                width, height = image.size
                if width * height > LARGEST_PIXELS:
                    raise ValueError(f"{width} x {height} pixels")
                return np.asarray(image.convert("L") if image.mode in ("1", "P") else image)
    except MemoryError:
        raise
    except Exception as error:  # Pillow's readers raise the errors of their parsers
        raise InputError(f"{path} cannot be read as an image ({error}).",
                         f"{what[0].upper()}{what[1:]} was expected.", "Check the file.",
                         ) from error


def read_mask(path: Path) -> np.ndarray:
    """Read a mask image; nonzero is branch. Returns shape [height, width] of bool."""
    pixels = read_pixels(path, "a mask")
    if pixels.ndim == 2:
        return pixels > 0
    colours = pixels.shape[2] - (pixels.shape[2] in (2, 4))  # opacity says nothing
    return pixels[..., :colours].max(axis=2) > 0


def _check_chunks(path: Path) -> None:
    """Refuse a PNG file that announces longer chunks than it has, before allocating memory."""
    size = path.stat().st_size
    with open(path, "rb") as stream:
        if stream.read(len(_PNG)) != _PNG:
            return
        while len(head := stream.read(8)) == 8:
            length = int.from_bytes(head[:4], "big")
            if stream.tell() + length > size:
                raise ValueError(f"the file announces a part of {length} bytes but has only {size} "
                                 "bytes")
            stream.seek(length + 4, 1)
