"""Point clouds of other programs, and the registry of their formats.

All return coordinates as in the file, as float64, and keep normals, colours and scalars.
"""

import io
import itertools
import math
import re
import struct
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.constants import UNIT_METRES
from limber.core.errors import Command, InputError, Option, Text
from limber.core.files import reading, text_columns
from limber.geometry.cloud.cloud import LEFT_OUT, POINTS, Cloud, property_names
from limber.geometry.cloud.preparation import PIECE_POINTS, gathered
from limber.geometry.io.e57 import read_e57
from limber.geometry.io.formats import Format, Registry, head_of, starts_with
from limber.geometry.io.skeletons import is_cylinders, is_tree_file
from limber.geometry.io.splats import ply_splats

# A mesh given as a cloud: its vertices may be a scan, or far too few.

_LONG = 0.05
"""Fraction of the extent: triangles with so long an edge have surface where no vertex is."""


def mesh_notes(path: Path, vertices: np.ndarray, faces: np.ndarray) -> list[str]:
    """Return what a user should know whose cloud is a mesh of vertices [n, 3] and faces [m, 3].
    InputError if half of its surface is in triangles too large for vertices to show it."""
    good = ((faces >= 0) & (faces < len(vertices))).all(axis=1)
    corners = np.asarray(vertices, float)[faces[good]]
    if not len(corners):
        return []
    sides = np.roll(corners, -1, axis=1) - corners
    areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    longest = np.linalg.norm(sides, axis=2).max(axis=1)
    extent = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
    large = longest > _LONG * extent
    if areas[large].sum() > 0.5 * areas.sum():
        raise InputError(f"{path} is a mesh of {len(vertices)} vertices and {len(faces)} faces.",
                         "A point cloud was expected. Most of this surface lies in large faces, "
                         "where a mesh has no points.", "If it is the closed surface of a branch, "
                         "use ", Command("mesh"), ". Otherwise sample points on it (CloudCompare: "
                         "Edit, Mesh, Sample points) and export those.")
    return [Text(f"{path.name} is a mesh of {len(faces)} faces. Its {len(vertices)} vertices were "
                 "read as a cloud. If it is the closed surface of a branch, ", Command("mesh"),
                 " uses it as it is.")]


# Clouds as PLY files, whose headers may also contain letters other than ASCII.


def read_ply(path: Path) -> Cloud:
    """Return the vertices of a PLY file, with the file's own names of renamed columns."""
    content, titles = _ply_content(path)
    if "vertex" not in content:
        raise ValueError("it has no element `vertex`")
    comments = "\n".join([*content.comments, *content.obj_info])
    if (splats := ply_splats(content)) is not None:
        return replace(splats, unit=text_columns.stated_unit(comments))
    table = content["vertex"].data
    names = [name for name in table.dtype.names if table.dtype[name].kind in "iuf"]
    # Binary tables stay in the file until a piece is asked for.
    cloud = gathered(Cloud.from_columns({name: np.array(part[name]) for name in names}, titles)
                     for start in range(0, max(len(table), 1), PIECE_POINTS)
                     for part in [table[start:start + PIECE_POINTS]])
    # Faces count the file's vertices.
    notes = () if cloud.left_out else tuple(mesh_notes(path, cloud.points, _triangles(content)))
    return replace(cloud, unit=text_columns.stated_unit(comments), notes=notes)


def _triangles(content: Any) -> np.ndarray:
    """The first three corners of each face, shape [m, 3]."""
    if "face" not in content:
        return np.empty((0, 3), int)
    faces = content["face"].data
    lists: Any = next((faces[name] for name in ("vertex_indices", "vertex_index")
                  if name in (faces.dtype.names or ())), [])
    return np.array([face[:3] for face in lists if len(face) >= 3], int).reshape(-1, 3)


def _ply_content(path: Path) -> tuple[Any, dict[str, str]]:
    """Read a PLY file, and its names of the properties that are not ASCII. A header is ASCII by the
    standard; programs write comments and names in other letters too. RealSense's Viewer writes
    position, normal and colour of an ASCII vertex on a line each."""
    from plyfile import PlyData

    raw, start = reading.header_bytes(path, b"end_header")
    vertex = re.search(rb"element vertex (\d+)\s+((?:property \w+ \w+\s+)+)", raw)
    in_parts = vertex and b"Realsense Viewer" in raw and b"format ascii" in raw
    if raw.isascii() and not in_parts:
        return PlyData.read(str(path)), {}
    try:
        header = raw.decode("utf-8")
    except UnicodeDecodeError:
        header = raw.decode("latin-1")
    titles: dict[str, str] = {}
    taken = re.findall(r"(?<![^\r\n])property [^\r\n]* (\S+)", header)

    def named(line: re.Match[str]) -> str:
        name, = property_names([line[2]], [*taken, *titles])
        titles[name] = line[2]
        return line[1] + name

    plain = re.sub(r"(?<![^\r\n])(property [^\r\n]* )(\S*[^\x00-\x7f]\S*)", named, header)
    body = path.read_bytes()[start:]
    if vertex and in_parts:
        count, width = int(vertex[1]), vertex[2].count(b"property")
        words = body.split(None, count * width)
        body = b"\n".join([b" ".join(words[at:at + width])
                           for at in range(0, count * width, width)] + words[count * width:])
    return PlyData.read(io.BytesIO(plain.encode("ascii", "replace") + body)), titles


# Clouds as PCD files, of all versions.

_PADDING = "#$%&~~"  # prefix by which pypcd4 names fields that are called _


def read_pcd(path: Path) -> Cloud:
    """Return the points of a PCD file, with the file's own names of renamed columns."""
    raw, body = reading.header_bytes(path, b"\nDATA")
    header, titles = _completed(path, raw.decode("utf-8", "replace"))
    cloud = gathered(_cloud(table, titles) for table in _tables(path, header, body))
    return replace(cloud, unit=_commented_unit(raw))


def _cloud(table: np.ndarray, titles: dict[str, str]) -> Cloud:
    """A piece of the points, copied out of the file."""
    columns = {name: np.array(table[name]) for name in table.dtype.names or ()
               if not name.startswith(_PADDING)}
    if "rgb" in columns:
        packed = columns.pop("rgb")
        packed = packed.view(np.uint32) if packed.dtype == np.float32 else packed.astype(np.uint32)
        columns |= {"r": packed >> 16 & 255, "g": packed >> 8 & 255, "b": packed & 255}
    return Cloud.from_columns(columns, titles)


def _tables(path: Path, header: str, body: int) -> Iterator[np.ndarray]:
    """The points in pieces, structured by field; at least one piece, which may be empty. InputError
    if there are fewer points than the header declares."""
    from pypcd4 import MetaData, PointCloud

    meta = MetaData.parse_header(header.splitlines())
    dtype = meta.build_dtype()
    whole: Any = np.empty(0, dtype)
    with open(path, "rb") as stream:
        stream.seek(body)
        if meta.data.value == "ascii" and meta.points:
            listed, rows = 0, (line for line in stream if line.strip())
            while lines := list(islice(rows, PIECE_POINTS)):
                piece = np.loadtxt(lines, dtype, ndmin=1)
                listed += len(piece)
                yield piece
            if listed < meta.points:
                raise ValueError(f"it announces {meta.points} points and lists {listed}")
            return
        if meta.data.value == "binary" and meta.points:
            whole = np.memmap(path, dtype, "r", body, (meta.points,))
        elif meta.points:
            content: Any = io.BytesIO(header.encode() + stream.read())
            whole = PointCloud.from_fileobj(content).pc_data
    for start in range(0, max(len(whole), 1), PIECE_POINTS):
        yield whole[start:start + PIECE_POINTS]


def _completed(path: Path, source: str) -> tuple[str, dict[str, str]]:
    """A PCD header as its package reads it, and the file's names of renamed fields. Versions before
    0.7 lack entries; some programs write trailing blanks or special characters."""
    entries = {words[0]: words[1:] for line in source.splitlines()
               if (words := line.split()) and not words[0].startswith("#")}
    for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "DATA"):
        if not entries.get(key):
            raise ValueError(f"its header has no entry {key}")
    fields = entries["FIELDS"]
    names = iter(property_names([title for title in fields if title != "_"]))
    renamed = [title if title == "_" else next(names) for title in fields]
    height = entries.get("HEIGHT") or ["1"]
    complete = {"VERSION": ["0.7"], "FIELDS": renamed, "SIZE": entries["SIZE"],
                "TYPE": entries["TYPE"], "COUNT": entries.get("COUNT") or ["1"] * len(fields),
                "WIDTH": entries["WIDTH"], "HEIGHT": height,
                "POINTS": entries.get("POINTS") or [str(int(entries["WIDTH"][0])
                                                        * int(height[0]))],
                "DATA": entries["DATA"]}
    return "".join(f"{key} {' '.join(words)}\n" for key, words in complete.items()), {
        name: title for name, title in zip(renamed, fields, strict=True) if name != title}


# Units of LAS and LAZ files, from the records of their coordinate system.
#
# Without a table of coordinate systems: only units that the records spell out are known.

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
    """Return what one unit of x and y, and of z, is in metres, from laspy's records, shape [2]: NaN
    is an unknown unit, 0 stands for degrees."""
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
    """Return the points of a LAS file in metres, if its units are known; InputError for degrees."""
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


# Clouds as LAS and LAZ files.


def is_packed(path: Path) -> bool:
    """Whether the file is LAZ, whose points compiled code decodes; it aborts on corrupt ones."""
    with open(path, "rb") as stream:
        return bool(stream.read(105)[104] & 0xC0)


def las_columns(path: Path) -> dict[str, np.ndarray]:
    """Return coordinates, ``color``, the other dimensions, and units of a LAS or LAZ file."""
    import laspy

    cloud = gathered(_las_pieces(path))
    with laspy.open(path) as reader:
        metres = stated_metres([*reader.header.vlrs, *(reader.evlrs or ())])
    attributes = {name: values for name, values in cloud.attributes.items()
                  if name == "color" or values.any()}
    return {**attributes, POINTS: cloud.points, LEFT_OUT: np.array(cloud.left_out),
            METRES: metres}


def _las_pieces(path: Path) -> Iterator[Cloud]:
    import laspy

    with laspy.open(path) as reader:
        dimensions = reader.header.point_format
        names = set(dimensions.dimension_names)
        has_color = {"red", "green", "blue"} <= names
        others = sorted(names - {"X", "Y", "Z", "red", "green", "blue"})
        if reader.header.point_count == 0:
            yield Cloud(np.empty((0, 3)))
        for part in reader.chunk_iterator(PIECE_POINTS):
            attributes = {}
            if has_color:
                attributes["color"] = np.stack(
                    [np.asarray(part[c]) for c in ("red", "green", "blue")], axis=1)
            attributes |= {name: values for name in others
                           if (values := np.asarray(part[name])).ndim == 1}
            points = np.stack([np.asarray(getattr(part, axis), np.float64) for axis in "xyz"],
                              axis=1)
            yield Cloud(points, attributes)


# Clouds as COLMAP's ``points3D.bin``; its text format is read like other text.

_POINT = struct.Struct("<Q3d3BdQ")
_SEEN_BYTES = 8
"""For each image that saw a point: its number, and that of the point in it."""


def read_points3d(path: Path) -> Cloud:
    """Return the points of a reconstruction, in its own unit, with colour and error; InputError if
    the file is cut short."""
    raw = path.read_bytes()
    count, = struct.unpack_from("<Q", raw)
    reading.require_size(path, float(count) * _POINT.size + 8, len(raw), f"{count} points")
    rows, at = np.empty((count, 7)), 8
    for row in rows:
        _, *row[:], seen = _POINT.unpack_from(raw, at)
        at += _POINT.size + _SEEN_BYTES * seen
    if at > len(raw):
        raise ValueError(f"it is cut short: it announces {count} points")
    return Cloud(rows[:, :3], {"color": rows[:, 3:6].astype(np.uint8), "error": rows[:, 6]})


# Clouds as Leica's PTX files: grids of points, each scan with the pose of its scanner.

_MOST = 10**9
"""Most rows or columns of a scanner's grid."""
_HEAD = 10
"""Lines above the points of a scan: columns, rows, position, three axes, a matrix of four rows."""


def read_ptx(path: Path) -> Cloud:
    """Return the points of all scans [m] in their common frame, with the intensity and colour that
    all have, thinned by :func:`gathered`. InputError if a scan is cut short, or a line is invalid.
    """
    return replace(gathered(_scan_pieces(path)), unit="m")


def _scan_pieces(path: Path) -> Iterator[Cloud]:
    """The points of some lines after the other."""
    lines = filter(str.strip, text_columns.lines_of(path, text_columns.coding_of(path)))
    start = 0
    while head := list(itertools.islice(lines, _HEAD)):
        count, matrix = _header(head, start)
        left, width = count, 0
        while some := list(itertools.islice(lines, min(left, text_columns.LINES_AT_ONCE))):
            table = _table(some, matrix, width)
            left, width = left - len(some), table.shape[1]
            # A direction without an echo is a point at the scanner itself.
            seen = np.isfinite(table[:, 0])
            attributes = {"intensity": table[seen, 3]} if width > 3 else {}
            if width >= 7:
                attributes["color"] = table[seen, 4:7]
            yield Cloud(table[seen, :3], attributes, not_finite=int((~seen).sum()))
        if left:
            raise ValueError(f"it is cut short: the scan at line {start + 1} announces {count} "
                             f"points, but {count - left} lines follow")
        start += _HEAD + count


def _header(head: list[str], start: int) -> tuple[int, np.ndarray]:
    """Points of a scan and its matrix [4, 4] from points as rows to the common frame."""
    try:
        columns, rows = int(head[0]), int(head[1])
        matrix = np.array([[float(word) for word in line.split()] for line in head[6:_HEAD]])
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or (
                min(columns, rows) < 1 or max(columns, rows) > _MOST):
            raise ValueError
    except (ValueError, IndexError):
        raise ValueError(f"line {start + 1}: the header of a scan was expected: numbers of columns "
                         "and rows, the scanner's position and axes, a matrix of four rows"
                         ) from None
    return columns * rows, matrix


def _table(rows: list[str], matrix: np.ndarray, width: int) -> np.ndarray:
    """Points in the common frame and the other values of a line; NaN where there was no echo. The
    lines before have ``width`` values, 0 if there are none."""
    table = np.loadtxt(rows, ndmin=2)
    if table.shape[1] < 3 or width not in (0, table.shape[1]):
        raise ValueError(f"a scan has {table.shape[1]} columns instead of {width or 4}")
    silent = ~table[:, :3].any(axis=1)
    table[:, :3] = table[:, :3] @ matrix[:3, :3] + matrix[3, :3]
    table[silent, :3] = np.nan
    return table


_FARTHEST = 1e15
"""Largest coordinate, whatever its unit."""
_AGAIN = "Export a point cloud (PLY, LAS), or else a mesh (OBJ, GLB), from its program."
_OTHERS = {
    ".usdz .usd .usdc .usda .fbx .dae .gltf .blend": ("a scene for viewers", _AGAIN),
    ".splat .ksplat .spz .sog": ("splats, packed", "Open it in SuperSplat and export PLY."),
    ".psx .psz .rcp .rcs .zip": ("a project or an archive", _AGAIN),
    ".jpg .jpeg .heic .mov .mp4": ("a photograph or a film", "Make a cloud of it first, with "
                                   "COLMAP, Metashape or a phone's app."),
    ".vis": ("COLMAP's list of the images that saw each point", "Give the .ply beside it."),
    ".bag": ("a recording", Text("Play it in RealSense Viewer, stop, and export PLY. A pull's "
                                 "recording goes to ", Command("import-pull"), "."))}
"""What people have in place of a cloud: what it is, and what to do."""


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
        raise InputError(f"{path} is a folder.", "A point cloud file was expected.", "Give one of "
                         "its files, or give the folder to ", Command("reconstruct"), ".")
    for suffixes, (what, fix) in _OTHERS.items():
        if path.suffix.lower() in suffixes.split():
            raise InputError(f"{path.name} is {what}.", "A point cloud was expected.", fix)
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
    """Return the unit of a file's points, and a note for the user about it. A request of None or m,
    which need not be given, leaves it to the file."""
    if cloud.unit is None or cloud.unit == requested:
        return requested or "m", []
    if requested in (None, "m"):
        return cloud.unit, [f"The file states that its coordinates are in {cloud.unit}."]
    return requested, [Text(f"The file states that its coordinates are in {cloud.unit}, but ",
                            Option("unit", requested), " was used.")]


def _read_text(path: Path) -> Cloud:
    """XYZ, TXT, CSV; see :mod:`limber.core.files.text_columns`. InputError also for a model."""
    if is_cylinders(path) or is_tree_file(path):
        raise InputError(f"{path} holds the cylinders or segments of a tree's model.",
                         "A point cloud was expected.", "Mesh the model with ", Command("mesh"),
                         ", or give it beside its cloud with ", Option("skeleton", path.name), ".")
    table = text_columns.Table(path)
    held = gathered(Cloud(piece[:, table.axes], {"others": np.delete(piece, table.axes, 1)})
                    for piece in table.pieces())
    read = table.columns(_joined(held, table.axes))
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
    # The parts of a scene stand where its nodes put them.
    parts: list[Any] = mesh.dump() if isinstance(mesh, trimesh.Scene) else [mesh]
    points = np.vstack([np.asarray(part.vertices, np.float64) for part in parts]
                       or [np.empty((0, 3))])
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"its vertices have {points.shape[-1]} coordinates")
    notes = [note for part in parts if isinstance(part, trimesh.Trimesh)
             for note in mesh_notes(path, part.vertices, part.faces)][:1]
    if is_gltf := path.suffix.lower() == ".glb":
        notes.append(Text("glTF is in metres with y up: ", Option("up", (0, 1, 0)),
                          ", unless its program turned it."))
    # STL repeats a vertex in each of its triangles.
    return Cloud(np.unique(points, axis=0) if path.suffix.lower() == ".stl" else points, unit="m"
                 if is_gltf else _commented_unit(head_of(path, 10_000)), notes=tuple(notes))


def _commented_unit(head: bytes) -> str | None:
    """The unit that the comments of a header state."""
    comments = re.findall("^#.*", head.decode("utf-8", "replace"), re.MULTILINE)
    return text_columns.stated_unit("\n".join(comments))


def _read_arrays(path: Path) -> Cloud:
    arrays = reading.read_arrays(path, "a point cloud")
    names = ("points", "xyz", "positions", "vertices", "arr_0")
    key = next((name for name in names if name in arrays), None)
    if key is not None and arrays[key].dtype.names:
        arrays, key = {name: arrays[key][name] for name in arrays[key].dtype.names}, None
    if key is None:
        if text_columns.three_of("position", list(arrays)) is None:
            raise InputError(f"{path} has the arrays {', '.join(arrays)[:200]}.",
                             f"A cloud has one of {', '.join(names[:-1])}, or x, y and z.",
                             "Save the coordinates under one of these names.")
        return Cloud.from_columns(arrays)
    points = np.asarray(arrays.pop(key), np.float64)
    if points.ndim != 2 or points.shape[1] < 3 or points.shape[0] == 3 < points.shape[1]:
        raise ValueError(f"{key} has shape {list(points.shape)} instead of [n, 3]")
    renamed = {"normals": "normal", **dict.fromkeys(("colors", "colours", "colour", "rgb"),
                                                    "color")}
    return Cloud(points[:, :3], {renamed.get(k, k): v for k, v in arrays.items()})


def _of_columns(path: Path, columns: dict[str, np.ndarray]) -> Cloud:
    points = columns.pop(POINTS, None)
    left_out, metres = int(columns.pop(LEFT_OUT, 0)), columns.pop(METRES, np.full(2, np.nan))
    cloud = Cloud.from_columns(columns) if points is None else Cloud(points, columns)
    return in_metres(path, replace(cloud, left_out=left_out), metres)


CLOUDS = Registry("point cloud", "limber.clouds", [
    Format("PLY", (".ply",), read_ply, check=reading.check_ply, recognises=starts_with(b"ply")),
    Format("PCD", (".pcd",), read_pcd, check=reading.check_pcd,
           recognises=starts_with(b"# .PCD", b"VERSION")),
    Format("text", (".xyz", ".txt", ".csv", ".asc", ".pts", ".xyzrgb", ".tsv"), _read_text),
    Format("PTX", (".ptx",), read_ptx),
    Format("E57", (".e57",), read_e57, recognises=starts_with(b"ASTM-E57")),
    Format("COLMAP", (".bin",), read_points3d),
    Format("LAS", (".las", ".laz"), las_columns, check=reading.check_las, isolated=is_packed,
           recognises=starts_with(b"LASF")),
    Format("vertices of a mesh", (".obj", ".stl", ".off", ".glb"), _read_vertices),
    Format("NumPy", (".npz", ".npy"), _read_arrays)], of_arrays=_of_columns)
""":func:`read_points` reads all of them. Arrays that a format reads are columns: x, y, z and any
others, or the coordinates as :data:`~limber.geometry.cloud.cloud.POINTS`."""
