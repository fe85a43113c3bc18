"""Readers of point clouds: PLY, PCD, XYZ/TXT/CSV, LAS/LAZ, OBJ/STL/OFF vertices, NPZ.

All give coordinates as the file has them, as float64, and keep normals, colours and scalars.
"""

import io
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.constants import UNIT_METRES
from limber.core.errors import InputError, MissingDependencyError
from limber.core.files.declared_sizes import check_las, check_pcd, check_ply, header_bytes
from limber.core.files.reading import read_arrays
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.columns import property_names
from limber.geometry.io.isolated_readers import LAS_POINTS, las_arrays, read_apart
from limber.geometry.io.text_clouds import read_table

_AXES = (("x", "y", "z"), ("points:0", "points:1", "points:2"), ("X", "Y", "Z"),
         ("//X", "Y", "Z"))
_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"), ("Nx", "Ny", "Nz"))
_PCD_PADDING = "#$%&~~"  # how pypcd4 begins the names of fields that are called _
_FARTHEST = 1e15
"""No coordinate lies beyond, whatever its unit."""
_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("R", "G", "B"))


def read_points(path: Path) -> Cloud:
    """Read a cloud, in the file's own units.

    Its attributes have names that every writer can take; ``titles`` has those that are the file's.

    Raises:
        InputError: the file is missing, empty, cut short, of an unknown format, holds text where
            numbers belong, or has no finite coordinates.
        MissingDependencyError: the format needs a package that is not installed.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"There is no file {path}.", "A point cloud was expected.",
                         "Check the path.")
    if path.is_dir():
        raise InputError(f"{path} is a folder.", "A point cloud file was expected.",
                         "Name one of its files, or give the folder to `limber reconstruct`.")
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        known = " ".join(sorted(READERS))
        raise InputError(f"{path.name} has a suffix that is not known.",
                         f"Known suffixes: {known}.", "Export the cloud as one of these.")
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
    cloud = cloud.with_valid_columns()
    finite = (np.abs(cloud.points) < _FARTHEST).all(axis=1)
    if not finite.any():
        raise InputError(f"{path}: none of {len(cloud)} points is finite.",
                         "Coordinates must be numbers; NaN and infinity are not.",
                         "Export it again.")
    if finite.all():
        return cloud
    # Drivers of depth cameras write NaN, or the largest number, where a pixel saw nothing.
    return replace(cloud.subset(finite), not_finite=cloud.not_finite + int((~finite).sum()))


def cloud_of_columns(names: list[str], columns: dict[str, np.ndarray]) -> Cloud:
    """Sort named columns, shape [n] each, into positions, normals, colours and scalars.

    Raises:
        InputError: coordinates are missing.
    """
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
        if name not in used:
            attributes[name] = np.ascontiguousarray(columns[name])
    points = np.stack([np.asarray(columns[name], np.float64) for name in axes], axis=1)
    return Cloud(points, attributes)


def _read_ply(path: Path) -> Cloud:
    check_ply(path)
    content, titles = _ply_content(path)
    if "vertex" not in content:
        raise InputError(f"{path} has no vertices.", "A cloud is an element `vertex`.",
                         "Export it again.")
    table = content["vertex"].data
    names = list(table.dtype.names)
    scalar = {name: np.asarray(table[name]) for name in names if table.dtype[name].kind in "iuf"}
    cloud = cloud_of_columns([name for name in names if name in scalar], scalar)
    return replace(cloud, titles=titles)


def _ply_content(path: Path) -> tuple[Any, dict[str, str]]:
    """Read a PLY file, and what it calls the properties whose names are no ASCII.

    A header is ASCII by the standard; programs write comments and names in other letters too.
    """
    from plyfile import PlyData

    raw, body = header_bytes(path, b"end_header")
    if raw.isascii():
        return PlyData.read(str(path)), {}
    try:
        header = raw.decode("utf-8")
    except UnicodeDecodeError:
        header = raw.decode("latin-1")
    lines = re.split(r"(\r\n|\r|\n)", header)
    words = {k: line.split() for k, line in enumerate(lines) if line.startswith("property")}
    other = [k for k, parts in words.items() if not parts[-1].isascii()]
    taken = [parts[-1] for k, parts in words.items() if k not in other]
    names = property_names((words[k][-1] for k in other), taken)
    for k, name in zip(other, names, strict=True):
        lines[k] = " ".join([*words[k][:-1], name])
    plain = "".join(lines).encode("ascii", "replace")
    with open(path, "rb") as stream:
        stream.seek(body)
        content = PlyData.read(io.BytesIO(plain + stream.read()))
    return content, {name: words[k][-1] for k, name in zip(other, names, strict=True)}


def _read_pcd(path: Path) -> Cloud:
    from pypcd4 import PointCloud

    check_pcd(path)
    stream, titles = _pcd_stream(path)
    content = PointCloud.from_fileobj(stream)
    names = [name for name in content.fields if not name.startswith(_PCD_PADDING)]
    columns = {name: np.asarray(content.pc_data[name]).ravel() for name in names}
    if "rgb" in columns:
        packed = columns.pop("rgb")
        packed = packed.view(np.uint32) if packed.dtype == np.float32 else packed.astype(np.uint32)
        columns |= {"r": packed >> 16 & 255, "g": packed >> 8 & 255, "b": packed & 255}
        names = [name for name in names if name != "rgb"] + ["r", "g", "b"]
    return replace(cloud_of_columns(names, columns), titles=titles)


def _pcd_stream(path: Path) -> tuple[io.BytesIO, dict[str, str]]:
    """A PCD file as its package reads it, and what the file calls fields of other names.

    Versions before 0.7 lack entries of the header; some programs end lines with blanks, or have
    marks in the names of fields.
    """
    raw, body = header_bytes(path, b"\nDATA")
    said = {words[0]: words[1:] for line in raw.decode("utf-8", "replace").splitlines()
            if (words := line.split()) and not words[0].startswith("#")}
    for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "DATA"):
        if not said.get(key):
            raise InputError(f"{path} has no {key} in its header.", "A PCD file says it there.",
                             "Export it again.")
    fields = said["FIELDS"]
    own = [title for title in fields if title != "_"]
    names = iter(property_names(own))
    renamed = [title if title == "_" else next(names) for title in fields]
    size = int(said["WIDTH"][0]) * int(said.get("HEIGHT", "1")[0])
    told = {"VERSION": ["0.7"], "FIELDS": renamed, "SIZE": said["SIZE"], "TYPE": said["TYPE"],
            "COUNT": said.get("COUNT") or ["1"] * len(fields), "WIDTH": said["WIDTH"],
            "HEIGHT": said.get("HEIGHT") or ["1"], "POINTS": said.get("POINTS") or [str(size)],
            "DATA": said["DATA"]}
    header = "".join(f"{key} {' '.join(words)}\n" for key, words in told.items()).encode()
    with open(path, "rb") as stream:
        stream.seek(body)
        points = stream.read()
    if said["DATA"][0] == "ascii":
        points = b"\n".join(b" ".join(line.split()) for line in points.splitlines())
    return io.BytesIO(header + points), {
        name: title for name, title in zip(renamed, fields, strict=True) if name != title}




def _read_text(path: Path) -> Cloud:
    """XYZ, TXT, CSV; see :mod:`limber.geometry.io.text_clouds`."""
    names, titles, table = read_table(path)
    # A column of the same name as one before would take its place.
    names = property_names(names)
    cloud = cloud_of_columns(names, {name: table[:, k] for k, name in enumerate(names)})
    return replace(cloud, titles=dict(zip(names, titles, strict=True)))


def _read_las(path: Path) -> Cloud:
    check_las(path)
    # Of a LAZ file compiled code makes points, which aborts on mangled ones.
    arrays = read_apart("las", path) if _is_packed(path) else las_arrays(path)
    points = arrays.pop(LAS_POINTS)
    return Cloud(points, arrays)


def _is_packed(path: Path) -> bool:
    with open(path, "rb") as stream:
        return bool(stream.read(105)[104] & 0xC0)


def _read_vertices(path: Path) -> Cloud:
    import trimesh

    mesh = trimesh.load(path, process=False)
    if isinstance(mesh, trimesh.Scene):
        parts = [g.vertices for g in mesh.geometry.values()]
        points = np.vstack(parts).astype(np.float64) if parts else np.empty((0, 3))
    else:
        points = np.asarray(mesh.vertices, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{path} has vertices of {points.shape[-1]} numbers.",
                         "A vertex has three.", "Export it again.")
    # STL repeats a vertex in each of its triangles.
    return Cloud(np.unique(points, axis=0) if path.suffix.lower() == ".stl" else points)


def _read_arrays(path: Path) -> Cloud:
    return _from_arrays(path, read_arrays(path, "a point cloud"))


def _from_arrays(path: Path, arrays: dict[str, np.ndarray]) -> Cloud:
    names = ("points", "xyz", "positions", "vertices", "arr_0")
    key = next((name for name in names if name in arrays), None)
    if key is None:
        return cloud_of_columns(list(arrays), arrays)
    points = np.asarray(arrays.pop(key), np.float64)
    if points.ndim != 2 or points.shape[1] < 3 or points.shape[0] == 3 < points.shape[1]:
        raise InputError(f"{path}: {key} has shape {list(points.shape)}.",
                         "Points have shape [n, 3].", "Save them so.")
    renamed = {"normals": "normal", "colors": "color"}
    return Cloud(points[:, :3], {renamed.get(k, k): v for k, v in arrays.items()})


READERS: dict[str, Callable[[Path], Cloud]] = {
    ".ply": _read_ply, ".pcd": _read_pcd,
    ".xyz": _read_text, ".txt": _read_text, ".csv": _read_text, ".asc": _read_text,
    ".pts": _read_text, ".xyzrgb": _read_text,
    ".las": _read_las, ".laz": _read_las,
    ".obj": _read_vertices, ".stl": _read_vertices, ".off": _read_vertices,
    ".npz": _read_arrays, ".npy": _read_arrays,
}
"""Suffix to reader; each may raise what its package raises, :func:`read_points` explains it."""


def read_cloud(path: Path, unit: str = "m") -> Cloud:
    """Read a cloud of any known format, in metres."""
    cloud = read_points(path)
    return cloud.with_points(cloud.points * UNIT_METRES[unit])
