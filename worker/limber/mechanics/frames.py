"""Frames of a motion as files: PC2 for Blender's Mesh Cache modifier, a VTU series for ParaView.

A PC2 file is ``POINTCACHE2\\0``, version 1, the vertex count, start, rate and frame count, then
32-bit floats frame by frame. Blender maps scene frame to file frame by its modifier's own start;
the header's is for other programs.
"""

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from limber.errors import InputError
from limber.geometry.tet_mesh import TetMesh

_HEADER = struct.Struct("<12siiffi")
_MAGIC = b"POINTCACHE2\0"


def surface_vertices(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes [v] that the boundary uses, ascending, and its faces [f, 3] among them.

    This is the vertex order of every ``frames/NAME.pc2``.
    """
    nodes, faces = np.unique(mesh.surface_faces(), return_inverse=True)
    return nodes, faces.reshape(-1, 3)


def write_pc2(path: Path, positions: np.ndarray, start: float, rate: float) -> None:
    """Write vertex positions over time.

    Args:
        path: The file.
        positions: [m], shape [frame_count, vertex_count, 3]; all finite.
        start: Number of the first frame.
        rate: Frames from one sample to the next (1: every frame).

    Raises:
        InputError: another shape, no frame, or positions that are not finite.
    """
    positions = np.asarray(positions)
    if positions.ndim != 3 or positions.shape[2] != 3 or len(positions) == 0:
        raise InputError(f"Frames of shape {positions.shape}.",
                         "[frames, vertices, 3] with a frame or more was expected.",
                         "Compute the motion first.")
    if not np.isfinite(positions).all():
        raise InputError("Some positions are not finite.", "A player would show nothing.",
                         "Look at the motion's status before writing it.")
    header = _HEADER.pack(_MAGIC, 1, positions.shape[1], start, rate, len(positions))
    with open(path, "wb") as stream:
        stream.write(header)
        stream.write(np.ascontiguousarray(positions, "<f4").tobytes())


def read_pc2(path: Path) -> np.ndarray:
    """Return the positions of a PC2 file [m], shape [frame_count, vertex_count, 3].

    Raises:
        InputError: not a PC2 file, or shorter than its header says.
    """
    data = Path(path).read_bytes()
    if len(data) < _HEADER.size or not data.startswith(_MAGIC):
        raise InputError(f"{path} is not a PC2 file.", "Its first bytes are others.",
                         "Write it again: limber simulate or limber plan.")
    _, _, vertices, _, _, frames = _HEADER.unpack_from(data)
    if len(data) - _HEADER.size != frames * vertices * 12:
        raise InputError(f"{path} says {frames} frames of {vertices} vertices but has "
                         f"{len(data) - _HEADER.size} bytes of them.", "It was cut off.",
                         "Write it again: limber simulate or limber plan.")
    return np.frombuffer(data, "<f4", offset=_HEADER.size).reshape(frames, vertices, 3)


def write_pvd_series(path: Path, mesh: TetMesh, times: Sequence[float],
                     displacements: np.ndarray,
                     cell_data: Mapping[str, np.ndarray] | None = None) -> list[Path]:
    """Write one VTU a frame beside a PVD file that gives ParaView their times.

    Args:
        path: The PVD file; the VTU files are named after it.
        mesh: The mesh at rest; frames hold the deformed one, with ``displacement`` on it.
        times: [s], shape [frame_count].
        displacements: [m], shape [frame_count, node_count, 3].
        cell_data: Further data a frame, name to shape [frame_count, tet_count, ...].

    Returns:
        All files written, the PVD file last.
    """
    files, entries = [], []
    for number, (time, displacement) in enumerate(zip(times, displacements, strict=True)):
        file = path.with_name(f"{path.stem}_{number:04d}.vtu")
        moved = TetMesh(mesh.nodes + displacement, mesh.tets, mesh.cell_data, mesh.point_data)
        moved.with_data(
            point_data={"displacement": displacement},
            cell_data={name: values[number] for name, values in (cell_data or {}).items()},
        ).write(file)
        files.append(file)
        entries.append(f'  <DataSet timestep="{float(time):.9g}" part="0" '
                       f'file={quoteattr(file.name)}/>')
    path.write_text('<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n'
                    "<Collection>\n" + "\n".join(entries) + "\n</Collection>\n</VTKFile>\n",
                    encoding="utf-8")
    return [*files, path]
