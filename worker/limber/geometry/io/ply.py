"""Clouds as PLY files, whose headers may also contain letters other than ASCII."""

import io
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import InputError
from limber.core.files.declared_sizes import header_bytes
from limber.core.files.text_columns import stated_unit
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.columns import property_names
from limber.geometry.cloud.piecewise_reading import PIECE_POINTS, gathered
from limber.geometry.io.mesh_as_cloud import mesh_notes


def read_ply(path: Path) -> Cloud:
    """Return the vertices of a PLY file, with the file's own names of renamed columns."""
    content, titles = _ply_content(path)
    if "vertex" not in content:
        raise InputError(f"{path} has no vertices.", "A PLY point cloud has an element `vertex`.",
                         "Export it again.")
    table = content["vertex"].data
    names = [name for name in table.dtype.names if table.dtype[name].kind in "iuf"]
    # Binary tables stay in the file until a piece is asked for.
    cloud = gathered(Cloud.from_columns({name: np.array(part[name]) for name in names}, titles)
                     for start in range(0, max(len(table), 1), PIECE_POINTS)
                     for part in [table[start:start + PIECE_POINTS]])
    # Faces count the file's vertices.
    notes = () if cloud.left_out else tuple(mesh_notes(path, cloud.points, _triangles(content)))
    comments = "\n".join([*content.comments, *content.obj_info])
    return replace(cloud, unit=stated_unit(comments), notes=notes)


def _triangles(content: Any) -> np.ndarray:
    """The first three corners of each face, shape [m, 3]."""
    if "face" not in content:
        return np.empty((0, 3), int)
    faces = content["face"].data
    lists: Any = next((faces[name] for name in ("vertex_indices", "vertex_index")
                  if name in (faces.dtype.names or ())), [])
    return np.array([face[:3] for face in lists if len(face) >= 3], int).reshape(-1, 3)


def _ply_content(path: Path) -> tuple[Any, dict[str, str]]:
    """Read a PLY file, and its names of the properties that are not ASCII.

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
