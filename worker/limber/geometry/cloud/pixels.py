"""Images of a depth camera: a common reader of depths and masks."""

import warnings
from pathlib import Path

import numpy as np

from limber.core.errors import InputError

_PNG = b"\x89PNG\r\n\x1a\n"
LARGEST_PIXELS = 100_000_000
"""Most pixels of an image: no camera has more, and a small file may claim to."""


def read_pixels(path: Path, what: str) -> np.ndarray:
    """Return the pixels of an image, shape [height, width] or [height, width, channels].

    Raises:
        InputError: the file cannot be read as an image, or claims to be larger than any camera's.
    """
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
