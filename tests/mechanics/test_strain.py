"""The largest strain and stress of a branch, against those of every tetrahedron."""

import numpy as np
import pytest

from limber.geometry.tets.tree_sweep import straight_beam
from limber.mechanics import BranchModel
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
