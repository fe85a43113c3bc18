"""Reads the points of a scan, to show them; the worker reads the file itself."""

import itertools
from pathlib import Path

import numpy as np

from .. import text_columns

_PLY_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4",
              "uint": "u4", "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1",
              "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4",
              "float64": "f8"}
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_FARTHEST = 1e15
"""Greatest coordinate in any unit; the same as the worker's."""
_LINES = 20_000
"""Lines of text that are read at once: numpy holds the interpreter meanwhile."""


def read_points(path: Path) -> tuple[np.ndarray, str | None, np.ndarray | None]:
    """Return the points of a PLY or text file in its own unit, shape [n, 3], that unit if the file
    states it, and red, green and blue as bytes, shape [n, 3], if it has them.

    Points that are not finite are omitted, as in the worker.

    Raises:
        ValueError: the file is not readable as points; states what to do.
    """
    try:
        names, values, unit = (_read_ply if path.suffix.lower() == ".ply" else _read_text)(path)
        axes, shades = (text_columns.three_of(role, names) for role in ("position", "color"))
        if axes is None:
            raise ValueError("x, y and z are missing")
        points = np.column_stack([values[k].astype(float) for k in axes])
    except (OSError, ValueError, IndexError, KeyError, StopIteration) as error:
        raise ValueError(f"{path} cannot be shown as points ({error}). The worker reads more file "
                         "formats, so it may still reconstruct this file.") from error
    is_there = (np.abs(points) < _FARTHEST).all(axis=1)
    if not is_there.any():
        raise ValueError(f"{path} has no points, or none that are finite. Export the scan again.")
    colours = None if shades is None else _bytes(np.column_stack([values[k] for k in shades]))
    return points[is_there], unit, None if colours is None else colours[is_there]


def _bytes(colours: np.ndarray) -> np.ndarray:
    """Colours as bytes; files have bytes, 16 bits, or fractions of 1."""
    top = colours.max(initial=0)
    is_fraction = colours.dtype.kind == "f" and top < 1.01
    scaled = colours * (255.0 if is_fraction else 1 / 257 if top > 255 else 1.0)
    return np.clip(np.nan_to_num(np.round(scaled)), 0, 255).astype(np.uint8)


def _read_text(path: Path) -> tuple[list[str], list[np.ndarray], str | None]:
    read = text_columns.read_columns(path)
    return read.names, list(read.values.T), read.unit


def _rows(lines, **how) -> np.ndarray:
    """Return the numbers in lines of text, in batches, shape [n, columns]."""
    parts = []
    lines = iter(lines)
    while part := list(itertools.islice(lines, _LINES)):
        if any(line.strip() for line in part):
            parts.append(np.loadtxt(part, ndmin=2, **how))
    return np.vstack(parts) if parts else np.empty((0, 3))


def _read_ply(path: Path) -> tuple[list[str], list[np.ndarray], str | None]:
    with open(path, "rb") as stream:
        order, count, columns = _read_ply_header(stream)
        begin = stream.tell()
        kind = np.dtype([(name, order + code) for name, code in columns])
        if count > path.stat().st_size:
            raise ValueError("it is truncated")
        if order == "=":
            # RealSense's Viewer writes position, normal and colour of a vertex on a line each.
            parts = max(len(columns) // max(len(stream.readline().split()), 1), 1)
            stream.seek(begin)
            rows = _rows(itertools.islice(stream, count * parts))
            values = [column.astype(code) for column, (_, code) in zip(
                rows.reshape(-1, parts * rows.shape[1]).T, columns, strict=False)]
        else:
            content = stream.read(min(count * kind.itemsize, path.stat().st_size))
            rows = np.frombuffer(content, kind, len(content) // kind.itemsize)
            values, parts = [rows[name] for name, _ in columns], 1
        if len(rows) < count * parts:
            raise ValueError("it is truncated")
        stream.seek(0)
        unit = text_columns.stated_unit(stream.read(begin).decode("utf-8", "replace"))
    return [name for name, _ in columns], values, unit


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
