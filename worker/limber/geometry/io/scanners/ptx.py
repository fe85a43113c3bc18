"""Clouds as Leica's PTX files: grids of points, each scan with the pose of its scanner."""

from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.core.files.text_columns import decoded
from limber.geometry.cloud.cloud import Cloud

_HEAD = 10
"""Lines above the points of a scan: columns, rows, position, three axes, a matrix of four rows."""


def read_ptx(path: Path) -> Cloud:
    """Return the points of all scans [m] in their common frame, with intensity and colour.

    Raises:
        InputError: a scan is cut short, or a header or a line of it is invalid.
    """
    lines = [line for line in decoded(path.read_bytes()).splitlines() if line.strip()]
    scans, start = [], 0
    while start < len(lines):
        count, matrix = _header(path, lines[start:start + _HEAD], start)
        rows = lines[start + _HEAD:start + _HEAD + count]
        if len(rows) < count:
            raise InputError(f"{path}: the scan at line {start + 1} announces {count} points, but "
                             f"{len(rows)} lines follow.", "The file is cut short.",
                             "Export it again.")
        scans.append(_scan(path, rows, matrix))
        start += _HEAD + count
    width = min((scan.shape[1] for scan in scans), default=0)
    if width < 3:
        raise InputError(f"{path} has no scan.", "A PTX file begins with the numbers of columns "
                         "and rows of its first scan.", "Export it again.")
    table = np.concatenate([scan[:, :width] for scan in scans])
    # A direction without an echo is a point at the scanner itself.
    seen = np.isfinite(table[:, 0])
    attributes = {"intensity": table[seen, 3]} if width > 3 else {}
    if width >= 7:
        attributes["color"] = table[seen, 4:7]
    return Cloud(table[seen, :3], attributes, not_finite=int((~seen).sum()), unit="m")


def _header(path: Path, head: list[str], start: int) -> tuple[int, np.ndarray]:
    """Points of a scan and its matrix [4, 4] from points as rows to the common frame."""
    try:
        columns, rows = int(head[0]), int(head[1])
        matrix = np.array([[float(word) for word in line.split()] for line in head[6:_HEAD]])
        if matrix.shape != (4, 4) or min(columns, rows) < 1 or not np.isfinite(matrix).all():
            raise ValueError
    except (ValueError, IndexError):
        raise InputError(f"{path}, line {start + 1}: the header of a scan was expected.",
                         "It has the numbers of columns and rows, the scanner's position and axes, "
                         "and a matrix of four rows.", "Export it again.") from None
    return columns * rows, matrix


def _scan(path: Path, rows: list[str], matrix: np.ndarray) -> np.ndarray:
    """Points in the common frame and the other values of a line; NaN where there was no echo."""
    try:
        table = np.loadtxt(rows, ndmin=2)
    except ValueError as error:
        raise InputError(f"{path}: a scan's points are not a table of numbers ({error}).",
                         "The file is damaged.", "Export it again.") from error
    silent = ~table[:, :3].any(axis=1)
    table[:, :3] = table[:, :3] @ matrix[:3, :3] + matrix[3, :3]
    table[silent, :3] = np.nan
    return table
