"""Triangle surfaces: the type, its file, and the checks that a branch's surface must pass."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from limber.core.errors import Command, InputError, MeshingError
from limber.core.files.reading import check_ply
from limber.core.json_values import stored_lengths
from limber.kernels import Kernel


@dataclass(frozen=True)
class Surface:
    """A triangle surface; faces are counter-clockwise seen from outside.

    Attributes:
        vertices: Positions [m], shape [vertex_count, 3].
        faces: Vertex indices, shape [face_count, 3].
    """

    vertices: np.ndarray
    faces: np.ndarray

    @property
    def volume(self) -> float:
        """Enclosed volume [m^3]; negative if the faces point inwards."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)

    @property
    def area(self) -> float:
        """Area [m^2]."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)

    @property
    def handle_count(self) -> int:
        """Handles of a closed surface in one piece (its genus): 0 for a tree, 1 for a ring."""
        used = len(np.unique(self.faces))
        return max(round((2 - used + len(self.faces) / 2) / 2), 0)

    def winding(self, points: np.ndarray) -> np.ndarray:
        """Return the winding number around points [n, 3] [m], shape [n] (Van Oosterom and Strackee
        1983): 1 inside a closed surface, 0 outside."""
        a, b, c = (self.vertices[self.faces[:, k]][None] - points[:, None] for k in range(3))
        la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
        over = np.einsum("nij,nij->ni", a, np.cross(b, c))
        under = (la * lb * lc + np.einsum("nij,nij->ni", a, b) * lc
                 + np.einsum("nij,nij->ni", b, c) * la + np.einsum("nij,nij->ni", c, a) * lb)
        return np.arctan2(over, under).sum(axis=1) / (2 * np.pi)

    def write_ply(self, path: Path) -> None:
        """Write a binary PLY file, in nanometres: single precision could make faces cross."""
        from plyfile import PlyData, PlyElement

        vertex = np.ascontiguousarray(stored_lengths(self.vertices)).view(
            [("x", "f8"), ("y", "f8"), ("z", "f8")])[:, 0]
        face = np.zeros(len(self.faces), [("vertex_indices", "i4", (3,))])
        face["vertex_indices"] = self.faces
        PlyData([PlyElement.describe(vertex, "vertex"), PlyElement.describe(face, "face")],
                byte_order="<", comments=["unit: m"]).write(str(path))

    @classmethod
    def read(cls, path: Path, *, scale: float = 1.0) -> "Surface":
        """Read triangles from STL, PLY, OBJ or OFF; equal vertices are merged.

        Args:
            path: The file.
            scale: Metres per unit of the file.

        Raises:
            InputError: the file cannot be read, or holds no triangles or numbers that are not
            finite.
        """
        import trimesh

        path = Path(path)
        if not path.is_file():
            raise InputError(f"There is no file {path}.", "", "Check the path.")
        try:
            if path.suffix.lower() == ".ply":
                check_ply(path)
            mesh = trimesh.load_mesh(path, process=True)
            # Programs write a vertex once for each of its normals and texture coordinates.
            if isinstance(mesh, trimesh.Trimesh):
                mesh.merge_vertices(merge_tex=True, merge_norm=True)
        except Exception as error:  # trimesh's readers raise the errors of their parsers
            raise InputError(f"{path} cannot be read as a surface ({error}).",
                             "STL, PLY, OBJ or OFF was expected.", "Export it again.") from error
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
            raise InputError(f"{path} has no triangles.", "A closed surface was expected.",
                             "For a point cloud, use ", Command("reconstruct"), ".")
        vertices = np.asarray(mesh.vertices, float) * scale
        if not np.isfinite(vertices).all():
            raise InputError(f"{path} has vertices that are not finite.",
                             "Positions must be finite numbers.", "Export it again.")
        return cls(vertices, np.asarray(mesh.faces, np.int64))


# Checks of a branch's surface: closed, oriented, of positive volume, free of crossings.


@dataclass(frozen=True)
class SurfaceCheck:
    """Findings about a surface: positions [m] of edges that do not have two faces [k, 3] and of
    crossings [c, 3]. ``oriented``: the two faces of an edge agree, and the volume is positive."""

    watertight: bool
    oriented: bool
    open_edges: np.ndarray
    crossings: np.ndarray
    volume_m3: float
    piece_count: int = field(default=1)

    @property
    def valid(self) -> bool:
        return self.watertight and self.oriented and len(self.crossings) == 0

    def as_dict(self) -> dict[str, Any]:
        return {"watertight": self.watertight, "oriented": self.oriented,
                "self_intersection_count": len(self.crossings), "pieces": self.piece_count}

    def require(self) -> "SurfaceCheck":
        """Return self if valid; else MeshingError, which names the first position."""
        if not self.watertight:
            raise MeshingError(f"The surface has {len(self.open_edges)} open edges or edges with "
                               "more than two faces, one of them at "
                               f"{position_text(self.open_edges[0])}.",
                               "The surface must be closed.",
                               "Prune the skeleton there, or close the holes of the surface.")
        if not self.oriented:
            raise MeshingError("Not all faces of the surface point outwards.",
                               "All faces must have the same orientation.",
                               "Make the normals consistent.")
        if len(self.crossings):
            raise MeshingError(f"The surface intersects itself at {len(self.crossings)} points, "
                               f"one of them at {position_text(self.crossings[0])}.",
                               "The surface of a solid must not intersect itself.",
                               "Edit the skeleton there, or smooth it.")
        return self


def check_surface(surface: Surface) -> SurfaceCheck:
    """Check a surface; takes about half a second for 100,000 faces."""
    edges, counts, balance = edges_of(surface.faces)
    wrong, volume = counts != 2, surface.volume
    return SurfaceCheck(
        not wrong.any(), bool((balance[counts == 2] == 0).all()) and volume > 0,
        surface.vertices[edges[wrong]].mean(axis=1), crossings(surface), volume,
        int(pieces(surface).max(initial=-1)) + 1)


def edges_of(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the edges of triangles [f, 3] once each by their ends [e, 2], the number of faces at
    each [e], and of those that run through it upwards less downwards [e]: 0 if two faces agree."""
    ends = np.vstack([faces[:, [k, (k + 1) % 3]] for k in range(3)])
    # Both ends in one number: this sorts ten times as fast as rows.
    base = int(faces.max(initial=0)) + 1
    key, inverse, counts = np.unique(ends.min(axis=1) * base + ends.max(axis=1),
                                     return_inverse=True, return_counts=True)
    turn = np.where(ends[:, 0] < ends[:, 1], 1, -1)
    return (np.column_stack(np.divmod(key, base)), counts,
            np.bincount(inverse.ravel(), turn, len(counts)))


def pieces(surface: Surface) -> np.ndarray:
    """The connected piece that each vertex belongs to, shape [vertex_count]; -1 without faces."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    used, faces = np.unique(surface.faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    rows, columns = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), (len(used),) * 2)
    label = np.full(len(surface.vertices), -1)
    label[used] = connected_components(graph, directed=False)[1]
    return label


def crossings(surface: Surface) -> np.ndarray:
    """Return points [m] where an edge of one face passes through another face, shape [c, 3]. Faces
    that share an edge are not compared; of those that share a corner, only the opposite edges."""
    if len(surface.faces) == 0:
        return np.empty((0, 3))
    faces = np.ascontiguousarray(surface.faces, np.int64)
    low, high, _, first, counts, keys, owner = _cells(surface)
    return pierced(np.ascontiguousarray(surface.vertices, np.float64), faces, low, high, first,
                   counts, keys, owner)


def _cells(surface: Surface) -> tuple:
    """A grid of cells over the faces: boxes of the faces ``low`` and ``high`` [n, 3] [m], edge of a
    cell [m], each face's first cell [n, 3], number of cells [3], and by ascending number of the
    cell those numbers and the face in each, see :func:`by_cell`."""
    corner = surface.vertices[surface.faces]
    low, high = corner.min(axis=1), corner.max(axis=1)
    extent = (high - low).max(axis=1)
    # A cell has a few faces, and a face is in few cells.
    cell = max(1.5 * float(np.median(extent)), float(extent.max()) / 24, 1e-12)
    first = np.floor((low - low.min(axis=0)) / cell).astype(np.int64)
    last = np.floor((high - low.min(axis=0)) / cell).astype(np.int64)
    counts = last.max(axis=0) + 1
    keys, owner = by_cell(first, last, counts)
    order = np.argsort(keys, kind="stable")
    return low, high, cell, first, counts, keys[order], owner[order]


def position_text(point: np.ndarray) -> str:
    """Return a position [m] as messages name it."""
    return "(" + ", ".join(f"{v:.4f}" for v in point) + ") m"


# Crossings of a surface's faces: a grid of cells, and Moeller and Trumbore's test within them.

_by_cell = Kernel(
    "cells_of_faces", "first int64[faces, 3]", "last int64[faces, 3]", "counts int64[3]",
    "out keys int64[entries]", "out owner int64[entries]", returns="int")
_pierced = Kernel(
    "faces_pierced", "vertices float64[vertices, 3]", "faces int64[faces, 3]",
    "low float64[faces, 3]", "high float64[faces, 3]", "first int64[faces, 3]", "counts int64[3]",
    "keys int64[entries]", "owner int64[entries]", "out points float64[room, 3]", returns="int")
_distances = Kernel(
    "surface_distances", "points float64[points, 3]", "bound float64[points]",
    "corner float64[faces, 3, 3]", "origin float64[3]", "counts int64[3]", "keys int64[entries]",
    "owner int64[entries]", "out found float64[points]", "cell float")


def by_cell(first: np.ndarray, last: np.ndarray, counts: np.ndarray,
            ) -> tuple[np.ndarray, np.ndarray]:
    """Numbers [k] of the grid cells that the faces' boxes, from cell ``first`` to ``last`` [n, 3],
    overlap, and the face in each [k]. ``counts`` [3] is the number of cells in each direction."""
    none = np.empty(0, np.int64)
    total = _by_cell.of(first, last, counts, none, none)
    keys, owner = np.empty((2, total), np.int64)
    _by_cell.of(first, last, counts, keys, owner)
    return keys, owner


def pierced(vertices: np.ndarray, faces: np.ndarray, low: np.ndarray, high: np.ndarray,
            first: np.ndarray, counts: np.ndarray, keys: np.ndarray, owner: np.ndarray,
            ) -> np.ndarray:
    """Points [m] where an edge of one face passes through another one, shape [c, 3]; see
    :func:`crossings`. Faces have boxes ``low`` to ``high`` [n, 3] [m] from the cell ``first``;
    ``keys`` [k] ascend, numbered by :func:`by_cell`, with the face ``owner`` in each."""
    points = np.empty((0, 3))
    while (count := _pierced.of(vertices, faces, low, high, first, counts, keys, owner,
                                points)) > len(points):
        points = np.empty((count, 3))
    return points


# Distance of points from a triangle surface: exact, by a grid of cells.


def distance_to_surface(points: np.ndarray, surface: Surface) -> np.ndarray:
    """Distances [m] of points [n, 3] from a surface, shape [n]."""
    low, _, cell, _, counts, keys, owner = _cells(surface)
    # No farther than the nearest vertex, so that few cells are searched.
    bound, _ = cKDTree(surface.vertices).query(points)
    found = np.empty(len(points))
    _distances.of(points, bound, surface.vertices[surface.faces], low.min(axis=0), counts, keys,
                  owner, found, cell)
    return found
