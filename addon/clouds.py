"""Reads the points of a scan, to show them; the worker reads the file itself."""

import itertools
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

_PLY_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4",
              "uint": "u4", "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1",
              "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4",
              "float64": "f8"}
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


_LINES = 20_000
"""Lines of text that are read at a stretch: numpy holds the interpreter meanwhile."""
# The worker's, of limber.geometry.io.text_clouds: the add-on reads files also without a worker.
_AXES = (("x", "y", "z"), ("points:0", "points:1", "points:2"), ("pos_x", "pos_y", "pos_z"),
         ("easting", "northing", "height"), ("easting", "northing", "elevation"),
         ("easting", "northing", "altitude"), ("easting", "northing", "z"))
_UNIT = re.compile(r"[\s_]*[\[(](m|cm|mm|in)[\])]$|_(m|cm|mm)$")
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")


def read_points(path: Path) -> np.ndarray:
    """Return the points of a PLY, XYZ, TXT or CSV file in its own unit, shape [n, 3].

    Raises:
        ValueError: the file is not readable as points; states what to do.
    """
    try:
        points = _read_ply(path) if path.suffix.lower() == ".ply" else _read_text(path)
    except (OSError, ValueError, IndexError, KeyError, StopIteration) as error:
        raise ValueError(f"{path} cannot be shown as points ({error}). The worker reads more file "
                         "formats, so it may still reconstruct this file.") from error
    if len(points) == 0 or not np.isfinite(points).all():
        raise ValueError(f"{path} has no points or has points that are not finite. Export the "
                         "scan again.")
    return points


def read_colours(path: Path) -> np.ndarray | None:
    """Return red, green, blue of a PLY file's points as bytes, shape [n, 3]; None without.

    Colours of other kinds of files, and those of ASCII files, are left to the worker.
    """
    if path.suffix.lower() != ".ply":
        return None
    rows = _binary_rows(path)
    names = ("red", "green", "blue")
    if rows is None or any(rows.dtype.fields.get(name, (None,))[0] != np.uint8 for name in names):
        return None
    return np.column_stack([rows[name] for name in names])


def _read_text(path: Path) -> np.ndarray:
    with open(path, encoding="utf-8-sig", errors="replace") as stream:
        lines = (line.replace('"', "") for line in stream if line.strip() and not _is_comment(line))
        first, second = next(lines, ""), next(lines, "")
        if not first:
            raise ValueError("it is empty")
        delimiter = _delimiter(second or first)
        columns, is_header = _columns(first, delimiter)
        # Some programs write the number of points first.
        is_count = bool(second) and first.strip().isdigit()
        rows = itertools.chain([] if is_header or is_count else [first],
                               [second] if second else [], lines)
        if delimiter != ",":
            rows = (line.replace(",", ".") for line in rows)
        return _rows(_even(rows, delimiter), delimiter=delimiter, usecols=columns)


def _even(lines: Iterable[str], delimiter: str | None) -> Iterator[str]:
    """Pass lines on while they have as many columns as the first: others are no table of points."""
    width = 0
    for line in lines:
        found = len(line.split(delimiter))
        width = width or found
        if found != width:
            raise ValueError(f"a line has {found} values, but the first line has {width}")
        yield line


def _columns(first: str, delimiter: str | None) -> tuple[tuple[int, ...], bool]:
    """Return which columns are x, y and z, and whether the first line is a header, as the worker
    takes them; ValueError where a header names other columns."""
    mark = delimiter if delimiter is None or delimiter in first else _delimiter(first)
    names = [_UNIT.sub("", name.lower().lstrip("/").strip()) for name in _parts(first, mark)]
    if not any(name[:1].isalpha() and name not in ("nan", "inf") for name in names):
        return (0, 1, 2), False
    for axes in _AXES:
        if set(axes) <= set(names):
            return tuple(names.index(axis) for axis in axes), True
    raise ValueError(f"its columns are {', '.join(names)[:200]}: x, y and z are missing")


def _is_comment(line: str) -> bool:
    start = line.lstrip()
    return start.startswith("#") or (start.startswith("//") and not start[2:3].isalpha())


def _delimiter(line: str) -> str | None:
    for mark in ";\t":
        if mark in line:
            return mark
    blanks = line.split()
    if len(blanks) > 2 and all(_DECIMAL_COMMA.fullmatch(part) for part in blanks):
        return None
    return "," if "," in line else None


def _parts(line: str, delimiter: str | None) -> list[str]:
    parts = [part.strip() for part in line.split(delimiter)]
    # Some programs end each line with a delimiter.
    return parts[:-1] if len(parts) > 3 and not parts[-1] else parts


def _rows(lines, **how) -> np.ndarray:
    """Return numbers of lines of text, a part at a time, shape [n, columns]."""
    parts = []
    lines = iter(lines)
    while part := list(itertools.islice(lines, _LINES)):
        if any(line.strip() for line in part):
            parts.append(np.loadtxt(part, ndmin=2, **how))
    return np.vstack(parts) if parts else np.empty((0, 3))


def _read_ply(path: Path) -> np.ndarray:
    rows = _binary_rows(path)
    if rows is not None:
        return np.column_stack([rows[axis].astype(float) for axis in "xyz"])
    with open(path, "rb") as stream:
        _, count, columns = _read_ply_header(stream)
        values = _rows(itertools.islice(stream, count))
    if len(values) < count:
        raise ValueError("it is truncated")
    names = [name for name, _ in columns]
    return values[:, [names.index(axis) for axis in "xyz"]]


def _binary_rows(path: Path) -> np.ndarray | None:
    """Return the vertices of a binary PLY file as a table; None of one in ASCII."""
    with open(path, "rb") as stream:
        order, count, columns = _read_ply_header(stream)
        if order == "=":
            return None
        kind = np.dtype([(name, order + code) for name, code in columns])
        if count * kind.itemsize > path.stat().st_size:
            raise ValueError("it is truncated")
        content = stream.read(count * kind.itemsize)
    if len(content) < count * kind.itemsize:
        raise ValueError("it is truncated after its header")
    return np.frombuffer(content, kind)


def _read_ply_header(stream) -> tuple[str, int, list[tuple[str, str]]]:
    """Return byte order, vertex count and the columns (name, numpy type) of the vertices."""
    if stream.readline().strip() != b"ply":
        raise ValueError("it does not begin with a PLY header")
    order, count, columns, element = "", 0, [], ""
    for line in iter(stream.readline, b""):
        words = line.decode("ascii", "replace").split()
        if words[:1] == ["format"]:
            order = _PLY_ORDERS[words[1]]
        elif words[:1] == ["element"]:
            if words[1] != "vertex" and not columns:
                raise ValueError("its first element is not the vertices")
            element = words[1]
            count = int(words[2]) if element == "vertex" else count
        elif words[:1] == ["property"] and element == "vertex":
            columns.append((words[2], _PLY_TYPES[words[1]]))
        elif words == ["end_header"]:
            return order, count, columns
    raise ValueError("its header has no end")
