"""Meshes that are brought as clouds: their vertices are read, or the mesh is named."""

import numpy as np
import pytest
import trimesh

from limber.core.errors import InputError
from limber.geometry.io.clouds import read_points


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".off"])
@pytest.mark.parametrize("mesh", [trimesh.creation.cylinder(0.01, 0.4, sections=32),
                                  trimesh.creation.box((0.1, 0.1, 0.4))])
def test_a_mesh_of_large_faces_is_no_cloud(tmp_path, suffix, mesh):
    """A Blender cylinder has its surface where no vertex is."""
    mesh.export(tmp_path / f"a{suffix}")
    with pytest.raises(InputError, match=r"mesh of .* faces.*limber mesh"):
        read_points(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl"])
def test_a_fine_mesh_is_read_and_named(tmp_path, suffix):
    """A scanner's program writes triangles between its points."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    ball.export(tmp_path / f"a{suffix}")
    cloud = read_points(tmp_path / f"a{suffix}")
    assert "is a mesh of 1280 faces" in cloud.notes[0]
    np.testing.assert_allclose(np.ptp(cloud.points, axis=0), 0.2, rtol=1e-3)
