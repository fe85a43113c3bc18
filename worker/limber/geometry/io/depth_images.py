"""Depth images: read into metres, and refused where their pixels cannot be distances."""

from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.geometry.cloud.camera import Camera, depth_to_cloud, read_camera, read_mask, read_pixels
from limber.geometry.cloud.cloud import Cloud

NEAREST_M, FARTHEST_M = 0.1, 10.0
"""Distances of a plant from a depth camera: nearer none measures, farther none shows a twig."""
_ENOUGH = 200  # readings from which their distribution is judged
_WHY = "A depth image has one channel of 16 bits, or of floats, and a distance in each pixel."
_EXPORT = ("Export the depth itself, not a picture of it: a 16-bit PNG, each value divided by "
           "depth_scale in camera.toml in metres.")


def read_depth(depth_path: Path, camera_path: Path, mask_path: Path | None = None) -> Cloud:
    """Back-project a 16-bit depth image into metres in the frame of the camera's pose, where the
    mask is over 0; None takes every reading. InputError if the files do not belong together."""
    camera = read_camera(camera_path)
    mask = None if mask_path is None else read_mask(mask_path)
    depth = depth_metres(depth_path, camera, mask)
    seen = depth_to_cloud(camera, depth, mask)
    if len(seen.points) == 0:
        raise InputError(f"{depth_path} has no reading within the mask.",
                         "A cloud needs depths greater than 0.",
                         "Check the mask and the depth image.")
    return Cloud(seen.points, {"sigma": seen.sigma}, unit="m")


def depth_metres(path: Path, camera: Camera, mask: np.ndarray | None = None) -> np.ndarray:
    """Read a depth image into metres, shape [height, width]; 0 or NaN means no reading. ``mask`` is
    True on the branch. InputError states what was seen if these cannot be distances."""
    pixels = read_pixels(path, "a 16-bit depth image (PNG)")
    _check_kind(path, pixels)
    _check_centre(camera)
    depth = pixels / camera.depth_scale
    chosen = np.isfinite(depth) & (depth > 0)
    whole = pixels[chosen]
    if len(whole):
        _check_bytes(path, pixels, chosen)
        _check_range(path, whole)
    if mask is not None and mask.shape == pixels.shape:
        chosen &= mask
    if chosen.any():
        _check_values(path, pixels[chosen], masked=mask is not None)
        _check_distances(path, depth[chosen], camera, masked=mask is not None)
    return depth


def _check_kind(path: Path, pixels: np.ndarray) -> None:
    """Refuse colours and 8 bits."""
    if pixels.ndim != 2:
        raise InputError(f"{path} has {pixels.shape[2]} channels of {8 * pixels.itemsize} bits: "
                         "it is a colour picture, or depth shown in colours.", _WHY, _EXPORT)
    if pixels.itemsize == 1:
        values = np.unique(pixels[pixels > 0])
        seen = (f"{len(values)} different values, {values[0]} to {values[-1]}" if len(values)
                else "0 in all pixels")
        raise InputError(f"{path} has 8 bits a pixel ({seen}).",
                         f"{_WHY} In 8 bits, distances are clipped or scaled to 255 steps.",
                         _EXPORT)


def _check_bytes(path: Path, pixels: np.ndarray, chosen: np.ndarray) -> None:
    """Refuse 16-bit values whose neighbours agree only after their two bytes are exchanged."""
    if pixels.dtype.kind == "f" or pixels.max() > 0xFFFF or pixels.min() < 0:
        return
    values = pixels.astype(np.int64)
    swapped = (values & 0xFF) << 8 | values >> 8
    beside = chosen[:, 1:] & chosen[:, :-1]
    steps, exchanged = (np.abs(np.diff(image, axis=1))[beside] for image in (values, swapped))
    differ = steps > 0
    # Edges of flat pieces alone show nothing; on a surface, most of the steps are the low byte's.
    if differ.sum() >= max(_ENOUGH, 0.1 * len(steps)) and np.mean(
            exchanged[differ] < steps[differ]) > 0.75 and 2 * exchanged.sum() < steps.sum():
        raise InputError(
            f"{path}: values of neighbouring pixels differ by {steps.mean():.0f} on average, and "
            f"by {exchanged.mean():.1f} with the two bytes of each exchanged.",
            "The bytes were written in the wrong order: a surface is smooth.",
            "Export it again, or exchange the bytes (numpy: image.byteswap()).")


def _check_range(path: Path, values: np.ndarray) -> None:
    """Refuse values that were scaled to the whole range of a picture."""
    most = float(values.max())
    if len(values) < _ENOUGH:
        return
    if values.dtype.kind == "f":
        if most == 1.0 and values.min() < 0.1:
            raise InputError(f"{path} has floats of {values.min():.3g} to exactly 1.",
                             "It was normalised: the distances are lost.", _EXPORT)
    elif np.all(values % 257 == 0):
        raise InputError(f"{path}: every value is a multiple of 257, up to {most:.0f}.",
                         "It is a picture of 8 bits that was stretched to 16.", _EXPORT)
    elif most == 255 and (np.mean(values == 255) > 0.01 or values.min() < 50):
        raise InputError(
            f"{path} has values of {values.min()} to 255, 255 in "
            f"{100 * np.mean(values == 255):.2g} % of the pixels that have a reading.",
            "It was clipped or normalised to 8 bits.", _EXPORT)


def _check_values(path: Path, values: np.ndarray, *, masked: bool) -> None:
    """Refuse the same value on all pixels, or on many as the largest."""
    if len(values) < _ENOUGH:
        return
    found, counts = np.unique(values, return_counts=True)
    where = "within the mask" if masked else "that have a reading"
    if counts.max() > 0.95 * len(values):
        raise InputError(
            f"{path}: {100 * counts.max() / len(values):.3g} % of the {len(values)} pixels {where} "
            f"have the same value, {found[counts.argmax()]:g}.",
            "No plant is that flat: the image was clipped, or is a mask.", _EXPORT)
    if masked and values.dtype.kind != "f" and found[-1] == 0xFFFF:
        raise InputError(
            f"{path}: {counts[-1]} pixels {where} have the value 65535, the largest of 16 bits.",
            "They are out of the camera's range, or the image was normalised.",
            "If they have no reading, write 0 there. If the image was normalised, export the "
            "depth itself.")
    if masked and counts[-1] > 0.2 * len(values) and counts[-1] > 5 * counts[:-1].max():
        raise InputError(
            f"{path}: {100 * counts[-1] / len(values):.2g} % of the pixels {where} have the "
            f"largest value, {found[-1]:g}.", "The depth was clipped there.", _EXPORT)


def _check_distances(path: Path, depth: np.ndarray, camera: Camera, *, masked: bool) -> None:
    """Refuse distances at which no depth camera shows a plant."""
    share = float(np.mean((depth >= NEAREST_M) & (depth <= FARTHEST_M)))
    # Without a mask the branch may be few of the pixels, before a far background.
    if share >= (0.5 if masked else 1e-3):
        return
    middle = float(np.median(depth))
    raise InputError(
        f"{path}: its values, {middle * camera.depth_scale:g} in the middle, are distances of "
        f"{depth.min():.3g} to {depth.max():.3g} m by the camera's depth_scale of "
        f"{camera.depth_scale:g}.",
        f"A depth camera shows a plant from {NEAREST_M:g} to {FARTHEST_M:g} m.",
        "State in camera.toml how many steps of a value make a metre (depth_scale = 1000 for "
        "millimetres, 1 for metres); if it is right, export the image again.")


def _check_centre(camera: Camera) -> None:
    """Refuse intrinsics of an image of another size, by the axis and the angle of view."""
    across, down = 2 * camera.cx / camera.width, 2 * camera.cy / camera.height
    if min(across, down) > 1.4 or max(across, down) < 0.7:
        raise InputError(
            f"The camera's axis (cx {camera.cx:g}, cy {camera.cy:g}) is far from the middle of its "
            f"image of {camera.width}x{camera.height} pixels.",
            f"These intrinsics belong to an image of about {2 * camera.cx:.0f}x"
            f"{2 * camera.cy:.0f} pixels.",
            "Give those of this image in camera.toml. Instead of a cropped image, give the whole "
            "one with a mask.")
    angles = [2 * np.degrees(np.arctan(size / 2 / focal)) for size, focal in (
        (camera.width, camera.fx), (camera.height, camera.fy))]
    if max(angles) > 150:
        raise InputError(
            f"By fx {camera.fx:g} and fy {camera.fy:g} pixels, the camera sees {angles[0]:.3g} by "
            f"{angles[1]:.3g} degrees.", "No depth camera does.",
            "Give the focal lengths in pixels of this image, not in millimetres.")
