"""Several right sides at once, and a tangent that is asked for again."""

import numpy as np
import pytest

from limber.core.numerics.sparse import general_factor
from limber.geometry.tets.tree_sweep import straight_beam
from limber.mechanics.grasp import Grasp
from limber.mechanics.linear.supernodal import SupernodalFactor
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
    for grasps in ((), (Grasp.from_mesh(beam.mesh, "point"),)):
        tangent = beam.equations(grasps).tangent(beam, np.zeros_like(beam.mesh.nodes))
        moves = rng.standard_normal((3 * len(grasps), count))
        alone = [tangent.solve(right, move.reshape(-1, 3))
                 for right, move in zip(rights, moves.T, strict=True)]
        together = tangent.solve_all(list(rights), moves)
        assert np.allclose(together, alone, rtol=1e-9, atol=1e-12 * np.abs(alone).max())


def test_forces_in_a_few_places_are_solved_as_any(beam):
    """Three on one node each, which pass most fronts by; one after the other as well."""
    rights = np.zeros((3, *beam.mesh.nodes.shape))
    for right, node in zip(rights, np.flatnonzero(~beam.fixed)[[0, -1, 20]], strict=True):
        right[node] = 1.0, -2.0, 0.5
    tangent = beam.equations().tangent(beam, np.zeros_like(beam.mesh.nodes))
    together, alone = tangent.solve_all(list(rights)), [tangent.solve(one) for one in rights]
    assert np.allclose(together, alone, rtol=1e-9, atol=1e-12 * np.abs(alone).max())
    assert not tangent.solve(np.zeros_like(rights[0])).any()


def test_a_pin_is_solved_for_only_when_it_is_asked_for(beam, monkeypatch):
    """Whether a state is stable is known without; what it takes is known half-way."""
    equations, solved = beam.equations((Grasp.from_mesh(beam.mesh, "point"),)), []
    for name in ("down", "up"):
        half = getattr(SupernodalFactor, name)
        monkeypatch.setattr(SupernodalFactor, name, lambda factor, right, name=name, half=half:
                            solved.append((name, right.shape)) or half(factor, right))
    tangent = equations.tangent(beam, np.zeros_like(beam.mesh.nodes))
    assert tangent.is_positive_definite and not solved
    for _ in range(2):
        tangent.solve(np.ones_like(beam.mesh.nodes))
    assert solved.count(("down", equations.pin_rows.shape)) == 1
    assert ("up", equations.pin_rows.shape) not in solved


def test_a_pin_is_solved_for_as_with_a_general_library(beam, monkeypatch):
    """By halves and whole: the same, with forces, with moves of the pin alone, and with both."""
    equations = beam.equations((Grasp.from_mesh(beam.mesh, "point"),))
    rng = np.random.default_rng(3)
    rights, moves = rng.standard_normal((2, *beam.mesh.nodes.shape)), rng.standard_normal((3, 2))
    cases = [(rights, moves), (rights, None), (np.zeros_like(rights), moves)]
    tangent = equations.tangent(beam, np.zeros_like(beam.mesh.nodes))
    halves = [tangent.solve_all(list(right), move) for right, move in cases]
    general = general_factor(*equations.pattern.entries(), equations.pattern.size)
    general.factorise(equations.assemble(beam, np.zeros_like(beam.mesh.nodes)))
    monkeypatch.setattr(tangent, "_factor", general)
    for (right, move), half in zip(cases, halves, strict=True):
        whole = tangent.solve_all(list(right), move)
        assert np.allclose(half, whole, rtol=1e-8, atol=1e-10 * np.abs(whole).max())


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
