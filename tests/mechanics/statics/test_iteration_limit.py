"""A solve that is allowed so many iterations ends in time, and says so."""

import numpy as np

from limber.geometry.tets.tree_sweep import straight_beam
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.mechanics.statics.result import StaticSettings
from limber.mechanics.statics.solve import solve_static


def test_a_branch_far_too_soft_is_given_up_in_time():
    """Folded up by its load it finds no end within the limit; one that is stiff enough does."""
    mesh = straight_beam(0.5, 0.005, slice_count=12)
    tip = Grasp.of_nodes(mesh, np.flatnonzero(mesh.nodes[:, 2] > 0.499), "point")
    settings = StaticSettings(total_iterations=30)
    found = {}
    for young in (1e9, 2e4):
        model = BranchModel(mesh, young=young, poisson=0.35, density=900.0, gravity=None)
        found[young] = solve_static(model, grasp=tip, grasp_force=(1.0, 0.0, -0.5),
                                    settings=settings)
    assert found[1e9].converged
    assert not found[2e4].converged and found[2e4].iterations < 30 + 40
    assert "not finished after" in found[2e4].message
