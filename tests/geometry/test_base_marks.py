"""The clamp is the face at the base; a tapered straight axis is meshed."""

from dataclasses import replace

import numpy as np
import pytest
from tests.subjects.grown import grown

from limber.geometry.tets.tet_mesh import base_nodes
from limber.geometry.tets.tetrahedra import MeshSettings, mesh_branch
from limber.geometry.tets.tree_sweep import straight_beam, sweep_tree


def rod(radius):
    return grown((-1, (0, 0, 0), (0, 0, 0.3), 31, radius))


@pytest.mark.parametrize("slice_length", [0.1, 0.5, 2.0])
def test_only_the_face_is_held_however_fine_the_mesh(slice_length):
    """A band above the face would hold the more of the branch the finer its mesh is."""
    radius = 0.01
    mesh = straight_beam(0.1, radius, slice_count=round(0.1 / (slice_length * radius)))
    held = base_nodes(mesh, rod((radius, radius))).astype(bool)
    on_face = mesh.nodes[:, 2] < 1e-9
    assert np.array_equal(held, on_face) and on_face.sum() >= 6


@pytest.mark.parametrize("tip", [0.004, 0.001, 0.0003])
def test_a_straight_tapered_axis_is_meshed(tip):
    mesh = sweep_tree(rod((0.012, tip))).mesh
    volume = np.pi * 0.3 * (0.012**2 + 0.012 * tip + tip**2) / 3
    assert mesh.volumes.min() > 0
    assert mesh.volumes.sum() == pytest.approx(volume, rel=0.08)
    meshed = mesh_branch(rod((0.012, tip)), MeshSettings(mesher="sweep"))
    assert meshed.mesh.tet_count > 50


def test_a_node_on_the_root_leaves_the_direction_of_the_base():
    """A fit to few points put one there: the base had no direction, and no nodes."""
    skeleton = rod((0.01, 0.01))
    nodes = skeleton.nodes.copy()
    nodes[1] = nodes[0]
    mesh = straight_beam(0.3, 0.01, slice_count=40)
    held = base_nodes(mesh, replace(skeleton, nodes=nodes))
    assert np.array_equal(held, base_nodes(mesh, skeleton)) and held.sum() >= 6
