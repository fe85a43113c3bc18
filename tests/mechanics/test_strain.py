"""The largest strain and stress of a branch, against those of every tetrahedron."""

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.tets.tree_sweep import straight_beam
from limber.mechanics import BranchModel
from limber.mechanics.points import point_operator
from limber.mechanics.strain import peak_load, strain_state


@pytest.mark.parametrize("material", ["st_venant_kirchhoff", "stable_neo_hookean", "linear"])
@pytest.mark.parametrize("gravity", [None, (0.0, 0.0, -9.80665)])
def test_the_peak_is_the_largest_of_all(material, gravity):
    """Bent and twisted up to a few tens of percent, and at rest: the same numbers and place."""
    mesh = straight_beam(0.2, 0.01, 0.006, slice_count=8)
    young = 1e6 * (1.0 + 5.0 * mesh.centroids[:, 2])
    model = BranchModel(mesh, young=young, poisson=0.35, density=900.0, gravity=gravity,
                        material=material)
    if gravity is not None:
        model = model.as_scanned()
    rng = np.random.default_rng(2)
    for size in (0.0, 0.3, 3.0):
        z = mesh.nodes[:, 2]
        turn = size * z**2 / 0.2
        moved = np.column_stack([size * z**2, -turn * mesh.nodes[:, 0], -size * z**3])
        moved += size * 1e-4 * rng.normal(size=moved.shape)
        state = strain_state(model, moved)
        strain, tet, stress = peak_load(model, moved)
        sizes = np.abs(state.principal_strain).max(axis=1)
        assert strain == pytest.approx(sizes.max(), rel=1e-9, abs=1e-15)
        assert sizes[tet] == pytest.approx(sizes.max(), rel=1e-9, abs=1e-15)
        assert stress == pytest.approx(np.abs(state.principal_stress).max(), rel=1e-9, abs=1e-6)


# Observed points as functions of nodal displacements.


@pytest.mark.parametrize("quadratic", [False, True])
def test_points_follow_a_rigid_motion_also_off_the_surface(quadratic):
    """Affine fields are followed exactly, by points on the axis and by markers on the bark."""
    mesh = straight_beam(0.3, 0.01, slice_count=8, quadratic=quadratic)
    points = np.array([[0.0, 0.0, 0.11], [0.003, -0.002, 0.2], [0.016, 0.0, 0.15],
                       [0.0, 0.0, 0.307]])
    rng = np.random.default_rng(0)
    matrix, shift = 0.3 * rng.standard_normal((3, 3)), rng.standard_normal(3)
    operator = point_operator(mesh, points)
    moved = (operator @ (mesh.nodes @ matrix.T + shift).ravel()).reshape(-1, 3)
    assert np.allclose(moved, points @ matrix.T + shift, atol=1e-12)


def test_quadratic_fields_inside():
    """Inside a quadratic mesh, quadratic fields are followed exactly: bending is."""
    mesh = straight_beam(0.3, 0.01, slice_count=8)
    points = np.array([[0.001, 0.002, 0.11], [-0.004, 0.0, 0.22]])
    field = np.column_stack([mesh.nodes[:, 2]**2, mesh.nodes[:, 0] * mesh.nodes[:, 2],
                             mesh.nodes[:, 1]**2])
    moved = (point_operator(mesh, points) @ field.ravel()).reshape(-1, 3)
    expected = np.column_stack([points[:, 2]**2, points[:, 0] * points[:, 2], points[:, 1]**2])
    assert np.allclose(moved, expected, atol=1e-13)


@pytest.mark.parametrize("where", [1e199, np.inf, np.nan])
def test_a_point_where_no_branch_is_is_refused(where):
    """Its distance to any tetrahedron overflowed."""
    with pytest.raises(InputError, match="farther than 1e"):
        point_operator(straight_beam(0.3, 0.01, slice_count=8), np.array([[0.0, where, 0.1]]))
