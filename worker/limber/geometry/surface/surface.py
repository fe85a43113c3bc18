"""Triangle surfaces: the type, its file, and the checks that a branch's surface must pass."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.core.files.reading import check_ply


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

    def write_ply(self, path: Path) -> None:
        """Write a binary PLY file, in double precision: rounding could make faces cross."""
        from plyfile import PlyData, PlyElement

        vertex = np.zeros(len(self.vertices), [("x", "f8"), ("y", "f8"), ("z", "f8")])
        for k, name in enumerate("xyz"):
            vertex[name] = self.vertices[:, k]
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
                             "For a point cloud, use `limber reconstruct`.")
        vertices = np.asarray(mesh.vertices, float) * scale
        if not np.isfinite(vertices).all():
            raise InputError(f"{path} has vertices that are not finite.",
                             "Positions must be finite numbers.", "Export it again.")
        return cls(vertices, np.asarray(mesh.faces, np.int64))
