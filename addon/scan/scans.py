"""A scan as it is shown, read by a thread while the interface stays usable. No bpy here.

A million points take most of a second.
"""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..branch import branch_folder
from . import clouds


@dataclass(frozen=True)
class Scan:
    """A scan to be shown.

    Attributes:
        points: Points in the scan's own unit, ``offset`` subtracted, float32, shape [n, 3].
        offset: Integers [3]: map coordinates would lose their last digits in a viewport.
        colours: Red, green, blue, alpha from 0 to 1 in sRGB, float32, [n, 4], if it has any.
        extent: Its longest side, in its own unit.
        sha256: Checksum of the file. folder: Its own branch folder, existing or not.
        unit: Unit that the file states, if any.
    """

    points: np.ndarray
    offset: np.ndarray
    extent: float
    sha256: str
    folder: Path
    colours: np.ndarray | None = None
    unit: str | None = None


def read_scan(path: Path) -> Scan:
    """Read the shown data of a scan; ValueError as :func:`.clouds.read_points`."""
    points, unit, colours = clouds.read_points(path)
    low, high = points.min(axis=0), points.max(axis=0)
    middle = np.round((low + high) / 2)
    is_far = np.abs(middle).max() > 100 * max((high - low).max(), 1e-9)
    offset = middle if is_far else np.zeros(3)
    if colours is not None:
        colours = np.column_stack([colours / np.float32(255), np.ones(len(colours), np.float32)])
    return Scan((points - offset).astype(np.float32), offset, float((high - low).max()),
                branch_folder.file_sha256(path),
                branch_folder.folder_for(path), colours, unit)


_reader = ThreadPoolExecutor(1)


def reading(path: Path) -> Future[Scan]:
    """Begin to read a scan; ask whether it is done, then for its result."""
    return _reader.submit(read_scan, path)
