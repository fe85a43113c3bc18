"""Depth images whose pixels cannot be distances are refused, with what was seen."""

import numpy as np
import pytest
from PIL import Image

from limber.core.errors import InputError
from limber.geometry.cloud.camera import Camera, write_camera
from limber.geometry.io.depth_images import read_depth

CAMERA = Camera(width=160, height=120, fx=190.0, fy=190.0, cx=79.5, cy=59.5)


def _depth() -> np.ndarray:
    """A bent rod of 8 mm radius, 0.5 to 0.62 m away [mm], shape [120, 160]; 0 beside it."""
    row, column = np.mgrid[:120, :160]
    off = (column - 80 - 10 * np.sin(row / 40)) / 190 * 0.55
    height = np.sqrt(np.maximum(0.008**2 - off**2, 0))
    depth = np.round(1000 * (0.5 + 0.001 * row - height)).astype(np.uint16)
    return np.where(np.abs(off) < 0.008, depth, 0).astype(np.uint16)


def _read(folder, pixels, camera=CAMERA, mask=None, name="depth.png"):
    image = pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)
    image.save(folder / name)
    write_camera(folder / "camera.toml", camera)
    if mask is not None:
        Image.fromarray(mask).save(folder / "mask.png")
    return read_depth(folder / name, folder / "camera.toml",
                      None if mask is None else folder / "mask.png")


def _stretched(most: float, *, kind: type = np.uint16) -> np.ndarray:
    depth = _depth().astype(float)
    low = depth[depth > 0].min()
    scaled = np.where(depth > 0, (depth - low) / (depth.max() - low) * most, 0)
    return scaled.astype(kind) if kind is np.float32 else np.round(scaled).astype(kind)


def _coloured() -> Image.Image:
    return Image.merge("RGB", [Image.fromarray(_stretched(255, kind=np.uint8))] * 3)


@pytest.mark.parametrize(("pixels", "seen"), [
    (np.minimum(_depth(), 255).astype(np.uint8), "8 bits a pixel.*255 to 255"),
    (np.minimum(_depth(), 255), "255 to 255, 255 in 1e\\+02 %"),
    (_stretched(255, kind=np.uint8), "8 bits a pixel"),
    (_stretched(255), "to 255"),
    (_stretched(255) * 257, "multiple of 257"),
    (_stretched(255) * 256, "two bytes"),
    (_coloured(), "3 channels of 8 bits"),
    (_coloured().convert("RGBA"), "4 channels"),
    (_depth().byteswap(), "two bytes of each exchanged"),
    (np.where(_depth() > 0, 700, 0).astype(np.uint16), "same value, 700"),
    (np.full((120, 160), 1200, np.uint16), "100 % .* same value, 1200"),
    (_depth() * 50, "24.* to 30.* m by the camera's depth_scale of 1000"),
    (_depth() // 10, "0.04.* to 0.06"),
], ids=lambda value: value if isinstance(value, str) else "")
def test_no_wood_is_made_of_values_that_are_no_distances(tmp_path, pixels, seen):
    with pytest.raises(InputError, match=seen):
        _read(tmp_path, pixels)


@pytest.mark.parametrize(("pixels", "scale", "seen"), [
    (_stretched(1.0, kind=np.float32), 1.0, "exactly 1"),
    ((_depth() / 1000).astype(np.float32), 1000.0, "depth_scale of 1000"),
    (_depth().astype(np.float32), 1.0, "depth_scale of 1")])
def test_floats_are_in_the_cameras_unit(tmp_path, pixels, scale, seen):
    camera = CAMERA.model_copy(update={"depth_scale": scale})
    with pytest.raises(InputError, match=seen):
        _read(tmp_path, pixels, camera, name="depth.tif")
    right = CAMERA.model_copy(update={"depth_scale": 1.0})
    cloud = _read(tmp_path, (_depth() / 1000).astype(np.float32), right, name="right.tif")
    assert 0.49 < cloud.points[:, 2].min() < cloud.points[:, 2].max() < 0.63


def test_what_the_mask_shows_is_judged(tmp_path):
    """Before a far background; clipped, saturated and normalised under the mask."""
    depth, mask = _depth(), (_depth() > 0).astype(np.uint8)
    far = np.where(depth > 0, depth, 12_000 + np.arange(160, dtype=np.uint16))
    assert len(_read(tmp_path, far, mask=mask)) == mask.sum()
    for wrong, seen in ((np.where(depth > 0, 65535, 900).astype(np.uint16), "same value, 65535"),
                        (_stretched(65535), "the largest of 16 bits"),
                        (np.minimum(depth, 560), "clipped there")):
        with pytest.raises(InputError, match=seen):
            _read(tmp_path, wrong, mask=mask)


@pytest.mark.parametrize(("change", "seen"), [
    ({"cx": 159.5, "cy": 119.5}, "an image of about 319x239"),
    ({"cx": 39.5, "cy": 29.5}, "an image of about 79x59"),
    ({"fx": 1.93, "fy": 1.93}, "in pixels of this image, not in millimetres"),
    ({"width": 320, "height": 240, "cx": 159.5, "cy": 119.5}, "160x120 .* camera has 320x240")])
def test_intrinsics_are_those_of_the_image(tmp_path, change, seen):
    with pytest.raises(InputError, match=seen):
        _read(tmp_path, _depth(), CAMERA.model_copy(update=change))


@pytest.mark.parametrize("pixels", [
    _depth(), (_depth().astype(np.int64) * 5).astype(np.uint16)], ids=["1000", "5000"])
def test_right_images_stay(tmp_path, pixels):
    scale = 1000.0 if pixels.max() < 1000 else 5000.0
    cloud = _read(tmp_path, pixels, CAMERA.model_copy(update={"depth_scale": scale}))
    assert len(cloud) == (_depth() > 0).sum()
    assert 0.49 < cloud.points[:, 2].min() < cloud.points[:, 2].max() < 0.63


def test_opacity_is_no_mask(tmp_path):
    """An opaque image shows nothing of the branch by that."""
    mask = np.zeros((120, 160, 4), np.uint8)
    mask[..., 3] = 255
    mask[40:60, :, 0] = 255
    shown = _read(tmp_path, _depth(), mask=mask)
    assert len(shown) == (_depth()[40:60] > 0).sum()
