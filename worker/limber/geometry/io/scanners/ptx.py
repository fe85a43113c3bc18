"""Clouds as Leica's PTX files: grids of points, each scan with the pose of its scanner."""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from limber.core.errors import InputError
from limber.core.files.text_columns import LINES_AT_ONCE, coding_of, lines_of
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.piecewise_reading import gathered

_MOST = 10**9
"""Most rows or columns of a scanner's grid."""
_HEAD = 10
"""Lines above the points of a scan: columns, rows, position, three axes, a matrix of four rows."""


class _Scan(NamedTuple):
    """A scan: the number of its points, the matrix [4, 4] from points as rows to the common frame,
    and the number of its columns.
    """

    size: int
    matrix: np.ndarray
    width: int


def read_ptx(path: Path) -> Cloud:
    """Return the points of all scans [m] in their common frame, with intensity and colour.

    Of more than :data:`~limber.geometry.cloud.piecewise_reading.MOST_POINTS`, one in
    each cell of a grid is kept.

    Raises:
        InputError: a scan is cut short, or a header or a line of it is invalid.
    """
    coding = coding_of(path)
    scans = _scans(path, coding)
    width = min((scan.width for scan in scans), default=0)
    if width < 3:
        raise InputError(f"{path} has no scan.", "A PTX file begins with the numbers of columns "
                         "and rows of its first scan.", "Export it again.")
    return replace(gathered(_pieces(path, coding, scans, width)), unit="m")


def _lines(path: Path, coding: str) -> Iterator[str]:
    return filter(str.strip, lines_of(path, coding))


def _scans(path: Path, coding: str) -> list[_Scan]:
    """The headers of all scans."""
    lines, start, scans = _lines(path, coding), 0, []
    while head := list(itertools.islice(lines, _HEAD)):
        count, matrix = _header(path, head, start)
        first = next(lines, None)
        found = 0 if first is None else 1 + sum(1 for _ in itertools.islice(lines, count - 1))
        if first is None or found < count:
            raise InputError(f"{path}: the scan at line {start + 1} announces {count} points, but "
                             f"{found} lines follow.", "The file is cut short.",
                             "Export it again.")
        scans.append(_Scan(count, matrix, len(first.split())))
        start += _HEAD + count
    return scans


def _pieces(path: Path, coding: str, scans: list[_Scan], width: int) -> Iterator[Cloud]:
    """The points of some lines after the other, with ``width`` of their columns."""
    lines = _lines(path, coding)
    for scan in scans:
        rows = itertools.islice(lines, _HEAD, _HEAD + scan.size)
        while some := list(itertools.islice(rows, LINES_AT_ONCE)):
            table = _table(path, some, scan)
            # A direction without an echo is a point at the scanner itself.
            seen = np.isfinite(table[:, 0])
            attributes = {"intensity": table[seen, 3]} if width > 3 else {}
            if width >= 7:
                attributes["color"] = table[seen, 4:7]
            yield Cloud(table[seen, :3], attributes, not_finite=int((~seen).sum()))


def _header(path: Path, head: list[str], start: int) -> tuple[int, np.ndarray]:
    """Points of a scan and its matrix [4, 4] from points as rows to the common frame."""
    try:
        columns, rows = int(head[0]), int(head[1])
        matrix = np.array([[float(word) for word in line.split()] for line in head[6:_HEAD]])
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or (
                min(columns, rows) < 1 or max(columns, rows) > _MOST):
            raise ValueError
    except (ValueError, IndexError):
        raise InputError(f"{path}, line {start + 1}: the header of a scan was expected.",
                         "It has the numbers of columns and rows, the scanner's position and axes, "
                         "and a matrix of four rows.", "Export it again.") from None
    return columns * rows, matrix


def _table(path: Path, rows: list[str], scan: _Scan) -> np.ndarray:
    """Points in the common frame and the other values of a line; NaN where there was no echo."""
    try:
        table = np.loadtxt(rows, ndmin=2)
        if table.shape[1] != scan.width:
            raise ValueError(f"{table.shape[1]} columns instead of {scan.width}")
    except ValueError as error:
        raise InputError(f"{path}: a scan's points are not a table of numbers ({error}).",
                         "The file is damaged.", "Export it again.") from error
    silent = ~table[:, :3].any(axis=1)
    table[:, :3] = table[:, :3] @ scan.matrix[:3, :3] + scan.matrix[3, :3]
    table[silent, :3] = np.nan
    return table
