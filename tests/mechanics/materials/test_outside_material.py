"""Material laws from outside of the package: all that one file needs to bend a branch with them."""

import doctest
import json
import pickle

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.optimize import brentq
from tests.subjects.meshes import box_mesh
from tests.subjects.prescribed import solve_prescribed

from limber.cli.main import call
from limber.core.errors import InputError
from limber.core.settings import checked_settings
from limber.mechanics import (
    BranchModel,
    EnergyMomentumSettings,
    Grasp,
    MaterialLaw,
    NewmarkSettings,
    ParameterSet,
    RayleighDamping,
    StaticSettings,
    register_material,
    simulate_dynamics,
    solve_static,
    static_sensitivities,
    young_weights,
)
from limber.mechanics.linear.equations import Viscous
from limber.mechanics.materials import laws
from limber.mechanics.materials.laws import contracted, determinant, right_cauchy_green
from limber.mechanics.materials.materials import log_bulk_over_shear, poisson_of
from limber.mechanics.pull_simulation import SimulateSettings
from limber.mechanics.strain import peak_load, strain_state
from limber.reduced.strain_polynomial import make_polynomial
from limber.results.exports.volumes import as_deformable, inp_text

SHARE = 0.4
"""Of the shear modulus that the second invariant bears."""
PRECISE = StaticSettings(tolerance=1e-12)
UNDAMPED = RayleighDamping(0.0, 0.0)


class MooneyRivlin(MaterialLaw):
    """c1 (I1 - 3) + c2 (I2 - 3) - (2 c1 + 4 c2) ln J + (lambda - 4 c2) / 2 (ln J)^2."""

    name = "mooney_rivlin"

    def energy(self, strain, lame_lambda, lame_mu):
        c = right_cauchy_green(strain)
        trace = c[..., :3].sum(axis=-1)
        c1, c2 = 0.5 * (1 - SHARE) * lame_mu, 0.5 * SHARE * lame_mu
        log_volume = 0.5 * np.log(determinant(c))
        return (c1 * (trace - 3) + c2 * (0.5 * (trace**2 - contracted(c, c)) - 3)
                - (2 * c1 + 4 * c2) * log_volume
                + 0.5 * (lame_lambda - 4 * c2) * log_volume**2)


class SecondStVenantKirchhoff(MaterialLaw):
    """The built-in law, as one who does not know it would write it."""

    name = "second_stvk"

    def energy(self, strain, lame_lambda, lame_mu):
        trace = strain[..., 0] + strain[..., 1] + strain[..., 2]
        return 0.5 * lame_lambda * trace**2 + lame_mu * contracted(strain, strain)


class Fibres(MaterialLaw):
    """Wood whose fibres along z are stiffer, and stiffen; it gives its stress itself."""

    name = "fibres"

    def energy(self, strain, lame_lambda, lame_mu):
        along = strain[..., 2]
        return (SecondStVenantKirchhoff().energy(strain, lame_lambda, lame_mu)
                + lame_mu * (5 * along**2 + 40 * along**4))

    def stress(self, strain, lame_lambda, lame_mu):
        along = strain[..., 2]
        stress = SecondStVenantKirchhoff().stress(strain, lame_lambda, lame_mu)
        stress[..., 2] += lame_mu * (10 * along + 160 * along**3)
        return stress


LAWS = (MooneyRivlin(), Fibres(), SecondStVenantKirchhoff())
NAMES = [law.name for law in LAWS]


@pytest.fixture(autouse=True)
def known(monkeypatch):
    """These laws, registered for one test."""
    monkeypatch.setattr(laws, "_registered", {})
    for law in LAWS:
        register_material(law)


@pytest.fixture(scope="module")
def mesh():
    return box_mesh((0.012, 0.012, 0.2), (1, 1, 8))


def make_model(mesh, material, **options):
    values = {"young": 1e7, "poisson": 0.3, "density": 900.0, "gravity": None} | options
    return BranchModel(mesh, material=material, **values)


def full_stiffness(pattern, values):
    lower = sp.csc_matrix((values, pattern.entries()), shape=(pattern.size,) * 2)
    return lower + sp.tril(lower, -1).T


@pytest.mark.parametrize("material", NAMES)
@pytest.mark.parametrize("quadratic", [True, False])
@pytest.mark.parametrize("viscous", [True, False])
def test_force_and_stiffness_are_derivatives(material, quadratic, viscous):
    """Force is the energy's derivative, stiffness the force's, both ways to it alike."""
    rng = np.random.default_rng(3)
    mesh = box_mesh(quadratic=quadratic)
    model = make_model(mesh, material, young=rng.uniform(1e6, 5e6, mesh.tet_count))
    u = 3e-4 * rng.standard_normal(mesh.nodes.shape)
    d = rng.standard_normal(mesh.nodes.shape)
    d[model.fixed] = 0
    part = (Viscous(1.7, 0.02 * rng.standard_normal((*model.weights.shape, 6)))
            if viscous else None)
    h = 2e-8
    ahead, behind = (model.internal(u + s * h * d, viscous=part) for s in (1, -1))
    if not viscous:
        by_energy = (ahead.strain_energy - behind.strain_energy) / (2 * h)
        assert by_energy == pytest.approx((model.internal(u).force * d).sum(), rel=1e-6)
    change = (ahead.force - behind.force) / (2 * h)
    exact = model.tangent_times(u, d, part)
    assert np.linalg.norm(exact - change) < 1e-6 * np.linalg.norm(change)
    equations = model.equations()
    order = equations.pattern.order
    assembled = full_stiffness(
        equations.pattern, equations.assemble(model, u, viscous=part)) @ d[order].ravel()
    error = np.linalg.norm(assembled - exact[order].ravel())
    assert error < 1e-9 * np.linalg.norm(exact)


@pytest.mark.parametrize("material", NAMES)
def test_patch_test(material):
    """Boundary nodes moved by a linear map: all inner nodes follow it, to 1e-9."""
    mesh = box_mesh((0.03, 0.02, 0.02), (3, 3, 3))
    inside = np.abs(mesh.nodes - mesh.nodes.mean(axis=0)) < np.array([0.0149, 0.0099, 0.0099])
    boundary = ~inside.all(axis=1)
    shift = mesh.nodes @ np.array([[0.02, 0.01, 0], [0.03, -0.01, 0.02], [0, 0.01, 0.03]])
    model = make_model(mesh, material, fixed=boundary)
    result = solve_prescribed(model, shift, settings=PRECISE).require()
    assert np.abs(result.displacement - shift).max() < 1e-9 * np.abs(shift).max()


@pytest.mark.parametrize("stretch", [0.7, 1.05, 1.6])
def test_uniaxial_stretch(stretch):
    """A bar pulled alone: force and stress of the formula in principal stretches, sides free."""
    size, young, poisson = 0.01, 1e7, 0.3
    lam, mu = young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))
    c1, c2 = 0.5 * (1 - SHARE) * mu, 0.5 * SHARE * mu

    def side_stress(side):
        slope = -(2 * c1 + 4 * c2) + (lam - 4 * c2) * np.log(stretch * side**2)
        return 2 * c1 * side + 2 * c2 * (side * stretch**2 + side**3) + slope / side

    side = brentq(side_stress, 0.5, 1.5, xtol=1e-14)
    slope = -(2 * c1 + 4 * c2) + (lam - 4 * c2) * np.log(stretch * side**2)
    pull = 2 * c1 * stretch + 4 * c2 * stretch * side**2 + slope / stretch
    mesh = box_mesh((size, size, 0.03), (2, 2, 3))
    model = make_model(mesh, "mooney_rivlin", young=young, poisson=poisson)
    moved = mesh.nodes * [side - 1, side - 1, stretch - 1]
    force = model.internal(moved).force
    top = mesh.nodes[:, 2] > 0.03 - 1e-9
    between = ~top & (mesh.nodes[:, 2] > 1e-9)
    assert force[top].sum(axis=0) == pytest.approx([0, 0, pull * size**2], rel=1e-9, abs=1e-6)
    assert np.abs(force[between]).max() < 1e-9 * abs(pull) * size**2
    state = strain_state(model, moved)
    largest = state.principal_stress[:, np.abs(state.principal_stress).mean(axis=0).argmax()]
    assert largest == pytest.approx(pull / side**2, rel=1e-9)
    assert peak_load(model, moved)[2] == pytest.approx(abs(pull) / side**2, rel=1e-9)


@pytest.mark.slow
def test_one_energy_gives_the_built_in_law(mesh):
    """St. Venant-Kirchhoff as an energy: statics, hung or not, and motion as built in, to 1e-9."""
    grasp = Grasp.at(mesh, [0, 0, 0.15], 0.015)
    pose = grasp.rest_pose + [0.04, 0.01, -0.006, 0, 0.1, 0.1]
    ends = {}
    for material in ("st_venant_kirchhoff", "second_stvk"):
        model = make_model(mesh, material, gravity=(0.3, 0.0, -9.8))
        found = [solve_static(one, grasp=grasp, pose=pose, settings=PRECISE).require()
                 for one in (model, model.as_scanned())]
        ends[material] = [value for one in found for value in (
            one.displacement, one.reaction_force, one.strain_energy)]
        times = np.linspace(0.0, 0.2, 5)
        part = (times / 0.2)**2 * (3 - 2 * times / 0.2)
        poses = grasp.rest_pose + part[:, None] * (pose - grasp.rest_pose)
        motions = [simulate_dynamics(model, grasp=grasp, poses=poses, times=times,
                                     settings=settings).require()
                   for settings in (EnergyMomentumSettings(max_step=0.01, tolerance=1e-9),
                                    NewmarkSettings(max_step=0.01, tolerance=1e-11))]
        # Steps that keep energy reach no tighter tolerance, and forces are no more exact than it.
        ends[material] += [*(motion.displacement for motion in motions),
                           *(motion.strain_energy for motion in motions),
                           motions[1].reaction_force]
    for built_in, outside in zip(*ends.values(), strict=True):
        assert np.abs(outside - built_in).max() < 1e-9 * np.abs(built_in).max()


@pytest.mark.slow
@pytest.mark.parametrize("material", NAMES[:2])
def test_a_bent_branch_is_in_equilibrium(mesh, material):
    """Far aside: the gripper's force is the energy's derivative to its position."""
    model = make_model(mesh, material)
    grasp = Grasp.at(mesh, [0, 0, 0.15], 0.015, "point")
    pose = grasp.rest_pose + [0.06, 0.01, -0.012, 0, 0, 0]
    result = solve_static(model, grasp=grasp, pose=pose, settings=PRECISE).require()
    built_in = solve_static(model.with_material("st_venant_kirchhoff"), grasp=grasp, pose=pose,
                            settings=PRECISE).require()
    assert abs(result.strain_energy / built_in.strain_energy - 1) > 1e-3
    for axis, h in enumerate(1e-5 * np.eye(6)[:3]):
        ahead, behind = (solve_static(model, grasp=grasp, pose=pose + s * h,
                                      settings=PRECISE).require() for s in (1, -1))
        slope = (ahead.strain_energy - behind.strain_energy) / 2e-5
        assert slope == pytest.approx(result.reaction_force[axis], rel=1e-5, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("material", NAMES[:2])
def test_a_far_swing_keeps_its_energy(mesh, material):
    """Let go from far aside in long steps: the energy stays; damping only takes of it."""
    model = make_model(mesh, material, damping=UNDAMPED)
    grasp = Grasp.at(mesh, [0, 0, 0.2], 0.01, "point")
    bent = solve_static(model, grasp=grasp, grasp_force=[3.0, 0, 0]).require()
    assert bent.displacement[grasp.nodes, 0].mean() > 0.02
    times = np.linspace(0.0, 0.15, 16)
    for damping in (UNDAMPED, RayleighDamping(0.5, 0.002)):
        motion = simulate_dynamics(model.with_parameters(damping=damping), times=times, start=bent,
                                   settings=EnergyMomentumSettings(max_step=0.01)).require()
        energy = motion.strain_energy + motion.kinetic_energy
        assert motion.kinetic_energy.max() > 0.5 * energy[0]
        if damping is UNDAMPED:
            assert np.abs(energy / energy[0] - 1).max() < 1e-5
        else:
            assert (np.diff(energy) < 1e-6 * energy[0]).all() and energy[-1] < 0.8 * energy[0]


@pytest.mark.slow
@pytest.mark.parametrize("material", NAMES[:2])
def test_derivatives(mesh, material):
    """What changes with E and Poisson's ratio, at rest and along a motion, by differences."""
    weights = young_weights(mesh, np.array([[0, 0, 0.03], [0, 0, 0.17]]))
    young = np.array([2e7, 1e7])
    model = make_model(mesh, material, young=weights @ young, gravity=(1.0, 0, -9.8))
    grasp = Grasp.at(mesh, [0, 0, 0.15], 0.015)
    pose = grasp.rest_pose + [0.03, 0.01, -0.004, 0, 0.1, 0.1]
    times = np.linspace(0.0, 0.1, 3)
    poses = grasp.rest_pose + (times / 0.1)[:, None]**2 * (pose - grasp.rest_pose)
    settings = NewmarkSettings(max_step=0.025, tolerance=1e-10)

    def both(candidate, **options):
        still = solve_static(candidate, grasp=grasp, pose=pose, settings=PRECISE).require()
        return still, simulate_dynamics(candidate, grasp=grasp, poses=poses, times=times,
                                        settings=settings, **options).require()

    names = ("log_young", "log_bulk_over_shear")
    still, moving = both(model, sensitivities=ParameterSet(names, weights),
                         sensitivity_nodes=np.array([-1]))
    found = static_sensitivities(model, still, grasp, weights, names)
    step = 1e-4
    varied = [lambda s: model.with_young(weights @ (young * [np.exp(s), 1])),
              lambda s: model.with_young(weights @ (young * [1, np.exp(s)])),
              lambda s: model.with_parameters(poisson=poisson_of(log_bulk_over_shear(0.3) + s))]
    for column, change in enumerate(varied):
        (ahead, flown), (behind, swum) = both(change(step)), both(change(-step))
        moved = (ahead.displacement - behind.displacement) / (2 * step)
        assert np.linalg.norm(found.displacement[:, :, column] - moved) < (
            1e-5 * np.linalg.norm(moved))
        force = (ahead.reaction_force - behind.reaction_force) / (2 * step)
        assert found.reaction_force[:, column] == pytest.approx(
            force, rel=1e-4, abs=1e-5 * np.abs(force).max())
        energy = (ahead.strain_energy - behind.strain_energy) / (2 * step)
        assert found.strain_energy[column] == pytest.approx(energy, rel=1e-4)
        swing = (flown.displacement - swum.displacement)[:, [-1]] / (2 * step)
        error = np.abs(moving.sensitivities.displacement[..., column] - swing).max()
        assert error < 2e-4 * np.abs(swing).max()


def simulated(capsys, folder, material, *options):
    code = call(["simulate", str(folder), "--material", material, "--duration", "0.1", "--hold",
                 "0", "--move", "0.05", "0", "-0.005", "--json", *options])
    return code, capsys.readouterr()


@pytest.mark.parametrize("kind", ["static", pytest.param("dynamic", marks=pytest.mark.slow)])
def test_the_command_takes_it(capsys, folder, kind):
    """`limber simulate --material`: as the built-in law where it is the same, else another."""
    results = {}
    for material in ("st_venant_kirchhoff", "second_stvk", "fibres"):
        code, told = simulated(capsys, folder, material, "--kind", kind)
        assert code == 0
        results[material] = json.loads(told.out.splitlines()[-1])
        assert results[material]["converged"]
    built_in, same, stiffer = (one["energy_j"] for one in results.values())
    assert same == pytest.approx(built_in, rel=1e-5)
    assert stiffer > 2 * built_in
    code, told = simulated(capsys, folder, "wooden")
    assert code == 2 and "fibres" in told.err
    with pytest.raises(InputError, match=r"--material 'wooden': it must be one of .*fibres"):
        checked_settings(SimulateSettings, {"material": "wooden"})


def test_a_changed_law_is_computed_again(capsys, folder):
    """Results of a law of the same name that now gives other stress are out of date."""
    def energy_and_frames():
        code, told = simulated(capsys, folder, "second_stvk", "--kind", "static")
        assert code == 0
        return (json.loads(told.out.splitlines()[-1])["energy_j"],
                (folder / "frames" / "simulate.pc2").stat().st_mtime_ns)

    first = energy_and_frames()
    assert energy_and_frames() == first
    register_material(_law(name="second_stvk", energy=Fibres().energy))
    assert energy_and_frames()[0] > 2 * first[0]


def test_what_cannot_use_it_refuses(mesh):
    """The reduced model, and programs that are told two moduli; small strains alike will do."""
    mooney, fibres = (make_model(mesh, name) for name in NAMES[:2])
    with pytest.raises(InputError, match=r"mooney_rivlin.*cubic"):
        make_polynomial(mooney, None, None, None, None, None)
    tip = int(mesh.nodes[:, 2].argmax())
    with pytest.raises(InputError, match=r"Abaqus.*does not support the material 'mooney_rivlin'"):
        inp_text(mooney, "bar", tip)
    with pytest.raises(InputError, match="PhysX does not support the material 'fibres'"):
        as_deformable(fibres, tip)
    with pytest.raises(InputError, match="rod's spring does not support the material 'fibres'"):
        from limber.results.exports.rigid_links import rod_tree

        rod_tree(fibres, None, 0.02)
    assert as_deformable(mooney, tip).young == pytest.approx(
        as_deformable(mooney.with_material("st_venant_kirchhoff"), tip).young, rel=1e-6)


def test_another_process_gets_it(mesh):
    """A model goes to the processes of a pool with its law; what they compute is the same."""
    model = make_model(mesh, "mooney_rivlin")
    moved = 0.02 * mesh.nodes
    laws._registered.clear()
    again = pickle.loads(pickle.dumps(model))
    assert np.array_equal(again.internal(moved).force, model.internal(moved).force)
    with pytest.raises(InputError, match="no material 'mooney_rivlin'"):
        make_model(mesh, "mooney_rivlin")


def test_the_example_of_a_law_is_one():
    """What the documentation shows as a law is accepted as it stands there."""
    shown = {}
    for step in doctest.DocTestParser().get_examples(laws.__doc__):
        exec(step.source, shown)
    assert register_material(shown["Cubic"]()).name == "cubic"


def _law(**parts):
    return type("Law", (SecondStVenantKirchhoff,), {"name": "tried", **parts})()


WRONG = {
    "not a valid material name": {"name": "linear"},
    "built-in": {"is_hookean": True},
    "energy or stress at zero strain": {"energy": lambda self, e, lam, mu: (
        mu * (e[..., 0] + contracted(e, e)))},
    "not the derivative of its energy": {"energy": lambda self, e, lam, mu: (
        lam + mu) * np.abs(contracted(e, e))},
    "not the derivative of its stress": {"moduli": lambda self, e, lam, mu: (
        mu[..., None, None] * np.eye(6))},
    "not linear": {"energy": lambda self, e, lam, mu: mu**2 * contracted(e, e)},
    "not stable": {"energy": lambda self, e, lam, mu: mu * e[..., 0]**2},
    "shape": {"energy": lambda self, e, lam, mu: 1.0},
}


@pytest.mark.parametrize("trouble", WRONG)
def test_a_wrong_law_is_refused(trouble):
    """Each for its own reason, when it is registered."""
    with pytest.raises(InputError, match=trouble):
        register_material(_law(**WRONG[trouble]))
    assert register_material(_law()).name in laws.material_names()
