"""Clouds as LAS and LAZ files."""

from pathlib import Path

import numpy as np

from limber.geometry.cloud.cloud import POINTS


def is_packed(path: Path) -> bool:
    """Whether it is LAZ, of which compiled code makes points; that aborts on mangled ones."""
    with open(path, "rb") as stream:
        return bool(stream.read(105)[104] & 0xC0)


def las_columns(path: Path) -> dict[str, np.ndarray]:
    """Return coordinates, ``color`` and the other dimensions of a LAS or LAZ file."""
    import laspy

    content = laspy.read(path)
    attributes = {}
    names = set(content.point_format.dimension_names)
    if {"red", "green", "blue"} <= names:
        color = np.stack([np.asarray(content[c]) for c in ("red", "green", "blue")], axis=1)
        # 16 bits a channel by the standard, though many programs write 8.
        attributes["color"] = color // 257 if color.max(initial=0) > 255 else color
    for name in sorted(names - {"X", "Y", "Z", "red", "green", "blue"}):
        values = np.asarray(content[name])
        if values.ndim == 1 and values.any():
            attributes[name] = values
    return {**attributes, POINTS: np.asarray(content.xyz, np.float64)}
