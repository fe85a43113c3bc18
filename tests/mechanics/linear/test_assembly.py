"""Forces and stiffness against rigid motion, patch test and finite differences."""

import numpy as np
import pytest
import scipy.sparse as sp
from tests.subjects.meshes import box_mesh
from tests.subjects.prescribed import solve_prescribed

from limber.core.numerics import sparse as sparse_module
from limber.core.numerics.rigid import rotation_matrix
from limber.core.numerics.sparse import CholmodFactor, NotPositiveDefiniteError, SuperLuFactor
from limber.geometry.tets.tet_mesh import TetMesh
from limber.geometry.tets.tree_sweep import straight_beam
from limber.mechanics import BranchModel, Grasp
from limber.mechanics.linear import equations as equations_module
from limber.mechanics.linear.equations import Viscous
from limber.mechanics.linear.fronts import make_fronts, postordered
from limber.mechanics.linear.supernodal import SupernodalFactor
from limber.mechanics.strain import deformation_gradients, principal_stretch

MATERIALS = ("st_venant_kirchhoff", "stable_neo_hookean", "linear")


def make_model(mesh, material="st_venant_kirchhoff", **options):
    values = {"young": 1e7, "poisson": 0.3, "density": 900, "gravity": None} | options
    return BranchModel(mesh, material=material, **values)


def curved_box():
    mesh = box_mesh()
    nodes = mesh.nodes.copy()
    nodes[:, 0] += 10 * nodes[:, 2] ** 2
    return TetMesh(nodes, mesh.tets, point_data=mesh.point_data)


def full_stiffness(pattern, values):
    lower = sp.csc_matrix((values, pattern.entries()), shape=(pattern.size,) * 2)
    return lower + sp.tril(lower, -1).T


@pytest.mark.parametrize("material", MATERIALS[:2])
@pytest.mark.parametrize("mesh", [box_mesh(), box_mesh(quadratic=False), curved_box()],
                         ids=["quadratic", "linear", "curved"])
def test_rigid_motion_costs_nothing(mesh, material):
    """A large rotation with a shift gives no force and no energy, to round-off."""
    model = make_model(mesh, material)
    turn = rotation_matrix(np.array([0.9, -1.4, 0.7]))
    moved = mesh.nodes @ turn.T + [0.4, -2.0, 1.0] - mesh.nodes
    state = model.internal(moved)
    reference = model.internal(mesh.nodes * 0.01)
    scale = np.linalg.norm(reference.force)
    assert np.linalg.norm(state.force) < 1e-10 * scale
    assert abs(state.strain_energy) < 1e-10 * reference.strain_energy
    assert state.min_det_f == pytest.approx(1.0)


@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("quadratic", [True, False])
def test_patch_test(material, quadratic):
    """Boundary nodes moved by a linear map: all inner nodes follow it, to 1e-10."""
    mesh = box_mesh((0.03, 0.02, 0.02), (3, 3, 3), quadratic=quadratic)
    inside = np.abs(mesh.nodes - mesh.nodes.mean(axis=0)) < np.array([0.0149, 0.0099, 0.0099])
    boundary = ~inside.all(axis=1)
    shift = mesh.nodes @ np.array([[0.02, 0.01, 0], [0.03, -0.01, 0.02], [0, 0.01, 0.03]])
    model = make_model(mesh, material, fixed=boundary)
    result = solve_prescribed(model, shift).require()
    assert (~boundary).sum() > 5
    assert np.abs(result.displacement - shift).max() < 1e-10 * np.abs(shift).max()


@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("mesh", [box_mesh(), box_mesh(quadratic=False), curved_box()],
                         ids=["quadratic", "linear", "curved"])
def test_force_and_stiffness_are_derivatives(mesh, material):
    """Force is the energy's derivative, stiffness the force's, both kernels of it alike."""
    rng = np.random.default_rng(3)
    model = make_model(mesh, material, young=rng.uniform(1e6, 5e6, mesh.tet_count))
    u = 4e-4 * rng.standard_normal(mesh.nodes.shape)
    d = rng.standard_normal(mesh.nodes.shape)
    d[model.fixed] = 0
    h = 2e-8
    ahead, behind = model.internal(u + h * d), model.internal(u - h * d)
    by_energy = (ahead.strain_energy - behind.strain_energy) / (2 * h)
    assert by_energy == pytest.approx((model.internal(u).force * d).sum(), rel=1e-6)
    by_force = ((ahead.force - behind.force) / (2 * h))[~model.fixed]
    product = model.tangent_times(u, d)[~model.fixed]
    assert np.linalg.norm(product - by_force) < 1e-6 * np.linalg.norm(by_force)
    equations = model.equations()
    values = equations.assemble(model, u)
    assembled = full_stiffness(equations.pattern, values) @ d[equations.pattern.order].ravel()
    exact = model.tangent_times(u, d)[equations.pattern.order].ravel()
    assert np.linalg.norm(assembled - exact) < 1e-12 * np.linalg.norm(exact)


@pytest.mark.parametrize("material", MATERIALS)
def test_viscous_stiffness_is_the_derivative(material):
    """With a viscous memory the stiffness is still the force's derivative."""
    rng = np.random.default_rng(4)
    model = make_model(box_mesh(), material)
    u = 4e-4 * rng.standard_normal(model.mesh.nodes.shape)
    d = rng.standard_normal(u.shape)
    d[model.fixed] = 0
    viscous = Viscous(1.7, 0.02 * rng.standard_normal((*model.weights.shape, 6)))
    h = 2e-8
    change = (model.internal(u + h * d, viscous=viscous).force
              - model.internal(u - h * d, viscous=viscous).force) / (2 * h)
    equations = model.equations()
    values = equations.assemble(model, u, viscous=viscous)
    order = equations.pattern.order
    assembled = full_stiffness(equations.pattern, values) @ d[order].ravel()
    assert np.linalg.norm(assembled - change[order].ravel()) < 1e-6 * np.linalg.norm(change)


def test_force_is_linear_in_young_and_superposes(short_box):
    """Forces of two fields of Young's modulus add up to that of their sum."""
    rng = np.random.default_rng(5)
    first, second = rng.uniform(1e6, 1e7, (2, short_box.tet_count))
    u = 1e-4 * rng.standard_normal(short_box.nodes.shape)
    model = make_model(short_box, young=first)
    together = model.with_young(first + second).internal(u).force
    apart = model.internal(u).force + model.with_young(second).internal(u).force
    assert together == pytest.approx(apart, rel=1e-12, abs=1e-12 * np.abs(apart).max())


def test_pinned_solution_keeps_the_mean_and_balances(short_box):
    """A pinned patch moves in the mean as told, and the factored equations are satisfied."""
    grasp = Grasp.of_nodes(short_box, np.flatnonzero(short_box.nodes[:, 2] > 0.0299), "point")
    model = make_model(short_box)
    equations = model.equations([grasp])
    zero = np.zeros_like(short_box.nodes)
    tangent = equations.tangent(model, zero)
    assert tangent.is_positive_definite
    move = np.array([[1e-4, 2e-4, -1e-4]])
    solution = tangent.solve(zero, move)
    assert grasp.weights @ solution[grasp.nodes] == pytest.approx(move[0], rel=1e-9)
    left = equations.free_part(model.tangent_times(zero, solution))
    assert np.linalg.norm(left) < 1e-9 * np.linalg.norm(model.tangent_times(zero, solution))


def factor_of(name, pattern):
    kinds = {"CHOLMOD": CholmodFactor, "SuperLU": SuperLuFactor}
    return kinds[name](*pattern.entries(), pattern.size) if name in kinds else (
        equations_module.SupernodalFactor(make_fronts(pattern.node_starts, pattern.node_rows)))


@pytest.mark.parametrize("name", ["own", "CHOLMOD", "SuperLU"])
@pytest.mark.parametrize("quadratic", [True, False])
def test_every_factor_solves_and_refuses(name, quadratic):
    """Each factor solves to round-off, for one and several right sides, refuses an indefinite
    matrix, and is as good as before when it gets a definite one again."""
    mesh = box_mesh((0.03, 0.02, 0.05), (3, 2, 5), quadratic=quadratic)
    model = make_model(mesh)
    equations = model.equations()
    pattern = equations.pattern
    values = equations.assemble(model, np.zeros_like(mesh.nodes)).copy()
    matrix = full_stiffness(pattern, values)
    right = np.random.default_rng(0).standard_normal((pattern.size, 4))
    candidate = factor_of(name, pattern)
    for _ in range(2):
        candidate.factorise(values)
        for sides in (right, right[:, 1]):
            solution = candidate.solve(sides)
            assert solution.shape == sides.shape
            scale = abs(matrix).sum(axis=1).max() * np.abs(solution).max()
            assert np.abs(matrix @ solution - sides).max() < 1e-14 * scale
        raised = values.copy()
        raised[pattern.diagonal] -= 0.5 * values[pattern.diagonal].mean()
        with pytest.raises(NotPositiveDefiniteError):
            candidate.factorise(raised)


@pytest.mark.parametrize("name", ["own", "CHOLMOD", "SuperLU"])
def test_a_tangent_stays_what_it_is(name, short_box, monkeypatch):
    """Another tangent of the same equations changes nothing in one that is still held; the memory
    of one that is not serves the next, and one that cannot be factorised takes none along."""
    monkeypatch.setattr(equations_module, "make_factor", lambda pattern: factor_of(name, pattern))
    grasp = Grasp.of_nodes(short_box, np.flatnonzero(short_box.nodes[:, 2] > 0.0299), "point")
    model = make_model(short_box)
    equations = model.equations([grasp])
    zero = np.zeros_like(short_box.nodes)
    right, move = np.ones_like(zero), np.array([[1e-4, 2e-4, -1e-4]])
    first = equations.tangent(model, zero)
    before, norm = first.solve(right, move), first.diagonal_norm
    second = equations.tangent(model.with_young(3 * model.young), zero)
    np.testing.assert_array_equal(first.solve(right, move), before)
    assert first.diagonal_norm == norm
    np.testing.assert_allclose(second.solve(right, 0 * move),
                               first.solve(right, 0 * move) / 3, rtol=1e-8, atol=1e-16)
    del first, second
    assert len(equations._spare) == 2
    with pytest.raises(NotPositiveDefiniteError):
        equations.factorised(np.full(equations.pattern.value_count, -1.0))
    assert len(equations._spare) == 2
    np.testing.assert_array_equal(equations.tangent(model, zero).solve(right, move), before)


def test_fronts_hold_all_that_fills_in():
    """No fill of a random matrix is missed: the factor's columns are those of dense Cholesky."""
    rng = np.random.default_rng(6)
    for count, density in ((1, 0.5), (7, 0.3), (60, 0.03), (60, 0.2)):
        graph = sp.random(count, count, density, random_state=7) + sp.eye(count)
        graph = ((graph + graph.T) != 0).tocsr()
        order = postordered(graph, rng.permutation(count))
        lower = sp.tril(graph[order][:, order]).tocsc()
        lower.sort_indices()
        block = sp.kron(lower, np.ones((3, 3))).tocsc()
        part = sp.tril(block).tocsc()
        part.data = rng.uniform(-1, 1, len(part.data))
        whole = (part + sp.tril(part, -1).T + 3 * part.shape[0] * sp.eye(part.shape[0])).tocsc()
        values = sp.tril(whole).tocsc()
        values.sort_indices()
        own = equations_module.SupernodalFactor(make_fronts(lower.indptr, lower.indices))
        own.factorise(values.data)
        right = rng.standard_normal(part.shape[0])
        assert own.solve(right) == pytest.approx(np.linalg.solve(whole.toarray(), right), rel=1e-10)


def test_bulky_meshes_go_to_a_general_library(short_box, monkeypatch):
    """Above a number of operations CHOLMOD takes over; without cvxopt, as in zips, SuperLU."""
    pattern = make_model(short_box).equations().pattern
    assert isinstance(equations_module.make_factor(pattern), equations_module.SupernodalFactor)
    monkeypatch.setattr(equations_module, "_MOST_FLOPS", 1.0)
    assert isinstance(equations_module.make_factor(pattern), CholmodFactor)
    monkeypatch.setattr(sparse_module, "find_spec", lambda _name: None)
    assert isinstance(equations_module.make_factor(pattern), SuperLuFactor)
    assert sorted(sparse_module.little_fill(sp.eye(9))) == list(range(9))


@pytest.mark.parametrize("mesh", [box_mesh(), box_mesh(quadratic=False), curved_box()],
                         ids=["quadratic", "linear", "curved"])
def test_largest_stretch_is_the_largest_eigenvalue(mesh):
    """The closed form agrees with an eigenvalue solver, and points at the same tetrahedron."""
    model = make_model(mesh)
    rng = np.random.default_rng(8)
    for size in (0.0, 1e-7, 1e-3):
        u = size * rng.standard_normal(mesh.nodes.shape)
        F = deformation_gradients(model, u).mean(axis=1)
        stretches = np.sqrt(np.linalg.eigvalsh(np.swapaxes(F, 1, 2) @ F)[:, -1])
        value, tet = model.largest_stretch(u)
        assert value == pytest.approx(stretches.max(), rel=1e-12)
        assert stretches[tet] == pytest.approx(stretches.max(), rel=1e-12)
        assert principal_stretch(model, u).position == pytest.approx(mesh.centroids[tet])


# Several right sides at once, and a tangent that is asked for again.


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
    general = CholmodFactor(*equations.pattern.entries(), equations.pattern.size)
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
