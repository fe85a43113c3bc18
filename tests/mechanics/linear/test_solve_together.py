"""Several right sides at once, and a tangent that is asked for again."""

import numpy as np
import pytest

from limber.geometry.tets.cylinder_mesh import straight_beam
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel


@pytest.fixture(scope="module")
def beam():
    return BranchModel(straight_beam(0.3, 0.01, slice_count=6), young=1e7, poisson=0.35,
                       density=900.0, gravity=None)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
def test_several_forces_are_solved_as_each_alone(beam, count):
    """Of any number; with a pinned grasp each with its own move of the pin."""
    rng = np.random.default_rng(count)
    rights = rng.standard_normal((count, *beam.mesh.nodes.shape))
    for grasps in ((), (Grasp.from_mesh(beam.mesh, "pinned"),)):
        tangent = beam.equations(grasps).tangent(beam, np.zeros_like(beam.mesh.nodes))
        moves = rng.standard_normal((3 * len(grasps), count))
        alone = [tangent.solve(right, move.reshape(-1, 3))
                 for right, move in zip(rights, moves.T, strict=True)]
        together = tangent.solve_all(list(rights), moves)
        assert np.allclose(together, alone, rtol=1e-9, atol=1e-12 * np.abs(alone).max())


def test_a_tangent_asked_for_again_is_at_hand_until_another_is_made(beam):
    """The same state of the same model: no new factor. Another state, or model: a new one."""
    equations, state = beam.equations(), np.zeros_like(beam.mesh.nodes)
    first = equations.exact_tangent(beam, state)
    count = equations.factorisation_count
    assert equations.exact_tangent(beam, state.copy()) is first
    assert equations.factorisation_count == count
    stiffer = beam.with_young(2e7)
    right = np.ones_like(state)
    soft, stiff = first.solve(right), equations.exact_tangent(stiffer, state).solve(right)
    assert np.allclose(soft, 2 * stiff, rtol=1e-9, atol=0)
    again = equations.exact_tangent(beam, state + 1e-6)
    assert again is not first and equations.factorisation_count == count + 2
