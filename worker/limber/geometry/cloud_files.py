"""Readers of point clouds: PLY, PCD, XYZ/TXT/CSV, LAS/LAZ, OBJ/STL/OFF vertices, NPZ.

All give coordinates as the file has them, as float64, and keep normals, colours and scalars.
"""

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np

from limber.errors import InputError, MissingDependencyError
from limber.geometry.cloud import Cloud

_AXES = (("x", "y", "z"), ("points:0", "points:1", "points:2"), ("X", "Y", "Z"),
         ("//X", "Y", "Z"))
_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"), ("Nx", "Ny", "Nz"))
_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("R", "G", "B"))


def read_points(path: Path) -> Cloud:
    """Read a cloud, in the file's own units.

    Raises:
        InputError: the file is missing, empty, cut short, of an unknown format, holds text where
            numbers belong, or has coordinates that are not finite.
        MissingDependencyError: the format needs a package that is not installed.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"There is no file {path}.", "A point cloud was expected.",
                         "Check the path.")
    if path.is_dir():
        raise InputError(f"{path} is a folder.", "A point cloud file was expected.",
                         "Name a file; a folder of scans is for `limber reconstruct --batch`.")
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        known = " ".join(sorted(READERS))
        raise InputError(f"{path.name} has a suffix that is not known.",
                         f"Known are: {known}.", "Export the cloud as one of these.")
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty.", "A point cloud was expected.", "Export it again.")
    try:
        cloud = reader(path)
    except InputError:
        raise
    except ImportError as error:
        raise MissingDependencyError(
            f"Reading {path.suffix} needs the package {error.name}.", "It is not installed.",
            "Install it, or export the cloud as PLY.") from error
    except MemoryError:
        raise
    except Exception as error:  # each format's package raises its own
        raise InputError(f"{path} cannot be read ({type(error).__name__}: {error}).",
                         "It is damaged, cut short, or not what its suffix says.",
                         "Export it again.") from error
    return _checked(path, cloud)


def _checked(path: Path, cloud: Cloud) -> Cloud:
    if len(cloud) == 0:
        raise InputError(f"{path} has no points.", "A point cloud was expected.",
                         "Export it again.")
    finite = np.isfinite(cloud.points).all(axis=1)
    if not finite.all():
        first = int(np.flatnonzero(~finite)[0])
        raise InputError(
            f"{path}: {int((~finite).sum())} of {len(cloud)} points are not finite, the first is "
            f"number {first + 1}.", "Coordinates must be numbers; NaN and infinity are not.",
            "Remove those points where the cloud was made.")
    return cloud


def _from_columns(names: list[str], columns: dict[str, np.ndarray]) -> Cloud:
    """Sort named columns into positions, normals, colours and scalars."""
    axes = next((a for a in _AXES if all(name in columns for name in a)), None)
    if axes is None:
        raise InputError(f"There are columns {', '.join(names)}.", "x, y and z are missing.",
                         "Name the coordinates x, y, z.")
    used = set(axes)
    attributes: dict[str, np.ndarray] = {}
    for target, choices in (("normal", _NORMALS), ("color", _COLORS)):
        found = next((c for c in choices if all(name in columns for name in c)), None)
        if found:
            attributes[target] = np.stack([columns[name] for name in found], axis=1)
            used |= set(found)
    for name in names:
        if name not in used and columns[name].ndim == 1:
            attributes[name] = np.ascontiguousarray(columns[name])
    points = np.stack([np.asarray(columns[name], np.float64) for name in axes], axis=1)
    return Cloud(points, attributes)


def _read_ply(path: Path) -> Cloud:
    from plyfile import PlyData

    content = PlyData.read(str(path))
    if "vertex" not in content:
        raise InputError(f"{path} has no vertices.", "A cloud is an element `vertex`.",
                         "Export it again.")
    table = content["vertex"].data
    names = list(table.dtype.names)
    scalar = {name: np.asarray(table[name]) for name in names if table.dtype[name].kind in "iuf"}
    return _from_columns([name for name in names if name in scalar], scalar)


def _read_pcd(path: Path) -> Cloud:
    from pypcd4 import PointCloud

    content = PointCloud.from_path(path)
    names = [name for name in content.fields if name != "_"]
    columns = {name: np.asarray(content.pc_data[name]).ravel() for name in names}
    if "rgb" in columns:
        packed = columns.pop("rgb")
        packed = packed.view(np.uint32) if packed.dtype == np.float32 else packed.astype(np.uint32)
        columns |= {"r": packed >> 16 & 255, "g": packed >> 8 & 255, "b": packed & 255}
        names = [name for name in names if name != "rgb"] + ["r", "g", "b"]
    cloud = _from_columns(names, columns)
    if content.metadata.height > 1:
        # In an organised cloud NaN is the format's own word for "nothing seen in this pixel".
        return cloud.subset(np.isfinite(cloud.points).all(axis=1))
    return cloud


def _read_text(path: Path) -> Cloud:
    """XYZ, TXT, CSV: numbers separated by blanks, tabs, commas or semicolons; a header may be."""
    text = path.read_text(encoding="utf-8", errors="replace").lstrip("\ufeff")
    lines = [line for line in text.splitlines() if line.strip() and not _is_comment(line)]
    if not lines:
        raise InputError(f"{path} has no lines with numbers.", "A point cloud was expected.",
                         "Export it again.")
    separator = next((s for s in (";", ",", "\t") if s in lines[0]), None)
    names = _header(lines[0], separator)
    if names:
        lines = lines[1:]
    elif len(lines) > 1 and lines[0].split(separator)[0].strip().isdigit() and len(
            lines[0].split(separator)) == 1:
        lines = lines[1:]  # some programs write the number of points first
    table = _numbers(path, lines, separator, text)
    if table.shape[1] < 3:
        raise InputError(f"{path} has {table.shape[1]} columns.",
                         "Coordinates need three.", "Export it again.")
    if not names or len(names) != table.shape[1]:
        names = ["x", "y", "z", *_guessed(table.shape[1] - 3)]
    lowered = [name.lower() for name in names]
    return _from_columns(lowered, {name: table[:, k] for k, name in enumerate(lowered)})


def _is_comment(line: str) -> bool:
    start = line.lstrip()
    return start.startswith("#") or (start.startswith("//") and not start[2:3].isalpha())


def _header(line: str, separator: str | None) -> list[str]:
    parts = [part.strip().strip('"').lstrip("/#") for part in line.split(separator)]
    try:
        for part in parts:
            float(part)
    except ValueError:
        lowered = [part.lower() for part in parts]
        return lowered if {"x", "y", "z"} <= set(lowered) else []
    return []


def _numbers(path: Path, lines: list[str], separator: str | None, text: str) -> np.ndarray:
    try:
        return np.loadtxt(io.StringIO("\n".join(lines)), delimiter=separator, ndmin=2)
    except ValueError:
        pass
    width = len(lines[0].split(separator))
    all_lines = text.splitlines()
    for line in lines:
        parts = line.split(separator)
        number = all_lines.index(line) + 1
        if len(parts) != width:
            raise InputError(
                f"{path}, line {number} has {len(parts)} values, the first has {width}.",
                "The file may be cut short.", "Export it again, or correct that line.")
        for part in parts:
            try:
                float(part)
            except ValueError:
                raise InputError(f"{path}, line {number}: {part.strip()[:30]!r} is not a number.",
                                 "A cloud has one point a line, as numbers.",
                                 "Correct that line.") from None
    raise InputError(f"{path} cannot be read as a table of numbers.", "", "Export it again.")


def _guessed(extra: int) -> list[str]:
    """Names of unnamed columns after x, y, z, as scanners and CloudCompare order them."""
    if extra == 3:
        return ["red", "green", "blue"]
    if extra == 6:
        return ["red", "green", "blue", "nx", "ny", "nz"]
    return [f"scalar_{k}" for k in range(extra)]


def _read_las(path: Path) -> Cloud:
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
    return Cloud(np.asarray(content.xyz, np.float64), attributes)


def _read_vertices(path: Path) -> Cloud:
    import trimesh

    mesh = trimesh.load(path, process=False)
    if isinstance(mesh, trimesh.Scene):
        parts = [g.vertices for g in mesh.geometry.values()]
        return Cloud(np.vstack(parts).astype(np.float64) if parts else np.empty((0, 3)))
    points = np.asarray(mesh.vertices, np.float64)
    # STL repeats a vertex in each of its triangles.
    return Cloud(np.unique(points, axis=0) if path.suffix.lower() == ".stl" else points)


def _read_npz(path: Path) -> Cloud:
    with np.load(path, allow_pickle=False) as content:
        arrays = {name: content[name] for name in content.files}
    return _from_arrays(path, arrays)


def _read_npy(path: Path) -> Cloud:
    return _from_arrays(path, {"points": np.load(path, allow_pickle=False)})


def _from_arrays(path: Path, arrays: dict[str, np.ndarray]) -> Cloud:
    key = next((k for k in ("points", "xyz", "positions", "arr_0") if k in arrays), None)
    if key is None:
        return _from_columns(list(arrays), arrays)
    points = np.asarray(arrays.pop(key), np.float64)
    if points.ndim != 2 or points.shape[1] < 3:
        raise InputError(f"{path}: {key} has shape {list(points.shape)}.",
                         "Points have shape [n, 3].", "Save them so.")
    renamed = {"normals": "normal", "colors": "color"}
    attributes = {renamed.get(k, k): v for k, v in arrays.items()
                  if v.ndim in (1, 2) and len(v) == len(points) and v.dtype.kind in "iufb"}
    return Cloud(points[:, :3], attributes)


READERS: dict[str, Callable[[Path], Cloud]] = {
    ".ply": _read_ply, ".pcd": _read_pcd,
    ".xyz": _read_text, ".txt": _read_text, ".csv": _read_text, ".asc": _read_text,
    ".pts": _read_text, ".xyzrgb": _read_text,
    ".las": _read_las, ".laz": _read_las,
    ".obj": _read_vertices, ".stl": _read_vertices, ".off": _read_vertices,
    ".npz": _read_npz, ".npy": _read_npy,
}
"""Suffix to reader; each may raise what its package raises, :func:`read_points` explains it."""
