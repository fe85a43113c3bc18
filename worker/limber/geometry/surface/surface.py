"""Triangle surfaces: the type, its file, and the checks that a branch's surface must pass."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from limber.core.errors import Command, InputError, MeshingError
from limber.core.files.reading import check_ply
from limber.core.json_values import stored_lengths
from limber.core.numerics.compiled import compiled_exactly


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

_EDGE = 1e-7  # touching is not crossing: faces of a union meet at rounding distance


@compiled_exactly
def by_cell(first: np.ndarray, last: np.ndarray, counts: np.ndarray,
            ) -> tuple[np.ndarray, np.ndarray]:
    """Numbers [k] of the grid cells that the faces' boxes, from cell ``first`` to ``last`` [n, 3],
    overlap, and the face in each [k]. ``counts`` [3] is the number of cells in each direction."""
    total = 0
    for f in range(len(first)):
        total += ((last[f, 0] - first[f, 0] + 1) * (last[f, 1] - first[f, 1] + 1)
                  * (last[f, 2] - first[f, 2] + 1))
    keys, owner = np.empty(total, np.int64), np.empty(total, np.int64)
    at = 0
    for f in range(len(first)):
        for i in range(first[f, 0], last[f, 0] + 1):
            for j in range(first[f, 1], last[f, 1] + 1):
                for k in range(first[f, 2], last[f, 2] + 1):
                    keys[at] = (i * counts[1] + j) * counts[2] + k
                    owner[at] = f
                    at += 1
    return keys, owner


@compiled_exactly
def pierced(vertices: np.ndarray, faces: np.ndarray, low: np.ndarray, high: np.ndarray,
            first: np.ndarray, counts: np.ndarray, keys: np.ndarray, owner: np.ndarray,
            ) -> np.ndarray:
    """Points [m] where an edge of one face passes through another one, shape [c, 3]; see
    :func:`crossings`. Faces have boxes ``low`` to ``high`` [n, 3] [m] from the cell ``first``;
    ``keys`` [k] ascend, numbered by :func:`by_cell`, with the face ``owner`` in each."""
    found = [(0.0, 0.0, 0.0) for _ in range(0)]
    begin = 0
    while begin < len(keys):
        end = begin + 1
        while end < len(keys) and keys[end] == keys[begin]:
            end += 1
        for i in range(begin, end):
            for j in range(i + 1, end):
                one, other = owner[i], owner[j]
                near = True
                for k in range(3):
                    near &= low[one, k] <= high[other, k] and low[other, k] <= high[one, k]
                # Of all cells that contain both, only the lowest compares them.
                if near and keys[begin] == (
                        (max(first[one, 0], first[other, 0]) * counts[1]
                         + max(first[one, 1], first[other, 1])) * counts[2]
                        + max(first[one, 2], first[other, 2])):
                    _compare(vertices, faces, one, other, found)
                    _compare(vertices, faces, other, one, found)
        begin = end
    points = np.empty((len(found), 3))
    for k in range(len(found)):
        points[k, 0], points[k, 1], points[k, 2] = found[k]
    return points


@compiled_exactly
def _compare(vertices: np.ndarray, faces: np.ndarray, one: int, other: int, found: list) -> None:
    """Add the points where edges of ``one`` pass through ``other`` (Moeller and Trumbore 1997)."""
    o, p, q = faces[other, 0], faces[other, 1], faces[other, 2]
    common, number = 0, 0  # shared corners of ``one`` and ``other``, a bit each
    for i in range(3):
        corner = faces[one, i]
        if corner == o or corner == p or corner == q:
            common |= 1 << i
            number += 1
    if number > 1:
        return
    ox, oy, oz = vertices[o, 0], vertices[o, 1], vertices[o, 2]
    sx, sy, sz = vertices[p, 0] - ox, vertices[p, 1] - oy, vertices[p, 2] - oz
    ex, ey, ez = vertices[q, 0] - ox, vertices[q, 1] - oy, vertices[q, 2] - oz
    for i in range(3):
        after = (i + 1) % 3
        if common & (1 << i | 1 << after):
            continue
        a, b = faces[one, i], faces[one, after]
        ax, ay, az = vertices[a, 0], vertices[a, 1], vertices[a, 2]
        bx, by, bz = vertices[b, 0], vertices[b, 1], vertices[b, 2]
        dx, dy, dz = bx - ax, by - ay, bz - az
        cx, cy, cz = dy * ez - dz * ey, dz * ex - dx * ez, dx * ey - dy * ex
        det = sx * cx + sy * cy + sz * cz
        size = np.sqrt((sx * sx + sy * sy + sz * sz) * (dx * dx + dy * dy + dz * dz)
                       * (ex * ex + ey * ey + ez * ez))
        if abs(det) <= 1e-9 * size:
            continue
        fx, fy, fz = ax - ox, ay - oy, az - oz
        u = (fx * cx + fy * cy + fz * cz) / det
        tx, ty, tz = fy * sz - fz * sy, fz * sx - fx * sz, fx * sy - fy * sx
        v = (dx * tx + dy * ty + dz * tz) / det
        t = (ex * tx + ey * ty + ez * tz) / det
        if u > _EDGE and v > _EDGE and u + v < 1 - _EDGE and _EDGE < t < 1 - _EDGE:
            found.append((ax + t * dx, ay + t * dy, az + t * dz))


# Distance of points from a triangle surface: exact, by a grid of cells.


def distance_to_surface(points: np.ndarray, surface: Surface) -> np.ndarray:
    """Distances [m] of points [n, 3] from a surface, shape [n]."""
    low, _, cell, _, counts, keys, owner = _cells(surface)
    # No farther than the nearest vertex, so that few cells are searched.
    bound, _ = cKDTree(surface.vertices).query(points)
    return _distances(np.ascontiguousarray(points, np.float64), bound,
                      np.ascontiguousarray(surface.vertices[surface.faces]), low.min(axis=0), cell,
                      counts, keys, owner)


@compiled_exactly
def _distances(points: np.ndarray, bound: np.ndarray, corner: np.ndarray, origin: np.ndarray,
               cell: float, counts: np.ndarray, keys: np.ndarray, owner: np.ndarray) -> np.ndarray:
    found = np.empty(len(points))
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for p in range(len(points)):
        best = bound[p] * bound[p]
        for k in range(3):
            low[k] = max(int(np.floor((points[p, k] - bound[p] - origin[k]) / cell)), 0)
            high[k] = min(int(np.floor((points[p, k] + bound[p] - origin[k]) / cell)),
                          counts[k] - 1)
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                row = (i * counts[1] + j) * counts[2]
                at = np.searchsorted(keys, row + low[2])
                while at < len(keys) and keys[at] <= row + high[2]:
                    best = min(best, _square(points[p], corner[owner[at]]))
                    at += 1
        found[p] = np.sqrt(best)
    return found


@compiled_exactly
def _square(p: np.ndarray, corner: np.ndarray) -> float:
    """Square of the distance of a point from a triangle (Ericson, Real-Time Collision Detection,
    5.1.5)."""
    bx, by, bz = (corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1],
                  corner[1, 2] - corner[0, 2])
    cx, cy, cz = (corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1],
                  corner[2, 2] - corner[0, 2])
    px, py, pz = p[0] - corner[0, 0], p[1] - corner[0, 1], p[2] - corner[0, 2]
    d1, d2 = bx * px + by * py + bz * pz, cx * px + cy * py + cz * pz
    bb, cc = bx * bx + by * by + bz * bz, cx * cx + cy * cy + cz * cz
    bc = bx * cx + by * cy + bz * cz
    # The same products with the point seen from the other two corners.
    d3, d4, d5, d6 = d1 - bb, d2 - bc, d1 - bc, d2 - cc
    v, w = 0.0, 0.0
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0 and d2 <= 0:
        v, w = 0.0, 0.0
    elif d3 >= 0 and d4 <= d3:
        v, w = 1.0, 0.0
    elif d6 >= 0 and d5 <= d6:
        v, w = 0.0, 1.0
    elif vc <= 0 and d1 >= 0 and d3 <= 0:
        v, w = (d1 / (d1 - d3) if d1 > d3 else 0.0), 0.0
    elif vb <= 0 and d2 >= 0 and d6 <= 0:
        v, w = 0.0, (d2 / (d2 - d6) if d2 > d6 else 0.0)
    elif va <= 0 and d4 - d3 >= 0 and d5 - d6 >= 0:
        total = (d4 - d3) + (d5 - d6)
        w = (d4 - d3) / total if total > 0 else 0.0
        v = 1.0 - w
    else:
        total = va + vb + vc
        v, w = (vb / total, vc / total) if total > 0 else (0.0, 0.0)
    x, y, z = px - v * bx - w * cx, py - v * by - w * cy, pz - v * bz - w * cz
    return x * x + y * y + z * z
