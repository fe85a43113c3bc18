"""Point clouds of other programs, and the registry of their formats.

All return coordinates as in the file, as float64, and keep normals, colours and scalars.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.constants import UNIT_METRES
from limber.core.errors import InputError
from limber.core.files.declared_sizes import check_las, check_pcd, check_ply
from limber.core.files.reading import read_arrays
from limber.core.files.text_columns import ColumnsError, Table, stated_unit, three_of
from limber.geometry.cloud.cloud import LEFT_OUT, POINTS, Cloud
from limber.geometry.cloud.columns import property_names
from limber.geometry.cloud.piecewise_reading import gathered
from limber.geometry.io.formats import Format, Registry, head_of, starts_with
from limber.geometry.io.las import is_packed, las_columns
from limber.geometry.io.las_units import METRES, in_metres
from limber.geometry.io.mesh_as_cloud import mesh_notes
from limber.geometry.io.pcd import read_pcd
from limber.geometry.io.ply import read_ply
from limber.geometry.io.scanners.colmap import read_points3d
from limber.geometry.io.scanners.e57 import read_e57
from limber.geometry.io.scanners.ptx import read_ptx

_FARTHEST = 1e15
"""Largest coordinate, whatever its unit."""


def read_points(path: Path) -> Cloud:
    """Read a cloud, in the file's own units.

    Its attributes have names that every writer accepts; ``titles`` has the file's names.

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
                         "Give one of its files, or give the folder to `limber reconstruct`.")
    chosen = CLOUDS.of(path)
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty.", "A point cloud was expected.", "Export it again.")
    return _checked(path, CLOUDS.read_as(chosen, path))


def _checked(path: Path, cloud: Cloud) -> Cloud:
    if len(cloud) == 0:
        raise InputError(f"{path} has no points.", "A point cloud was expected.",
                         "Export it again.")
    cloud = cloud.with_valid_columns()
    finite = (np.abs(cloud.points) < _FARTHEST).all(axis=1)
    if not finite.any():
        raise InputError(f"{path}: none of the {len(cloud)} points is finite.",
                         "Coordinates must be finite numbers, not NaN or infinity.",
                         "Export it again.")
    if finite.all():
        return cloud
    # Drivers of depth cameras write NaN, or the largest number, for a pixel without a reading.
    return replace(cloud.subset(finite), not_finite=cloud.not_finite + int((~finite).sum()))


def read_cloud(path: Path, unit: str = "m") -> Cloud:
    """Read a cloud of any known format, in metres; ``unit`` as for :func:`unit_of`."""
    cloud = read_points(path)
    return cloud.with_points(cloud.points * UNIT_METRES[unit_of(cloud, unit)[0]])


def unit_of(cloud: Cloud, requested: str | None) -> tuple[str, list[str]]:
    """Return the unit of a file's points, and a note for the user about it.

    Args:
        cloud: As read; its file may state a unit.
        requested: By the user. None and m, which need not be given, leave it to the file.
    """
    if cloud.unit is None or cloud.unit == requested:
        return requested or "m", []
    if requested in (None, "m"):
        return cloud.unit, [f"The file states that its coordinates are in {cloud.unit}."]
    return requested, [f"The file states that its coordinates are in {cloud.unit}, but --unit "
                       f"{requested} "
                       "was used."]


def _read_text(path: Path) -> Cloud:
    """XYZ, TXT, CSV; see :mod:`limber.core.files.text_columns`."""
    try:
        table = Table(path)
        held = gathered(Cloud(piece[:, table.axes], {"others": np.delete(piece, table.axes, 1)})
                        for piece in table.pieces())
        read = table.columns(_joined(held, table.axes))
    except ColumnsError as error:
        raise InputError(error.seen, error.why, error.fix) from error
    # A column with the name of an earlier one would replace it.
    names = property_names(read.names)
    cloud = Cloud.from_columns(dict(zip(names, read.values.T, strict=True)),
                               dict(zip(names, read.titles, strict=True)))
    return replace(cloud, unit=read.unit, notes=read.notes, not_finite=held.not_finite,
                   left_out=held.left_out)


def _joined(held: Cloud, axes: list[int]) -> np.ndarray:
    """The table of which columns ``axes`` are the points, and all others an attribute."""
    others = held.attributes["others"]
    values = np.empty((len(held), 3 + others.shape[1]))
    values[:, axes] = held.points
    values[:, [k for k in range(values.shape[1]) if k not in axes]] = others
    return values


def _read_vertices(path: Path) -> Cloud:
    import trimesh

    mesh: Any = trimesh.load(path, process=False)
    parts = list(mesh.geometry.values()) if isinstance(mesh, trimesh.Scene) else [mesh]
    points = np.vstack([np.asarray(part.vertices, np.float64) for part in parts]
                       or [np.empty((0, 3))])
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{path} has vertices of {points.shape[-1]} coordinates.",
                         "A vertex has three coordinates.", "Export it again.")
    notes = [note for part in parts if isinstance(part, trimesh.Trimesh)
             for note in mesh_notes(path, part.vertices, part.faces)]
    # STL repeats a vertex in each of its triangles.
    return Cloud(np.unique(points, axis=0) if path.suffix.lower() == ".stl" else points,
                 unit=_commented_unit(path), notes=tuple(notes[:1]))


def _commented_unit(path: Path) -> str | None:
    """The unit that the comments above an OBJ file's vertices state."""
    if path.suffix.lower() != ".obj":
        return None
    lines = head_of(path, 10_000).decode("utf-8", "replace").splitlines()
    return stated_unit("\n".join(line for line in lines if line.startswith("#")))


def _read_arrays(path: Path) -> Cloud:
    arrays = read_arrays(path, "a point cloud")
    names = ("points", "xyz", "positions", "vertices", "arr_0")
    key = next((name for name in names if name in arrays), None)
    if key is not None and arrays[key].dtype.names:
        arrays, key = {name: arrays[key][name] for name in arrays[key].dtype.names}, None
    if key is None:
        if three_of("position", list(arrays)) is None:
            raise InputError(f"{path} has the arrays {', '.join(arrays)[:200]}.",
                             f"A cloud has one of {', '.join(names[:-1])}, or x, y and z.",
                             "Save the coordinates under one of these names.")
        return Cloud.from_columns(arrays)
    points = np.asarray(arrays.pop(key), np.float64)
    if points.ndim != 2 or points.shape[1] < 3 or points.shape[0] == 3 < points.shape[1]:
        raise InputError(f"{path}: {key} has shape {list(points.shape)}.",
                         "Points must have shape [n, 3].", "Save them in this shape.")
    renamed = {"normals": "normal", **dict.fromkeys(("colors", "colours", "colour", "rgb"),
                                                    "color")}
    return Cloud(points[:, :3], {renamed.get(k, k): v for k, v in arrays.items()})


def _of_columns(path: Path, columns: dict[str, np.ndarray]) -> Cloud:
    points = columns.pop(POINTS, None)
    left_out, metres = int(columns.pop(LEFT_OUT, 0)), columns.pop(METRES, np.full(2, np.nan))
    cloud = Cloud.from_columns(columns) if points is None else Cloud(points, columns)
    return in_metres(path, replace(cloud, left_out=left_out), metres)


CLOUDS = Registry("point cloud", "limber.clouds", [
    Format("PLY", (".ply",), read_ply, check=check_ply, recognises=starts_with(b"ply")),
    Format("PCD", (".pcd",), read_pcd, check=check_pcd,
           recognises=starts_with(b"# .PCD", b"VERSION")),
    Format("text", (".xyz", ".txt", ".csv", ".asc", ".pts", ".xyzrgb", ".tsv"), _read_text),
    Format("PTX", (".ptx",), read_ptx),
    Format("E57", (".e57",), read_e57, recognises=starts_with(b"ASTM-E57")),
    Format("COLMAP", (".bin",), read_points3d),
    Format("LAS", (".las", ".laz"), las_columns, check=check_las, isolated=is_packed,
           recognises=starts_with(b"LASF")),
    Format("vertices of a mesh", (".obj", ".stl", ".off"), _read_vertices),
    Format("NumPy", (".npz", ".npy"), _read_arrays)], of_arrays=_of_columns)
""":func:`read_points` reads all of them. Arrays that a format reads are columns: x, y, z and any
others, or the coordinates as :data:`~limber.geometry.cloud.cloud.POINTS`."""
