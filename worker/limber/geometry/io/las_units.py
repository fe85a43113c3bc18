"""Units of LAS and LAZ files, from the records of their coordinate system.

Without a table of coordinate systems: only units that the records spell out are known.
"""

import math
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import InputError
from limber.geometry.cloud.cloud import Cloud

METRES = "\0metres"
"""Name of the units [2] among the columns of a reader, see :func:`stated_metres`."""
_DEGREES = 0.0
_CODES = {9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937}
"""Metres by the EPSG code of a unit: metre, foot, US survey foot."""
_MODEL, _GEOGRAPHIC, _HORIZONTAL, _VERTICAL = 1024, 2, 3076, 4099
"""GeoTIFF keys: model type, its value for degrees; units of plane and height."""
_NESTED = r'\["[^"]*"(?:[^\[\]]|\[(?:[^\[\]]|\[[^\[\]]*\])*\])*\]'
_BESIDE = re.compile(rf"(?:ELLIPSOID|SPHEROID|PARAMETER|PRIMEM){_NESTED}")
"""Parts of a WKT whose units are not those of the coordinates."""
_UNIT = re.compile(r'(?:LENGTH)?UNIT\["([^"]*)",\s*([\d.eE+-]+)')
_HEIGHTS = re.compile(r"VERT_CS|VERTCRS|VERTICALCRS")


def stated_metres(records: Iterable[Any]) -> np.ndarray:
    """Return what one unit of x and y, and of z, is in metres, shape [2].

    NaN stands for an unknown unit, 0 for degrees.

    Args:
        records: The variable length records that laspy read.
    """
    found = np.full(2, np.nan)
    for record in records:
        if getattr(record, "string", ""):
            return _of_text(record.string)
        keys = {key.id: key.value_offset for key in getattr(record, "geo_keys", ())}
        if keys.get(_MODEL) == _GEOGRAPHIC:
            return np.array([_DEGREES, np.nan])
        if keys:
            found = np.array([_CODES.get(keys.get(key, 0), np.nan)
                              for key in (_HORIZONTAL, _VERTICAL)])
    return found


def _of_text(text: str) -> np.ndarray:
    """The units of a coordinate system in WKT, version 1 or 2."""
    plane, *height = _HEIGHTS.split(_BESIDE.sub("", text), maxsplit=1)
    if re.search(r"GEOG(?:CS|CRS|RAPHICCRS)|GEODCRS", plane) and not re.search(
            r"PROJ(?:CS|CRS|ECTEDCRS)", plane):
        return np.array([_DEGREES, np.nan])
    return np.array([_length_unit(part) for part in (plane, "".join(height))])


def _length_unit(text: str) -> float:
    sizes = [float(size) for name, size in _UNIT.findall(text)
             if re.search(r"met(?:er|re)|foot|feet|\bft", name, re.IGNORECASE)]
    return sizes[-1] if sizes and 1e-4 < sizes[-1] < 1e4 else math.nan


def in_metres(path: Path, cloud: Cloud, metres: np.ndarray) -> Cloud:
    """Return the points of a LAS file in metres, if its units are known.

    Raises:
        InputError: the coordinates are degrees.
    """
    plane, height = metres
    if plane == _DEGREES:
        raise InputError(f"{path} has its coordinates in degrees of longitude and latitude.",
                         "A branch needs lengths.",
                         "Export it in a projected coordinate system, in metres.")
    if not np.isfinite(plane):
        return cloud
    # A coordinate system without heights leaves them in the unit of the plane.
    height = height if np.isfinite(height) else plane
    notes = () if plane == height == 1 else (
        f"The file states that its coordinates have a unit of {plane:.6g} m, its heights of "
        f"{height:.6g} m. They were converted to metres.",)
    return replace(cloud, points=cloud.points * [plane, plane, height], unit="m",
                   notes=(*cloud.notes, *notes))
