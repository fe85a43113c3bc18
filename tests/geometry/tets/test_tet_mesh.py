"""Tetrahedral meshes: orientation, quadratic nodes, boundary, and the VTU file."""

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import EDGES, FACES, TetMesh
from limber.geometry.tets.tree_sweep import sweep_tree


@pytest.fixture
def cube() -> TetMesh:
    """A unit cube of five tetrahedra, two of them turned inside out, with data."""
    nodes = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
    tets = np.array([[0, 1, 2, 4], [3, 2, 1, 7], [5, 1, 4, 7], [4, 6, 2, 7], [2, 1, 4, 7]])
    return TetMesh(nodes, tets, {"young": np.arange(1.0, 6.0)},
                   {"fixed": (nodes[:, 2] == 0).astype(np.int64),
                    "control_point": np.where(np.arange(8) == 3, 1, -1)})


def test_orientation_keeps_the_volume(cube: TetMesh):
    """Oriented tetrahedra are all positive and fill the cube, linear and quadratic alike."""
    assert (cube.volumes < 0).any()
    for mesh in (cube.oriented(), cube.quadratic().oriented()):
        assert (mesh.volumes > 0).all()
        assert mesh.volumes.sum() == pytest.approx(1.0)


def test_midside_nodes_are_the_middles(cube: TetMesh):
    """Nodes 4 to 9 lie in the middle of VTK's edges, also after turning elements over."""
    mesh = cube.quadratic().oriented()
    corners = mesh.nodes[mesh.tets[:, :4]]
    assert np.allclose(mesh.nodes[mesh.tets[:, 4:]], corners[:, EDGES].mean(axis=2))
    assert mesh.node_count == 8 + 18


def test_flags_on_midside_nodes(cube: TetMesh):
    """A mid-side node is fixed when both its corners are; no mid-side node is a control point."""
    mesh = cube.quadratic()
    assert set(np.flatnonzero(mesh.point_data["fixed"])) == set(
        np.flatnonzero(mesh.nodes[:, 2] == 0))
    assert (mesh.point_data["control_point"] >= 0).sum() == 1


def test_boundary_is_closed_and_outward(cube: TetMesh):
    """Twelve outward triangles: their divergence integral is the volume, each edge has two."""
    mesh = cube.oriented()
    faces = mesh.surface_faces()
    corners = mesh.nodes[faces]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert len(faces) == 12
    assert volume == pytest.approx(1.0)
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()


def test_faces_point_outward():
    """The face table's normals leave a positive tetrahedron."""
    nodes = np.vstack([np.zeros(3), np.eye(3)])
    for face in FACES:
        a, b, c = nodes[face]
        assert np.dot(np.cross(b - a, c - a), nodes.mean(axis=0) - a) < 0


@pytest.mark.parametrize("order", [1, 2])
def test_file_round_trip(cube: TetMesh, order: int, tmp_path):
    """Nodes, connectivity (VTK order), cell and point data survive the VTU file exactly."""
    mesh = cube.oriented() if order == 1 else cube.quadratic().oriented()
    mesh.write(tmp_path / "mesh.vtu")
    again = TetMesh.read(tmp_path / "mesh.vtu")
    assert np.array_equal(again.nodes, mesh.nodes)
    assert np.array_equal(again.tets, mesh.tets)
    for name, values in mesh.cell_data.items():
        assert np.array_equal(again.cell_data[name], values)
    for name, values in mesh.point_data.items():
        assert np.array_equal(again.point_data[name], values)
    assert again.geometry_digest() == mesh.geometry_digest()


def test_linear_drops_unused_nodes(cube: TetMesh):
    """Back from quadratic to linear: the same tetrahedra on the corner nodes alone."""
    again = cube.quadratic().linear()
    assert np.array_equal(again.nodes, cube.nodes)
    assert np.array_equal(again.tets, cube.tets)


@pytest.mark.parametrize("content", [b"", b"<VTKFile>", b"not xml"])
def test_unreadable_file(tmp_path, content: bytes):
    """A damaged file is an input error with its name, not a trace of the reader."""
    (tmp_path / "bad.vtu").write_bytes(content)
    with pytest.raises(InputError, match=r"bad\.vtu"):
        TetMesh.read(tmp_path / "bad.vtu")


def test_a_twig_that_starts_in_a_hook_is_joined() -> None:
    """Its first node lies on the other side of the carrier: led straight, it is in the mesh."""
    carrier = np.stack([0 * np.arange(40.0), 0 * np.arange(40.0), 5 * np.arange(40)], axis=1)
    way = np.array([-np.sin(np.pi / 3), 0, np.cos(np.pi / 3)])
    twig = np.vstack([[8, 0, 0], [8, 0, 0] + np.outer(5 * np.arange(1, 15), way)])
    nodes = 1e-3 * np.vstack([carrier, carrier[20] + twig])
    parent = np.concatenate([np.arange(40) - 1, [20], 40 + np.arange(len(twig) - 1)])
    swept = sweep_tree(Skeleton.from_edges(nodes, parent, np.full(len(nodes), 5e-3)))
    assert swept.left_out == []
    assert swept.mesh.volumes.min() > 0
    assert swept.mesh.nodes[:, 0].min() < -0.03


def test_the_carriers_corners_turn_until_a_twig_is_joined() -> None:
    """A thin twig at a small angle that meets an edge of the hexagon meets a face of another."""
    carrier = np.stack([0 * np.arange(40.0), 0 * np.arange(40.0), 3 * np.arange(40)], axis=1)
    away, around = np.deg2rad(20), np.deg2rad(40)
    way = np.array([-np.sin(away), 0, np.cos(away)])
    twig = np.vstack([[2, 0, 0], [2, 0, 0] + np.outer(1.5 * np.arange(1, 15), way)])
    turn = np.array([[np.cos(around), -np.sin(around), 0], [np.sin(around), np.cos(around), 0],
                     [0, 0, 1]])
    nodes = 1e-3 * np.vstack([carrier, carrier[20] + twig @ turn.T])
    parent = np.concatenate([np.arange(40) - 1, [20], 40 + np.arange(len(twig) - 1)])
    radius = 1e-3 * np.repeat([3.0, 1.5], [40, len(twig)])
    swept = sweep_tree(Skeleton.from_edges(nodes, parent, radius))
    assert swept.left_out == []
    assert swept.mesh.volumes.min() > 0
