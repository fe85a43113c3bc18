"""Derivatives against central differences, static and dynamic, and the rest shape."""

from dataclasses import replace

import numpy as np
import pytest
from tests.subjects.meshes import box_mesh

from limber.core.errors import InputError
from limber.mechanics import (
    BranchModel,
    Grasp,
    NewmarkSettings,
    ParameterSet,
    RayleighDamping,
    StaticSettings,
    simulate_dynamics,
    solve_static,
    static_sensitivities,
    young_weights,
)
from limber.mechanics.materials.materials import log_bulk_over_shear, poisson_of
from limber.mechanics.statics.rest_shape import unloaded_rest_shape

PRECISE = StaticSettings(tolerance=1e-12)
CONTROL = np.array([2e7, 1e7, 3e7])
DAMPING = RayleighDamping(0.8, 0.004)
NAMES = ("log_young", "log_bulk_over_shear", "log_density", "damping_mass", "damping_stiffness")
STEP = 1e-4


@pytest.fixture(scope="module")
def mesh():
    return box_mesh((0.012, 0.012, 0.2), (1, 1, 8))


@pytest.fixture(scope="module")
def weights(mesh):
    return young_weights(mesh, np.array([[0, 0, z] for z in (0.03, 0.1, 0.17)]))


def base_model(mesh, weights, material="st_venant_kirchhoff"):
    return BranchModel(mesh, young=weights @ CONTROL, poisson=0.3, density=900, damping=DAMPING,
                       gravity=(1.0, 0, -9.8), material=material)


def varied(model, weights, column, step):
    """The model with one parameter changed by ``step``."""
    if column < 3:
        factor = np.ones(3)
        factor[column] = np.exp(step)
        return model.with_young(weights @ (CONTROL * factor))
    return [
        lambda: model.with_parameters(poisson=poisson_of(log_bulk_over_shear(0.3) + step)),
        lambda: model.with_parameters(density=model.density * np.exp(step)),
        lambda: model.with_parameters(damping=RayleighDamping(
            model.damping.mass + step, model.damping.stiffness)),
        lambda: model.with_parameters(damping=RayleighDamping(
            model.damping.mass, model.damping.stiffness + 0.01 * step)),
    ][column - 3]()


CASES = [("rigid", "st_venant_kirchhoff"), ("point", "st_venant_kirchhoff"),
         ("force", "st_venant_kirchhoff"), ("rigid", "stable_neo_hookean")]


@pytest.mark.parametrize(("mode", "material"), CASES)
def test_static_derivatives(mesh, weights, mode, material):
    """Displacement, reaction and energy change as central differences say, to 1e-5."""
    model = base_model(mesh, weights, material)
    grasp = Grasp.at(mesh, [0, 0, 0.15], 0.015, "rigid" if mode == "rigid" else "point")
    pull = ({"grasp_force": [0.05, 0.02, 0]} if mode == "force" else
            {"pose": grasp.rest_pose + np.array([0.04, 0.01, -0.006, 0, 0.1, 0.1])})

    def solve(candidate):
        return solve_static(candidate, grasp=grasp, settings=PRECISE, **pull).require()

    result = solve(model)
    found = static_sensitivities(model, result, grasp, weights, NAMES[:3], is_held=mode != "force")
    assert found.labels == ["log_young_0", "log_young_1", "log_young_2", *NAMES[1:3]]
    for column in range(5):
        ahead, behind = (solve(varied(model, weights, column, s)) for s in (STEP, -STEP))
        moved = (ahead.displacement - behind.displacement) / (2 * STEP)
        error = np.linalg.norm(found.displacement[:, :, column] - moved)
        assert error < 1e-5 * np.linalg.norm(moved)
        energy = (ahead.strain_energy - behind.strain_energy) / (2 * STEP)
        assert found.strain_energy[column] == pytest.approx(energy, rel=1e-4, abs=1e-9)
        if mode != "force":
            force = (ahead.reaction_force - behind.reaction_force) / (2 * STEP)
            assert found.reaction_force[:, column] == pytest.approx(
                force, rel=1e-4, abs=1e-5 * np.abs(force).max())


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "material"), CASES)
def test_dynamic_derivatives(mesh, weights, mode, material):
    """The same along a motion, all frames, with density and both damping factors."""
    model = base_model(mesh, weights, material)
    grasp = Grasp.at(mesh, [0, 0, 0.15], 0.015, "rigid" if mode == "rigid" else "point")
    times = np.linspace(0, 0.3, 7)
    part = (times / 0.3)**2 * (3 - 2 * times / 0.3)
    poses = grasp.rest_pose + part[:, None] * np.array([0.04, 0.01, -0.006, 0, 0.1, 0.1])
    settings = NewmarkSettings(max_step=0.025, tolerance=1e-10)
    pull = ({"grasp_forces": np.outer(part, [0.05, 0.02, 0.0])} if mode == "force"
            else {"poses": poses})

    def move(candidate, **options):
        return simulate_dynamics(candidate, grasp=grasp, times=times, settings=settings, **pull,
                                 **options).require()

    found = move(model, sensitivities=ParameterSet(NAMES, weights),
                 sensitivity_nodes=np.array([5, -1])).sensitivities
    assert found.displacement.shape == (7, 2, 3, 7)
    for column in range(7):
        ahead, behind = (move(varied(model, weights, column, s)) for s in (STEP, -STEP))
        scale = 0.01 if column == 6 else 1.0
        moved = (ahead.displacement - behind.displacement)[:, [5, -1]] / (2 * STEP * scale)
        error = np.abs(found.displacement[..., column] - moved).max()
        assert error < 2e-4 * np.abs(moved).max()
        if mode == "force":
            continue
        force = (ahead.reaction_force - behind.reaction_force) / (2 * STEP * scale)
        error = np.abs(found.reaction_force[..., column] - force).max()
        assert error < 1e-3 * np.abs(force).max()


def test_derivatives_want_matching_weights(mesh, weights):
    """Weights that do not give the model's field are refused, as is an unknown name."""
    model = base_model(mesh, weights).with_young(np.linspace(1e7, 2e7, mesh.tet_count))
    result = solve_static(model).require()
    with pytest.raises(InputError, match="weights"):
        static_sensitivities(model, result, None, weights)
    with pytest.raises(InputError, match="no parameter"):
        static_sensitivities(model, result, None, None, ("colour",))


def test_moved_nodes_have_the_equations_of_a_mesh_made_there(mesh, weights):
    """Bit by bit, though pattern and layout are those of the first mesh; its own stay."""
    model, state = base_model(mesh, weights), np.zeros_like(mesh.nodes)
    load = np.random.default_rng(2).standard_normal(mesh.nodes.shape)
    before = model.equations().exact_tangent(model, state).solve(load)
    nodes = mesh.nodes + 1e-4 * np.random.default_rng(1).standard_normal(mesh.nodes.shape)
    found, fresh = (each.equations().exact_tangent(each, state).solve(load) for each in (
        model.with_rest_nodes(nodes), base_model(replace(mesh, nodes=nodes), weights)))
    assert np.array_equal(found, fresh) and not np.array_equal(found, before)
    assert np.array_equal(before, model.equations().tangent(model, state).solve(load))


def test_rest_shape_sags_to_the_scan():
    """Gravity on the found rest shape gives the scanned shape within 0.1 mm; new E, new shape."""
    mesh = box_mesh((0.012, 0.012, 0.2), (1, 1, 20))
    weights = young_weights(mesh, np.array([[0, 0, z] for z in (0.03, 0.1, 0.17)]))
    model = base_model(mesh, weights).with_parameters(gravity=(25.0, 5.0, 0))
    shape = unloaded_rest_shape(model)
    assert np.abs(shape.nodes - mesh.nodes).max() > 0.01
    loaded = solve_static(model.with_rest_nodes(shape.nodes)).require()
    assert np.abs(shape.nodes + loaded.displacement - mesh.nodes).max() < 1e-4
    stiffer = model.with_young(3 * model.young)
    again = unloaded_rest_shape(stiffer, start=shape.nodes)
    loaded = solve_static(stiffer.with_rest_nodes(again.nodes)).require()
    assert np.abs(again.nodes + loaded.displacement - mesh.nodes).max() < 1e-4
    assert np.abs(again.nodes - shape.nodes).max() > 0.005
