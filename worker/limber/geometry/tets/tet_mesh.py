"""Tetrahedral meshes, made by geometry and used by mechanics: the type and its file.

Nodes of a quadratic tetrahedron follow VTK: four corners, then the middles of the edges
01, 12, 20, 03, 13, 23.
"""

import hashlib
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from limber.core.errors import InputError
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
            path, self.nodes, [(self.element.cell_type, self.tets)], file_format="vtu",
            point_data=self.point_data,
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
                         "Use `limber mesh` to fill a closed surface with tetrahedra.")


def _on_edges(name: str, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    first, second = values[edges[:, 0]], values[edges[:, 1]]
    if np.issubdtype(values.dtype, np.integer):
        other = -1 if name == "control_point" else 0
        return np.where(first == second, first, other).astype(values.dtype)
    return (first + second) / 2
