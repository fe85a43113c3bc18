"""Tetrahedral meshes, made by geometry and used by mechanics: the type and its file.

Nodes of a quadratic tetrahedron follow VTK: four corners, then the middles of the edges
01, 12, 20, 03, 13, 23.
"""

import hashlib
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from limber.core.errors import Command, InputError, MeshingError
from limber.core.json_values import stored_lengths
from limber.geometry.settings import GRASP_FRACTION
from limber.geometry.skeleton.skeleton import FRACTIONS, Skeleton, control_points
from limber.geometry.surface.surface import Surface
from limber.geometry.tets.element_types import (
    EDGES,
    ElementType,
    element_with,
    elements_by_cell_type,
    is_known,
)

FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
"""Corners of the four faces, counter-clockwise seen from outside."""


@dataclass(frozen=True)
class TetMesh:
    """Tetrahedra with data on them; all arrays read-only by convention.

    Attributes:
        nodes: Positions [m], shape [node_count, 3].
        tets: Node indices, shape [tet_count, 4] (linear), [tet_count, 10] (quadratic), or as many
            as a registered element has.
        cell_data: Name to array of shape [tet_count, ...]: ``young`` [Pa], ``poisson``.
        point_data: Name to array of shape [node_count, ...]: ``fixed`` (0 or 1),
            ``control_point`` (index or -1), ``grasp`` (0 or 1).
    """

    nodes: np.ndarray
    tets: np.ndarray
    cell_data: dict[str, np.ndarray] = field(default_factory=dict)
    point_data: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def node_count(self) -> int:
        return len(self.nodes)

    @property
    def tet_count(self) -> int:
        return len(self.tets)

    @property
    def element(self) -> ElementType:
        return element_with(self.tets.shape[1])

    @property
    def is_quadratic(self) -> bool:
        return self.tets.shape[1] == 10

    @property
    def volumes(self) -> np.ndarray:
        """Signed volumes of the straight-sided tetrahedra [m^3], shape [tet_count]."""
        corner = self.nodes[self.tets[:, :4]]
        return np.linalg.det(corner[:, 1:] - corner[:, :1]) / 6.0

    @property
    def centroids(self) -> np.ndarray:
        """Centroids of the corners [m], shape [tet_count, 3]."""
        return self.nodes[self.tets[:, :4]].mean(axis=1)

    def oriented(self) -> "TetMesh":
        """Return the mesh with every tetrahedron positively oriented."""
        flip = self.volumes < 0
        tets = self.tets.copy()
        tets[flip] = tets[flip][:, list(self.element.mirrored)]
        return replace(self, tets=tets)

    def quadratic(self) -> "TetMesh":
        """Return the mesh with straight-sided 10-node tetrahedra; corner nodes keep their index.

        Point data of a mid-side node is that of both corners where they agree; a flag (integer
        data) that they do not share is 0 there, or -1 for ``control_point``.
        """
        if self.is_quadratic:
            return self
        if self.tets.shape[1] > 4:
            return self.linear().quadratic()
        pairs = np.sort(self.tets[:, EDGES], axis=2).reshape(-1, 2)
        edges, inverse = np.unique(pairs, axis=0, return_inverse=True)
        middle = self.node_count + inverse.reshape(-1, 6)
        nodes = np.vstack([self.nodes, self.nodes[edges].mean(axis=1)])
        point_data = {name: np.concatenate([values, _on_edges(name, values, edges)])
                      for name, values in self.point_data.items()}
        return replace(self, nodes=nodes, tets=np.hstack([self.tets, middle]),
                       point_data=point_data)

    def linear(self) -> "TetMesh":
        """Return the mesh of the corners alone; unused nodes are dropped."""
        if self.tets.shape[1] == 4:
            return self
        used, inverse = np.unique(self.tets[:, :4], return_inverse=True)
        return replace(self, nodes=self.nodes[used], tets=inverse.reshape(-1, 4),
                       point_data={k: v[used] for k, v in self.point_data.items()})

    def surface_faces(self) -> np.ndarray:
        """Return the boundary triangles (corner nodes, outward), shape [face_count, 3]."""
        faces = self.tets[:, FACES].reshape(-1, 3)
        _, first, count = np.unique(
            np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
        return faces[np.sort(first[count == 1])]

    def with_data(self, *, cell_data: dict[str, np.ndarray] | None = None,
                  point_data: dict[str, np.ndarray] | None = None) -> "TetMesh":
        """Return the mesh with some data added or replaced."""
        return replace(self, cell_data=self.cell_data | (cell_data or {}),
                       point_data=self.point_data | (point_data or {}))

    def geometry_digest(self) -> str:
        """Return a sha256 of nodes, tetrahedra and point data, which E does not change."""
        digest = hashlib.sha256()
        arrays = [self.nodes, self.tets.astype(np.int64)]
        arrays += [self.point_data[name] for name in sorted(self.point_data)]
        for array in arrays:
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def check(self, path: Path) -> None:
        """Refuse a mesh read from ``path`` that cannot be used in computations.

        Raises:
            InputError: positions or data that are not finite, missing nodes, or moduli
                and densities that are not positive.
        """
        data = {**self.point_data, **self.cell_data}
        counts = dict.fromkeys(self.point_data, self.node_count)
        counts |= dict.fromkeys(self.cell_data, self.tet_count)
        trouble = ""
        if self.nodes.ndim != 2 or self.nodes.shape[1] != 3 or not np.isfinite(self.nodes).all():
            trouble = "nodes without a finite position"
        elif not (self.tet_count and self.tets.ndim == 2 and is_known(self.tets.shape[1])
                  and self.tets.min() >= 0 and self.tets.max() < self.node_count):
            trouble = "tetrahedra with nodes that do not exist"
        for name, values in data.items():
            if values.dtype.kind not in "iufb" or len(values) != counts[name] or not (
                    np.isfinite(values).all()):
                trouble = trouble or (f"data {name} without a finite number for each node or "
                                      "tetrahedron")
            elif name in ("young", "density") and not (values > 0).all():
                trouble = trouble or f"data {name} that are not positive"
        if trouble:
            raise InputError(f"{path} has {trouble}.", "The mesh cannot be used for computations.",
                             "The file is damaged. Make the mesh again.")

    def write(self, path: Path) -> None:
        """Write a VTU file that ParaView opens."""
        import meshio

        if not self.element.cell_type:
            raise InputError(f"VTU files have no cell for the element {self.element.name!r}.",
                             "The mesh cannot be written.", "Write its linear or quadratic mesh.")
        # meshio converts tetra10 between its own (Gmsh-like) and VTK's node order, but not for VTU,
        # where it keeps the order; test_tet_mesh checks that.
        meshio.write_points_cells(
            path, self.nodes, [(self.element.cell_type, self.tets)],
            file_format="vtu", point_data=self.point_data,
            cell_data={name: [values] for name, values in self.cell_data.items()})

    @classmethod
    def read(cls, path: Path) -> "TetMesh":
        """Read tetrahedra from a VTU file.

        Raises:
            InputError: the file has no tetrahedra or cannot be read.
        """
        # Not meshio.read: it prints and calls sys.exit where a file is damaged.
        from meshio import vtu

        try:
            mesh = vtu.read(path)
        except MemoryError:
            raise
        except Exception as error:  # errors of XML, base64, zlib, numpy and its own
            raise InputError(f"{path} cannot be read as a mesh ({error}).",
                             "A VTU file with tetrahedra was expected.",
                             "Check the file, or make the mesh again.") from error
        for number, block in enumerate(mesh.cells):
            if block.type in elements_by_cell_type():
                cell_data = {name: np.asarray(parts[number])
                             for name, parts in mesh.cell_data.items()}
                point_data = {name: np.asarray(v) for name, v in mesh.point_data.items()}
                found = cls(np.asarray(mesh.points, float), np.asarray(block.data, np.int64),
                            cell_data, point_data)
                found.check(path)
                return found
        kinds = ", ".join(sorted({block.type for block in mesh.cells})) or "no cells"
        raise InputError(f"{path} holds {kinds}.", "Tetrahedra were expected.",
                         "Use ", Command("mesh"), " to fill a closed surface with tetrahedra.")


def _on_edges(name: str, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    first, second = values[edges[:, 0]], values[edges[:, 1]]
    if np.issubdtype(values.dtype, np.integer):
        other = -1 if name == "control_point" else 0
        return np.where(first == second, first, other).astype(values.dtype)
    return (first + second) / 2


# Marks on a mesh: nodes that are fixed, grasped, or represent a control point.

FACE_COSINE, FLAT_SHARE = 0.8, 0.5
"""Least cosine between a base face's normal and the axis; least fraction of the root's section that
these faces must cover, or there is no flat face.
"""
CLAMP_BAND = 0.2
"""Length that is held if there is no flat face, in radii of the root."""


def mark(mesh: TetMesh, skeleton: Skeleton, *, young: float, poisson: float, density: float,
         fractions: tuple[float, ...] = FRACTIONS, grasp_fraction: float = GRASP_FRACTION,
         ) -> TetMesh:
    """Return a quadratic mesh, its nodes as files store them, with material (Pa, kg/m^3), base, and
    control points and grasp patch at fractions of the main path. MeshingError if base or patch has
    under three nodes."""
    mesh = replace(mesh, nodes=stored_lengths(mesh.nodes))
    tree = cKDTree(mesh.nodes)
    control = np.full(mesh.node_count, -1, np.int64)
    # Last first: where two are at the same node, the earlier one keeps it.
    for k, point in reversed(list(enumerate(control_points(skeleton, fractions)))):
        control[tree.query(point)[1]] = k
    full = np.ones(mesh.tet_count)
    return mesh.with_data(
        cell_data={"young": young * full, "poisson": poisson * full, "density": density * full},
        point_data={"fixed": base_nodes(mesh, skeleton), "control_point": control,
                    "grasp": patch_nodes(mesh, skeleton, grasp_fraction)})


def base_nodes(mesh: TetMesh, skeleton: Skeleton) -> np.ndarray:
    """1 for the nodes of the face at the root, else 0, shape [node_count]. Held nodes above it
    would shorten the branch as the mesh becomes finer. Where there is no flat face (a scan rounded
    or ragged below), they are those of a band of ``CLAMP_BAND`` radii."""
    path = skeleton.main_path()
    ahead = skeleton.nodes[path[1:]] - skeleton.nodes[path[0]]
    # A fit to few points may put a node onto the root.
    direction = ahead[np.argmax(ahead.any(axis=1))]
    direction = direction / np.linalg.norm(direction)
    offset = mesh.nodes - skeleton.nodes[path[0]]
    along = offset @ direction
    across = np.linalg.norm(offset - along[:, None] * direction, axis=1)
    radius = max(float(skeleton.radius[path[0]]), 1e-9)
    beside = across < 2.0 * radius
    lowest = min(along[beside].min() if beside.any() else 0.0, 0.0)
    faces = mesh.surface_faces()
    corners = mesh.nodes[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1) / 2
    down = -(normals @ direction) / np.maximum(2 * area, 1e-300)
    # A mesher moves a flat face a little, and a cut may be oblique; its edge is still sharp.
    low = (along[faces].max(axis=1) < lowest + 0.5 * radius) & beside[faces].all(axis=1)
    face = low & (down > FACE_COSINE)
    if area[face].sum() < FLAT_SHARE * np.pi * radius**2:
        return _checked(beside & (along < max(lowest, 0.0) + CLAMP_BAND * radius), "base")
    return _checked(_nodes_of(mesh, faces[face]), "base")


def _nodes_of(mesh: TetMesh, faces: np.ndarray) -> np.ndarray:
    """Whether a node is on one of these faces, nodes halfway along their edges included."""
    chosen = np.zeros(mesh.node_count, bool)
    chosen[faces] = True
    if mesh.is_quadratic:
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        keys = edges[:, 0] * mesh.node_count + edges[:, 1]
        ends = np.sort(mesh.tets[:, EDGES], axis=2)
        on_face = np.isin(ends[..., 0] * mesh.node_count + ends[..., 1], keys)
        chosen[mesh.tets[:, 4:][on_face]] = True
    return chosen


def patch_nodes(mesh: TetMesh, skeleton: Skeleton, fraction: float) -> np.ndarray:
    """1 for the nodes that a gripper at ``fraction`` of the main path holds, else 0."""
    centre = skeleton.point_at(fraction)
    ahead = skeleton.point_at(min(fraction + 0.01, 1.0))
    behind = skeleton.point_at(max(fraction - 0.01, 0.0))
    direction = (ahead - behind) / np.linalg.norm(ahead - behind)
    radius = skeleton.radius_at(fraction)
    offset = mesh.nodes - centre
    along = np.abs(offset @ direction)
    across = np.linalg.norm(offset - (offset @ direction)[:, None] * direction, axis=1)
    # Fingers are about as wide as the branch is thick; a coarse mesh may need a wider patch.
    for width in (1.0, 1.5, 2.0, 3.0, 5.0):
        chosen = (along < width * radius) & (across < 1.6 * radius)
        if chosen.sum() >= 6:
            break
    else:
        chosen = np.zeros(mesh.node_count, bool)
        chosen[np.argsort(np.linalg.norm(offset, axis=1))[:6]] = True
    return _checked(chosen, "grasp patch")


def _checked(chosen: np.ndarray, what: str) -> np.ndarray:
    if chosen.sum() < 3:
        raise MeshingError(f"The {what} has {int(chosen.sum())} nodes.",
                           "At least three nodes are needed to hold a branch.", "Use a finer mesh.")
    return chosen.astype(np.int64)


# Checks that a mesh can be computed, and that its fixed nodes hold it.


def fixed_mask(mesh: TetMesh, fixed: np.ndarray | None) -> np.ndarray:
    """Return the mask of fixed nodes; InputError if they are fewer than three or all on a line, so
    that the branch could rotate freely."""
    if fixed is None:
        fixed = mesh.point_data.get("fixed", np.zeros(mesh.node_count))
        fixed = np.asarray(fixed) > 0.5
    fixed = np.asarray(fixed)
    if fixed.dtype != bool:
        mask = np.zeros(mesh.node_count, bool)
        mask[fixed] = True
        fixed = mask
    points = mesh.nodes[fixed]
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) if len(points) else [0]
    if len(points) < 3 or spread[1] < 1e-6 * max(spread[0], 1e-12):
        raise InputError(f"{len(points)} nodes are fixed: fewer than three, or all on one line.",
                         "The branch could move freely, so the static problem has no solution.",
                         "Mark the nodes of the base in point data `fixed`.")
    return fixed


def check_mesh(mesh: TetMesh) -> None:
    """Raise InputError for a mesh that cannot be computed: not finite, unused nodes, pieces."""
    if not np.isfinite(mesh.nodes).all():
        raise InputError("The mesh has nodes that are not finite.", "Each node needs a position.",
                         "Mesh the surface again.")
    if mesh.tets.ndim != 2 or not is_known(mesh.tets.shape[1]) or not mesh.tet_count:
        raise InputError(f"The tetrahedra have shape {mesh.tets.shape}.",
                         "Each tetrahedron needs 4 or 10 nodes, or those of a registered "
                         "element.", "Mesh the surface again.")
    used = np.zeros(mesh.node_count, bool)
    used[mesh.tets] = True
    if not used.all():
        raise InputError(f"{np.count_nonzero(~used)} nodes do not belong to any tetrahedron.",
                         "These nodes could move freely.", "Remove them from the mesh.")
    corners = mesh.tets[:, :4]
    links = sp.csr_matrix((np.ones(3 * len(corners)), (np.repeat(corners[:, 0], 3),
                                                       corners[:, 1:].ravel())),
                          (mesh.node_count, mesh.node_count))
    _, label = connected_components(links, directed=False)
    pieces = np.unique(label[np.unique(corners)], return_counts=True)[1]
    if len(pieces) > 1:
        raise InputError(f"The mesh has {len(pieces)} separate pieces with "
                         f"{', '.join(map(str, sorted(pieces)[::-1]))} corner nodes.",
                         "A piece without a connection to the fixed base could move freely.",
                         "Join the parts of the surface before meshing, or keep the largest part.")


# Quality of a tetrahedral mesh: volume, dihedral angles, radius ratios, elements across.

FLAT = 0.02
"""Shape of a tetrahedron (1 is regular) below which it is avoided."""


@dataclass(frozen=True)
class MeshQuality:
    """Measures of a tetrahedral mesh.

    Attributes:
        volume_ratio: Its volume over the surface's.
        min_dihedral_deg: Smallest angle between two faces of a tetrahedron.
        min_radius_ratio: Smallest 3 r_in / r_out; 1 is regular, 0 flat.
        elements_across: Median over the nodes of the skeleton of the diameter over the mean edge
            of the elements there; None without a skeleton.
        surface_distance_mean: Mean distance of the mesh's boundary (its corners, edge middles and
            face centres) from the surface, in local radii; None without a surface.
        fork_distance_mean: Mean of the distances within two radii of a fork, in radii.
        fork_distance_max: The largest of them, in radii.
    """

    tet_count: int
    volume_m3: float
    volume_ratio: float
    min_dihedral_deg: float
    min_radius_ratio: float
    mean_radius_ratio: float
    elements_across: float | None
    surface_distance_mean: float | None = None
    surface_distance_max_m: float | None = None
    fork_distance_mean: float | None = None
    fork_distance_max: float | None = None

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def measure_quality(mesh: TetMesh, surface_volume: float, skeleton: Skeleton | None = None,
                    surface: Surface | None = None) -> MeshQuality:
    """Measure a mesh against the surface it fills (volume [m^3]) and, if given, its skeleton."""
    ratio = radius_ratios(mesh)
    volume = float(mesh.volumes.sum())
    distances = {} if skeleton is None or surface is None else _surface_distances(
        mesh, skeleton, surface)
    return MeshQuality(
        mesh.tet_count, volume, volume / surface_volume, float(dihedral_angles(mesh).min()),
        float(ratio.min()), float(ratio.mean()),
        None if skeleton is None else _elements_across(mesh, skeleton), **distances)


def _surface_distances(mesh: TetMesh, skeleton: Skeleton, surface: Surface) -> dict[str, Any]:
    from limber.geometry.surface.surface import distance_to_surface

    corner = mesh.nodes[mesh.surface_faces()]
    points = np.vstack([corner.reshape(-1, 3), corner.mean(axis=1),
                        ((corner + corner[:, [1, 2, 0]]) / 2).reshape(-1, 3)])
    points = np.unique(points, axis=0)
    distance = distance_to_surface(points, surface)
    _, near = cKDTree(skeleton.nodes).query(points)
    share = distance / np.maximum(skeleton.radius[near], 1e-300)
    found: dict[str, Any] = {"surface_distance_mean": float(share.mean()),
                             "surface_distance_max_m": float(distance.max())}
    forks = skeleton.forks()
    if len(forks):
        away, fork = cKDTree(skeleton.nodes[forks]).query(points)
        at_fork = away < 2 * skeleton.radius[forks][fork]
        if at_fork.any():
            local = distance[at_fork] / skeleton.radius[forks][fork[at_fork]]
            found |= {"fork_distance_mean": float(local.mean()),
                      "fork_distance_max": float(local.max())}
    return found


def dihedral_angles(mesh: TetMesh) -> np.ndarray:
    """Angles between faces [degrees], one for each edge, shape [tet_count, 6]."""
    corner = mesh.nodes[mesh.tets[:, :4]]
    angles = []
    for a, b in EDGES:
        c, d = (k for k in range(4) if k not in (a, b))
        edge = corner[:, b] - corner[:, a]
        edge = edge / np.maximum(np.linalg.norm(edge, axis=1), 1e-300)[:, None]
        sides = []
        for other in (c, d):
            side = corner[:, other] - corner[:, a]
            sides.append(side - np.einsum("ij,ij->i", side, edge)[:, None] * edge)
        cosine = np.einsum("ij,ij->i", *sides) / np.maximum(
            np.linalg.norm(sides[0], axis=1) * np.linalg.norm(sides[1], axis=1), 1e-300)
        angles.append(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))))
    return np.stack(angles, axis=1)


def radius_ratios(mesh: TetMesh) -> np.ndarray:
    """Three times the inscribed over the circumscribed radius, shape [tet_count]."""
    corner = mesh.nodes[mesh.tets[:, :4]]
    a, b, c = (corner[:, k] - corner[:, 0] for k in (1, 2, 3))
    volume6 = np.abs(np.einsum("ij,ij->i", a, np.cross(b, c)))
    area2 = sum(np.linalg.norm(n, axis=1) for n in (
        np.cross(a, b), np.cross(b, c), np.cross(c, a), np.cross(b - a, c - a)))
    centre = (np.einsum("ij,ij->i", a, a)[:, None] * np.cross(b, c)
              + np.einsum("ij,ij->i", b, b)[:, None] * np.cross(c, a)
              + np.einsum("ij,ij->i", c, c)[:, None] * np.cross(a, b))
    outer = np.linalg.norm(centre, axis=1) / np.maximum(2 * volume6, 1e-300)
    inner = volume6 / np.maximum(area2, 1e-300)
    return np.where(volume6 > 0, 3 * inner / np.maximum(outer, 1e-300), 0.0)


def _elements_across(mesh: TetMesh, skeleton: Skeleton) -> float:
    corner = mesh.nodes[mesh.tets[:, :4]]
    edges = np.linalg.norm(corner[:, EDGES[:, 0]] - corner[:, EDGES[:, 1]], axis=2).mean(axis=1)
    _, near = cKDTree(mesh.centroids).query(skeleton.nodes, k=min(6, mesh.tet_count))
    local = edges[near].reshape(skeleton.node_count, -1).mean(axis=1)
    return float(np.median(2 * skeleton.radius / local))


def shapes(corner: np.ndarray) -> np.ndarray:
    """Volume of tetrahedra [..., 4, 3] over the mean edge cubed: 1 is regular, negative is
    inverted."""
    edges = [corner[..., i, :] - corner[..., j, :] for i in range(4) for j in range(i)]
    square = sum(np.einsum("...k,...k->...", e, e) for e in edges) / 6
    a, b, c = (corner[..., k, :] - corner[..., 0, :] for k in (1, 2, 3))
    volume = np.einsum("...k,...k->...", a, np.cross(b, c)) / 6
    return 6 * np.sqrt(2) * volume / np.maximum(square, 1e-300)**1.5
