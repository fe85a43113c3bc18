"""Motion on disk: PC2 caches for Blender, VTU series for ParaView."""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from pydantic import Field, model_validator

from limber.core.errors import InputError
from limber.core.files.atomic import write_atomically
from limber.core.files.reading import FileContent, read_json_as, require_finite
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.model import BranchModel
from limber.mechanics.strain import StrainState, strain_state

_PC2_HEADER = struct.Struct("<12siiffi")


def surface_nodes(mesh: TetMesh) -> np.ndarray:
    """Return the nodes of the surface triangles, ascending: the vertex order of PC2 files."""
    return np.unique(mesh.surface_faces())


def write_pc2(path: Path, positions: np.ndarray, start: float = 0.0, rate: float = 1.0) -> None:
    """Write positions [m], shape [frames, n, 3], as a PC2 point cache (Blender's Mesh Cache
    modifier), from frame ``start`` on, ``rate`` frames per sample."""
    positions = np.asarray(positions, np.float32)
    shaped = positions.ndim == 3 and positions.shape[2] == 3 and len(positions) > 0
    if not shaped or not np.isfinite(positions).all():
        raise InputError(f"The frames have shape {positions.shape}, or are not finite.",
                         "A cache needs finite positions of shape [frames, vertices, 3].",
                         "Check the motion.")
    header = _PC2_HEADER.pack(b"POINTCACHE2\0", 1, positions.shape[1], start, rate,
                              positions.shape[0])
    write_atomically(Path(path), header + positions.astype("<f4").tobytes())


def read_pc2(path: Path) -> tuple[np.ndarray, float, float]:
    """Return positions [frames, n, 3], start and rate of a PC2 file; InputError if it is none, or
    truncated."""
    data = Path(path).read_bytes()
    whole = len(data) >= _PC2_HEADER.size
    header = data[:_PC2_HEADER.size] if whole else bytes(_PC2_HEADER.size)
    name, _, count, start, rate, frames = _PC2_HEADER.unpack(header)
    if name != b"POINTCACHE2\0" or len(data) - _PC2_HEADER.size != frames * count * 12:
        raise InputError(f"{path} is not a complete PC2 file.",
                         "It is damaged or has another format.",
                         "Write it again.")
    body = np.frombuffer(data, "<f4", offset=_PC2_HEADER.size)
    if not (frames > 0 and count > 0):
        raise InputError(f"{path} has no frames.", "It does not describe a motion.",
                         "Write it again.")
    require_finite(path, {"positions": body, "start and rate": np.array([start, rate])}, "a motion")
    return body.reshape(frames, count, 3), start, rate


class FramesFile(FileContent):
    """Content of ``frames/NAME.json`` that is read: lists with one number per frame."""

    frame_count: int | None = Field(None, ge=1)
    rate: float = Field(24.0, gt=0, le=1e6)
    times_s: list[float] | None = None
    energies_j: list[float] | None = None
    kinetic_energies_j: list[float] | None = None
    min_det_f: list[float] | None = None
    largest_principal_strains: list[float] | None = None
    grasp_forces_n: list[tuple[float, float, float]] | None = None

    @model_validator(mode="after")
    def _one_length(self) -> "FramesFile":
        for name in ("times_s", "energies_j", "kinetic_energies_j", "min_det_f",
                     "largest_principal_strains", "grasp_forces_n"):
            values = getattr(self, name)
            if values is None:
                continue
            if self.frame_count is None:
                self.frame_count = len(values)
            if len(values) != self.frame_count:
                raise ValueError(f"{name} has {len(values)} entries, not {self.frame_count}")
        return self


def read_frames_file(path: Path) -> FramesFile:
    """Read the description of a motion's frames; InputError if it cannot be read, or its lists
    differ in length."""
    return read_json_as(path, FramesFile, "a description of a motion's frames")


def surface_fields(mesh: TetMesh, states: Sequence[StrainState]) -> dict[str, np.ndarray]:
    """Return the values for colouring a surface in each frame, for ``frames/NAME.npz``, from
    :func:`limber.mechanics.strain.strain_state`: ``strain_energy_density_j_m3``, the largest
    ``principal_strain`` and ``principal_stress_pa``, volume-weighted over the tetrahedra at a
    vertex, and the least ``det_f``, each [frames, vertices] in single precision, vertices as in PC2
    files."""
    nodes = surface_nodes(mesh)
    average = node_average(mesh)[nodes]
    least = [_least_at_nodes(mesh, state.det_f)[nodes] for state in states]
    fields = {
        "strain_energy_density_j_m3": [average @ state.energy_density for state in states],
        "principal_strain": [average @ state.principal_strain[:, -1] for state in states],
        "principal_stress_pa": [average @ state.principal_stress[:, -1] for state in states],
        "det_f": least}
    return {name: np.array(values, np.float32) for name, values in fields.items()}


def node_average(mesh: TetMesh) -> sp.csr_matrix:
    """Return the matrix that averages tetrahedron values at each node by volume, [n, tets]."""
    count, width = mesh.tets.shape
    volume = np.repeat(np.abs(mesh.volumes), width)
    matrix = sp.csr_matrix((volume, (mesh.tets.ravel(), np.repeat(np.arange(count), width))),
                           (mesh.node_count, count))
    total = np.asarray(matrix.sum(axis=1)).ravel()
    return (sp.diags(1 / np.maximum(total, np.finfo(float).tiny)) @ matrix).tocsr()


def _least_at_nodes(mesh: TetMesh, values: np.ndarray) -> np.ndarray:
    least = np.full(mesh.node_count, np.inf)
    np.minimum.at(least, mesh.tets.ravel(), np.repeat(values, mesh.tets.shape[1]))
    return least


def write_pvd_series(folder: Path, name: str, model: BranchModel, times: np.ndarray,
                     displacement: np.ndarray) -> list[Path]:
    """Write ``name.pvd`` and one VTU per frame, with strain, stress and energy density, of
    displacements [m], [frames, node_count, 3], into an existing folder; return the files, the PVD,
    which ParaView opens, last."""
    folder, paths = Path(folder), []
    for number, moved in enumerate(displacement):
        state = strain_state(model, moved)
        mesh = TetMesh(
            model.mesh.nodes + moved, model.mesh.tets,
            cell_data={"young": model.young, "energy_density": state.energy_density,
                       "principal_strain": state.principal_strain,
                       "principal_stress": state.principal_stress, "det_f": state.det_f},
            point_data={"displacement": moved})
        paths.append(folder / f"{name}-{number:04d}.vtu")
        mesh.write(paths[-1])
    sets = "\n".join(f'    <DataSet timestep="{time:.9g}" file="{path.name}"/>'
                     for time, path in zip(times, paths, strict=True))
    pvd = folder / f"{name}.pvd"
    write_atomically(pvd, '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n'
                     f"  <Collection>\n{sets}\n  </Collection>\n</VTKFile>\n")
    return [*paths, pvd]
