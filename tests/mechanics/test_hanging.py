"""A branch that hangs as it was scanned: balance, energy, force, and what it leaves out."""

import numpy as np
import pytest
from tests.subjects.meshes import box_mesh

from limber.mechanics.added_masses import PointMass
from limber.mechanics.dynamics.integration import simulate_dynamics
from limber.mechanics.grasp import Grasp
from limber.mechanics.materials.materials import log_bulk_over_shear, poisson_of
from limber.mechanics.model import BranchModel
from limber.mechanics.sensitivities import static_sensitivities
from limber.mechanics.statics.rest_shape import unloaded_rest_shape
from limber.mechanics.statics.solve import solve_static
from limber.mechanics.strain import strain_state

SIDEWAYS, DOWN = (9.81, 0.0, 0.0), (0.0, 0.0, -9.81)
LENGTH = 0.6


@pytest.fixture(scope="module")
def mesh():
    return box_mesh((0.012, 0.012, LENGTH), (1, 1, 40))


def prestress(mesh, gravity, young=1e8, **more) -> BranchModel:
    return BranchModel(mesh, young=young, poisson=0.35, density=900.0, gravity=gravity,
                       **more).as_scanned()


def top(mesh, mode="point") -> Grasp:
    return Grasp.of_nodes(mesh, np.flatnonzero(mesh.nodes[:, 2] > LENGTH - 0.012), mode)


def pulled(grasp, *move) -> np.ndarray:
    return grasp.rest_pose + np.r_[move, np.zeros(3)]


@pytest.mark.parametrize("gravity", [SIDEWAYS, DOWN])
def test_nothing_moves_by_itself(mesh, gravity):
    """The scanned shape is in balance, whatever Young's modulus; the base bears the weight."""
    model = prestress(mesh, gravity, point_masses=[PointMass((0, 0, LENGTH), 0.01)])
    for young in (1e8, np.linspace(5e7, 2e8, mesh.tet_count)):
        result = solve_static(model.with_young(young)).require()
        assert np.abs(result.displacement).max() == 0.0
        assert result.energy == 0.0
        np.testing.assert_allclose(result.base_force, -model.total_mass * np.array(gravity),
                                   atol=1e-7)


@pytest.mark.parametrize("gravity", [SIDEWAYS, DOWN])
@pytest.mark.parametrize("mode", ["point", "rigid"])
def test_force_is_the_gradient_of_the_potential(mesh, gravity, mode):
    """Force (and torque) against central differences of the energy."""
    model, grasp = prestress(mesh, gravity), top(mesh, mode)
    pose = pulled(grasp, 0.12, 0.05, -0.05)
    at = solve_static(model, grasp=grasp, pose=pose).require()
    step = 1e-5
    for axis in range(3):
        ahead, behind = (solve_static(model, grasp=grasp, start=at,
                                      pose=pose + sign * step * np.eye(6)[axis]).require()
                         for sign in (1, -1))
        slope = (ahead.energy - behind.energy) / (2 * step)
        assert slope == pytest.approx(at.reaction_force[axis], rel=1e-5)


def test_agrees_with_the_stress_free_shape(mesh):
    """Sagging by 118 mm of 600: forces, energy and places against the rest shape by inverse
    statics, an independent way, within the strain that the weight causes."""
    model = BranchModel(mesh, young=1e8, poisson=0.35, density=900.0, gravity=SIDEWAYS)
    shape = unloaded_rest_shape(model)
    bent = model.with_rest_nodes(shape.nodes)
    sagged = solve_static(bent, start=mesh.nodes - shape.nodes).require()
    assert np.linalg.norm(sagged.displacement, axis=1).max() > 0.1
    grasp, patch = top(mesh), top(mesh).nodes
    pose = pulled(grasp, 0.12, 0.05, -0.05)
    one = solve_static(model.as_scanned(), grasp=grasp, pose=pose).require()
    other = solve_static(bent, grasp=Grasp.of_nodes(shape, patch, "point"), pose=pose,
                         start=sagged).require()
    np.testing.assert_allclose(one.reaction_force, other.reaction_force, rtol=2e-3)
    assert one.energy == pytest.approx(other.energy - sagged.energy, rel=2e-3)
    off = mesh.nodes + one.displacement - shape.nodes - other.displacement
    assert np.linalg.norm(off, axis=1).max() < 2e-4
    weightless = solve_static(model.with_parameters(gravity=(0, 0, 0)), grasp=grasp, pose=pose)
    # Without weight the force is off by ten times that.
    assert abs(weightless.reaction_force[2] / other.reaction_force[2] - 1) < 0.05
    assert abs(weightless.reaction_force[1] / other.reaction_force[1] - 1) > 5e-3


def test_a_standing_column_buckles_where_theory_says(mesh):
    """Greenhill: a column stands up to (rho g A L^3) / (E I) = 7.837."""
    width = 0.012
    critical = 900 * 9.81 * width**2 * LENGTH**3 / (7.837 * width**4 / 12)
    model = prestress(mesh, DOWN)
    for young, stands in ((1.03 * critical, True), (0.97 * critical, False)):
        tangent = model.equations().tangent(model.with_young(young), np.zeros_like(mesh.nodes))
        assert tangent.is_positive_definite is stands


def test_what_is_hung_on_later_bends_it(mesh):
    """A fruit added to a hanging branch acts as a load of its weight."""
    model = prestress(mesh, SIDEWAYS, young=3e8)
    point = mesh.nodes[mesh.nodes[:, 2].argmax()]
    loads = np.zeros_like(mesh.nodes)
    loads[np.linalg.norm(mesh.nodes - point, axis=1).argmin()] = 0.02 * np.array(SIDEWAYS)
    hung = solve_static(model.with_point_masses([PointMass(tuple(point), 0.02)])).require()
    pushed = solve_static(model, nodal_forces=loads).require()
    np.testing.assert_allclose(hung.displacement, pushed.displacement, atol=1e-9)
    assert hung.energy < 0.0 < pushed.strain_energy


def test_sensitivities(mesh):
    """To Young's modulus, Poisson's ratio and density, against central differences."""
    grasp, step = top(mesh), 1e-4
    model = prestress(mesh, SIDEWAYS)
    pose = pulled(grasp, 0.10, 0.06, -0.04)
    at = solve_static(model, grasp=grasp, pose=pose).require()
    found = static_sensitivities(model, at, grasp, None, (
        "log_young", "log_bulk_over_shear", "log_density"))
    changes = ({"young": 1e8}, {"poisson": 0.35}, {"density": 900.0})
    for column, change in enumerate(changes):
        (name, value), = change.items()
        moved = [poisson_of(log_bulk_over_shear(value) + s) if name == "poisson"
                 else value * np.exp(s) for s in (step, -step)]
        ahead, behind = (solve_static(model.with_parameters(**{name: v}), grasp=grasp, pose=pose,
                                      start=at).require() for v in moved)
        slope = (ahead.displacement - behind.displacement) / (2 * step)
        size = np.abs(slope).max()
        assert np.abs(found.displacement[..., column] - slope).max() < 2e-3 * size + 1e-9
        slope = (ahead.reaction_force - behind.reaction_force) / (2 * step)
        np.testing.assert_allclose(found.reaction_force[..., column], slope, rtol=2e-3, atol=1e-6)


def test_density_field_and_factor_agree(mesh):
    """A density that is given again for each tetrahedron is carried as one by a factor."""
    model = prestress(mesh, SIDEWAYS, point_masses=[PointMass((0, 0, LENGTH), 0.01)])
    twice = model.with_parameters(density=1800.0).weight_stiffness
    anew = BranchModel(mesh, young=1e8, poisson=0.35, density=1800.0, gravity=SIDEWAYS,
                       point_masses=model.point_masses).as_scanned().weight_stiffness
    assert abs(twice - anew).max() < 1e-9 * abs(anew).max()


def test_stress_at_rest_is_that_of_the_weight(mesh):
    """Bending stress at the base of a cantilever under its weight: rho g A L^2 / (2 W)."""
    model = prestress(mesh, SIDEWAYS, young=1e9)
    state = strain_state(model, np.zeros_like(mesh.nodes))
    width, height = 0.012, mesh.nodes[mesh.tets[:, :4]].mean(axis=1)[:, 2]
    low = np.abs(height - 0.05) < 0.01
    at_skin = 900 * 9.81 * width**2 * (LENGTH - 0.05) ** 2 / 2 / (width**3 / 6)
    # Means of tetrahedra lie inside the skin.
    assert 0.3 * at_skin < state.principal_stress[low].max() < at_skin
    np.testing.assert_allclose(state.principal_strain[low].max() * 1e9,
                               state.principal_stress[low].max(), rtol=0.3)


def test_motion_keeps_still_and_swings_as_a_pendulum_would(mesh):
    """At rest nothing starts to move; released, energy of strain, weight and motion is kept."""
    from limber.mechanics.dynamics.motion import NewmarkSettings
    from limber.mechanics.materials.materials import RayleighDamping

    model = prestress(mesh, SIDEWAYS, damping=RayleighDamping(0.0, 0.0))
    times = np.linspace(0.0, 0.2, 21)
    still = simulate_dynamics(model, times=times)
    assert np.abs(still.displacement).max() < 1e-12
    loads = np.zeros_like(mesh.nodes)
    loads[mesh.nodes[:, 2].argmax()] = (0.0, 0.3, 0.0)
    start = solve_static(model, nodal_forces=loads).require()
    swung = simulate_dynamics(model, times=times, start=start,
                              settings=NewmarkSettings(max_step=1 / 400))
    total = swung.energy + swung.kinetic_energy
    assert np.abs(total / start.energy - 1).max() < 0.01
