"""Clouds as COLMAP's ``points3D.bin``; its text format is read like other text."""

import struct
from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.core.files.reading import require_size
from limber.geometry.cloud.cloud import Cloud

_POINT = struct.Struct("<Q3d3BdQ")
_SEEN_BYTES = 8
"""For each image that saw a point: its number, and that of the point in it."""


def read_points3d(path: Path) -> Cloud:
    """Return the points of a reconstruction, in its own unit, with colour and error.

    Raises:
        InputError: the file is cut short.
    """
    raw = path.read_bytes()
    count, = struct.unpack_from("<Q", raw)
    require_size(path, float(count) * _POINT.size + 8, len(raw), f"{count} points")
    cut = InputError(f"{path} is cut short.", f"It announces {count} points.", "Export it again.")
    rows, at = np.empty((count, 7)), 8
    for row in rows:
        if at + _POINT.size > len(raw):
            raise cut
        _, *row[:], seen = _POINT.unpack_from(raw, at)
        at += _POINT.size + _SEEN_BYTES * seen
    if at > len(raw):
        raise cut
    return Cloud(rows[:, :3], {"color": rows[:, 3:6].astype(np.uint8), "error": rows[:, 6]})
