"""Reads the points of a scan, to show them; the worker reads the file itself."""

import itertools
from pathlib import Path

import numpy as np

from . import text_columns

_PLY_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4",
              "uint": "u4", "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1",
              "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4",
              "float64": "f8"}
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_FARTHEST = 1e15
"""Greatest coordinate in any unit; the same as the worker's."""
_LINES = 20_000
"""Lines of text that are read at once: numpy holds the interpreter meanwhile."""


def read_points(path: Path) -> tuple[np.ndarray, str | None]:
    """Return the points of a PLY or text file in its own unit, shape [n, 3], and that unit if the
    file states it.

    Points that are not finite are omitted, as in the worker.

    Raises:
        ValueError: the file is not readable as points; states what to do.
    """
    try:
        points, unit = _read_ply(path) if path.suffix.lower() == ".ply" else _read_text(path)
    except (OSError, ValueError, IndexError, KeyError, StopIteration) as error:
        raise ValueError(f"{path} cannot be shown as points ({error}). The worker reads more file "
                         "formats, so it may still reconstruct this file.") from error
    points = points[(np.abs(points) < _FARTHEST).all(axis=1)]
    if len(points) == 0:
        raise ValueError(f"{path} has no points, or none that are finite. Export the scan again.")
    return points, unit


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


def _read_text(path: Path) -> tuple[np.ndarray, str | None]:
    read = text_columns.read_columns(path)
    axes = text_columns.three_of("position", read.names)
    if axes is None:
        raise ValueError("x, y and z are missing")
    return read.values[:, list(axes)], read.unit


def _rows(lines, **how) -> np.ndarray:
    """Return the numbers in lines of text, in batches, shape [n, columns]."""
    parts = []
    lines = iter(lines)
    while part := list(itertools.islice(lines, _LINES)):
        if any(line.strip() for line in part):
            parts.append(np.loadtxt(part, ndmin=2, **how))
    return np.vstack(parts) if parts else np.empty((0, 3))


def _read_ply(path: Path) -> tuple[np.ndarray, str | None]:
    rows = _binary_rows(path)
    with open(path, "rb") as stream:
        _, count, columns = _read_ply_header(stream)
        end = stream.tell()
        stream.seek(0)
        unit = text_columns.stated_unit(stream.read(end).decode("utf-8", "replace"))
        names = [name for name, _ in columns]
        axes = text_columns.three_of("position", names)
        if axes is None:
            raise ValueError("x, y and z are missing")
        if rows is not None:
            return np.column_stack([rows[names[k]].astype(float) for k in axes]), unit
        values = _rows(itertools.islice(stream, count))
    if len(values) < count:
        raise ValueError("it is truncated")
    return values[:, list(axes)], unit


def _binary_rows(path: Path) -> np.ndarray | None:
    """Return the vertices of a binary PLY file as a table; None for an ASCII file."""
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
