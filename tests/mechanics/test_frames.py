"""Frames as files: PC2 byte for byte, its refusals, and a series that ParaView opens."""

import struct
from xml.etree import ElementTree

import numpy as np
import pytest

from limber.errors import InputError
from limber.geometry.tet_mesh import TetMesh
from limber.mechanics.frames import read_pc2, surface_vertices, write_pc2, write_pvd_series


@pytest.fixture
def mesh() -> TetMesh:
    """One quadratic tetrahedron."""
    return TetMesh(np.vstack([np.zeros(3), np.eye(3)]), np.array([[0, 1, 2, 3]]),
                   {"young": np.ones(1)}).quadratic()


def test_pc2_layout(tmp_path):
    """The header is what Blender reads; positions are little-endian 32-bit floats by frame."""
    positions = np.arange(2 * 3 * 3, dtype=float).reshape(2, 3, 3)
    write_pc2(tmp_path / "a.pc2", positions, 1.0, 1.0)
    data = (tmp_path / "a.pc2").read_bytes()
    assert struct.unpack("<12siiffi", data[:32]) == (b"POINTCACHE2\0", 1, 3, 1.0, 1.0, 2)
    assert np.array_equal(np.frombuffer(data[32:], "<f4"), np.arange(18))
    assert np.array_equal(read_pc2(tmp_path / "a.pc2"), positions)


@pytest.mark.parametrize("positions", [
    np.zeros((0, 3, 3)), np.zeros((3, 3)), np.full((1, 1, 3), np.nan), np.full((1, 1, 3), np.inf)])
def test_what_cannot_be_played_is_refused(tmp_path, positions):
    """No frames, another shape or positions that are not finite are refused before writing."""
    with pytest.raises(InputError):
        write_pc2(tmp_path / "a.pc2", positions, 0.0, 1.0)
    assert not (tmp_path / "a.pc2").exists()


def test_cut_off_file_is_refused(tmp_path):
    """A file that is shorter than its header says is an error, not fewer frames."""
    write_pc2(tmp_path / "a.pc2", np.zeros((2, 4, 3)), 0.0, 1.0)
    data = (tmp_path / "a.pc2").read_bytes()
    for wrong in (data[:-4], data[:10], b"x" * 40):
        (tmp_path / "a.pc2").write_bytes(wrong)
        with pytest.raises(InputError, match=r"a\.pc2"):
            read_pc2(tmp_path / "a.pc2")


def test_surface_vertices_are_corners_in_ascending_order(mesh: TetMesh):
    """The surface of a quadratic mesh is that of its corners, compacted."""
    nodes, faces = surface_vertices(mesh)
    assert nodes.tolist() == [0, 1, 2, 3]
    assert sorted(map(sorted, nodes[faces].tolist())) == [
        [0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]


def test_series_has_every_frame_and_its_time(mesh: TetMesh, tmp_path):
    """The PVD file names each VTU with its time; the frames hold the deformed mesh."""
    displacements = np.stack([np.zeros_like(mesh.nodes), np.full_like(mesh.nodes, 0.5)])
    write_pvd_series(tmp_path / "pull.pvd", mesh, [0.0, 0.25], displacements,
                     {"energy_density": np.array([[0.0], [2.0]])})
    entries = list(ElementTree.parse(tmp_path / "pull.pvd").iter("DataSet"))
    assert [float(entry.get("timestep")) for entry in entries] == [0.0, 0.25]
    last = TetMesh.read(tmp_path / entries[1].get("file"))
    assert np.allclose(last.nodes, mesh.nodes + 0.5)
    assert last.cell_data["energy_density"] == 2.0
    assert np.allclose(last.point_data["displacement"], 0.5)
