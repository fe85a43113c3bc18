"""Clouds as LAS and LAZ files."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from limber.geometry.cloud.cloud import LEFT_OUT, POINTS, Cloud
from limber.geometry.cloud.piecewise_reading import PIECE_POINTS, gathered
from limber.geometry.io.las_units import METRES, stated_metres


def is_packed(path: Path) -> bool:
    """Whether the file is LAZ, whose points compiled code decodes; it aborts on corrupt ones."""
    with open(path, "rb") as stream:
        return bool(stream.read(105)[104] & 0xC0)


def las_columns(path: Path) -> dict[str, np.ndarray]:
    """Return coordinates, ``color``, the other dimensions, and units of a LAS or LAZ file."""
    import laspy

    cloud = gathered(_pieces(path))
    with laspy.open(path) as reader:
        metres = stated_metres([*reader.header.vlrs, *(reader.evlrs or ())])
    attributes = {name: values for name, values in cloud.attributes.items()
                  if name == "color" or values.any()}
    if "color" in attributes and attributes["color"].max(initial=0) > 255:
        # 16 bits per channel by the standard, though many programs write 8.
        attributes["color"] = attributes["color"] // 257
    return {**attributes, POINTS: cloud.points, LEFT_OUT: np.array(cloud.left_out),
            METRES: metres}


def _pieces(path: Path) -> Iterator[Cloud]:
    import laspy

    with laspy.open(path) as reader:
        dimensions = reader.header.point_format
        names = set(dimensions.dimension_names)
        has_color = {"red", "green", "blue"} <= names
        others = sorted(names - {"X", "Y", "Z", "red", "green", "blue"})
        if reader.header.point_count == 0:
            yield Cloud(np.empty((0, 3)))
        for part in reader.chunk_iterator(PIECE_POINTS):
            attributes = {}
            if has_color:
                attributes["color"] = np.stack(
                    [np.asarray(part[c]) for c in ("red", "green", "blue")], axis=1)
            attributes |= {name: values for name in others
                           if (values := np.asarray(part[name])).ndim == 1}
            points = np.stack([np.asarray(getattr(part, axis), np.float64) for axis in "xyz"],
                              axis=1)
            yield Cloud(points, attributes)
