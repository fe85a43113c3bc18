"""Motion: frequency and energy of free vibration, second order in the step, damping, grasps."""

from itertools import pairwise

import numpy as np
import pytest
from tests.subjects.meshes import box_mesh

from limber.core.errors import InputError
from limber.mechanics import (
    BranchModel,
    EnergyMomentumSettings,
    Grasp,
    NewmarkSettings,
    RayleighDamping,
    follow_poses,
    simulate_dynamics,
    solve_static,
)

LENGTH, SIDE, YOUNG, DENSITY = 0.2, 0.01, 1e7, 900.0
UNDAMPED = RayleighDamping(0.0, 0.0)


@pytest.fixture(scope="module")
def mesh():
    return box_mesh((SIDE, SIDE, LENGTH), (1, 1, 16))


def make_model(mesh, **options):
    values = {"young": YOUNG, "poisson": 0.3, "density": DENSITY, "gravity": None,
              "damping": UNDAMPED} | options
    return BranchModel(mesh, **values)


def tip_of(mesh):
    return Grasp.of_nodes(mesh, np.flatnonzero(mesh.nodes[:, 2] > LENGTH - 1e-9), "point")


@pytest.mark.slow
def test_free_vibration_keeps_frequency_and_energy(mesh):
    """1,000 undamped steps: the beam's first frequency and the energy stay within 1 %."""
    model = make_model(mesh)
    tip = tip_of(mesh)
    bent = solve_static(model, grasp=tip, grasp_force=[0.004, 0, 0]).require()
    inertia, area = SIDE**4 / 12, SIDE**2
    frequency = 1.87510407**2 / (2 * np.pi * LENGTH**2) * np.sqrt(
        YOUNG * inertia / (DENSITY * area))
    step = 1 / frequency / 100
    times = step * np.arange(1001)
    result = simulate_dynamics(model, times=times, start=bent,
                               settings=NewmarkSettings(max_step=step)).require()
    sway = result.displacement[:, tip.nodes, 0].mean(axis=1)
    crossings = np.flatnonzero((sway[:-1] > 0) & (sway[1:] <= 0))
    exact = times[crossings] + step * sway[crossings] / (sway[crossings] - sway[crossings + 1])
    measured = 1 / np.diff(exact).mean()
    assert measured == pytest.approx(frequency, rel=0.01)
    energy = result.strain_energy + result.kinetic_energy
    assert np.abs(energy / energy[0] - 1).max() < 0.01
    assert result.step_count == 1000


@pytest.mark.parametrize("material", ["st_venant_kirchhoff", "stable_neo_hookean"])
def test_a_far_swing_gains_no_energy(mesh, material):
    """Let go from more than half its length aside, in long steps: Newmark's explodes, this not."""
    model = make_model(mesh, material=material)
    bent = solve_static(model, grasp=tip_of(mesh), grasp_force=[0.5, 0, 0]).require()
    assert bent.displacement[tip_of(mesh).nodes, 0].mean() > 0.5 * LENGTH
    step = 1 / 4.257 / 30
    times = step * np.arange(81)
    kept = simulate_dynamics(model, times=times, start=bent,
                             settings=EnergyMomentumSettings(max_step=step)).require()
    energy = kept.strain_energy + kept.kinetic_energy
    assert np.abs(energy / energy[0] - 1).max() < 1e-4
    assert kept.kinetic_energy.max() > 0.9 * energy[0]
    if material == "st_venant_kirchhoff":
        gone = simulate_dynamics(model, times=times, start=bent,
                                 settings=NewmarkSettings(max_step=step))
        grown = (gone.strain_energy + gone.kinetic_energy).max()
        assert not gone.converged or grown > 2 * energy[0]


def test_damping_takes_what_it_should(mesh):
    """A small free swing with Rayleigh damping: energy falls as exp(-2 zeta omega t), and only."""
    omega = 2 * np.pi * 4.257
    damping = RayleighDamping(1.0, 0.002)
    model = make_model(mesh, damping=damping)
    bent = solve_static(model, grasp=tip_of(mesh), grasp_force=[0.004, 0, 0]).require()
    step = 1 / 4.257 / 40
    result = simulate_dynamics(model, times=step * np.arange(161), start=bent,
                               settings=EnergyMomentumSettings(max_step=step)).require()
    energy = result.strain_energy + result.kinetic_energy
    assert (np.diff(energy) < 1e-6 * energy[0]).all()
    rate = damping.mass + damping.stiffness * omega**2
    # From the second period on: the higher modes of the bent start are gone.
    assert np.log(energy[40] / energy[160]) == pytest.approx(rate * 120 * step, rel=0.03)


SCHEMES = {"energy_momentum": EnergyMomentumSettings, "newmark": NewmarkSettings}


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("damping", [UNDAMPED, RayleighDamping(1.0, 0.01)],
                         ids=["undamped", "damped"])
def test_second_order_in_the_step(mesh, damping, scheme):
    """Halving the step quarters the error, with and without viscosity, at large swing."""
    model = make_model(mesh, damping=damping)
    grasp = tip_of(mesh)
    end = 0.24
    ends = []
    for count in (24, 48, 96, 192):
        times = np.linspace(0, end, count + 1)
        pull = np.outer(np.sin(np.pi * times / end) ** 2, [0.4, 0.15, 0.0])
        result = simulate_dynamics(
            model, grasp=grasp, grasp_forces=pull, times=times, start="rest",
            settings=SCHEMES[scheme](max_step=1.0, tolerance=1e-9)).require()
        ends.append(result.displacement[-1])
        largest = np.abs(result.displacement).max()
    errors = [np.linalg.norm(a - b) for a, b in pairwise(ends)]
    rate = np.log2(errors[-2] / errors[-1])
    assert rate == pytest.approx(2.0, abs=0.1)
    assert largest > 0.2 * LENGTH


@pytest.mark.parametrize("scheme", SCHEMES)
def test_slow_motion_is_static(mesh, scheme):
    """A grasp moved slowly with damping: shape, energy and force are those of statics."""
    model = make_model(mesh, damping=RayleighDamping(2.0, 0.01))
    grasp = Grasp.at(mesh, [0, 0, 0.15], 0.012)
    times = np.linspace(0, 6, 61)
    part = np.clip(times / 4, 0, 1)
    part = part**2 * (3 - 2 * part)
    poses = grasp.rest_pose + part[:, None] * np.array([0.03, 0.01, -0.003, 0, 0.2, 0])
    moving = simulate_dynamics(model, grasp=grasp, poses=poses, times=times,
                               settings=SCHEMES[scheme](max_step=0.1)).require()
    still = follow_poses(model, grasp, poses[-1:])[0].require()
    assert moving.displacement[-1] == pytest.approx(still.displacement, abs=2e-6)
    assert moving.strain_energy[-1] == pytest.approx(still.strain_energy, rel=1e-3)
    assert moving.reaction_force[-1] == pytest.approx(still.reaction_force, rel=1e-2, abs=1e-4)
    assert moving.reaction_torque[-1] == pytest.approx(still.reaction_torque, rel=1e-2, abs=1e-5)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_reaction_of_a_pinned_grasp_is_smooth(mesh, scheme):
    """A smoothly led pinned grasp: its force does not ring from step to step."""
    model = make_model(mesh, damping=RayleighDamping(0.5, 0.005))
    grasp = tip_of(mesh)
    times = np.linspace(0, 0.5, 51)
    part = (times / 0.5)**2 * (3 - 2 * times / 0.5)
    poses = grasp.rest_pose + part[:, None] * np.array([0.03, 0, -0.003, 0, 0, 0])
    force = simulate_dynamics(model, grasp=grasp, poses=poses, times=times,
                              settings=SCHEMES[scheme](max_step=0.01)).require().reaction_force
    ringing = np.abs(force[2:, 0] - 2 * force[1:-1, 0] + force[:-2, 0]).max()
    assert ringing < 0.1 * np.abs(force[:, 0]).max()


def test_start_in_balance_stays_there(mesh):
    """Started from the equilibrium under gravity, nothing moves."""
    model = make_model(mesh, gravity=(0.5, 0, 0))
    result = simulate_dynamics(model, times=np.linspace(0, 0.2, 11)).require()
    assert np.abs(result.displacement - result.displacement[0]).max() < 1e-7
    assert np.abs(result.displacement[0]).max() > 1e-3


def test_rigid_turn_is_not_braked(mesh):
    """Viscosity works on strain alone: a rigidly turned state has no viscous force."""
    from limber.core.numerics.rigid import rotation_matrix
    from limber.mechanics.linear.equations import Viscous

    model = make_model(mesh)
    turned = mesh.nodes @ rotation_matrix(np.array([0, 0.5, 0])).T - mesh.nodes
    before = model.strains(np.zeros_like(turned))
    viscous = Viscous(1 + 0.01 * 60, -0.01 * 60 * before)
    assert np.abs(model.internal(turned, viscous=viscous).force).max() < 1e-9


@pytest.mark.slow
def test_torn_motion_stops_with_good_frames(mesh):
    """A grasp torn away: not converged, the frames before are kept and finite."""
    model = make_model(mesh, damping=RayleighDamping(0.5, 0.002))
    grasp = Grasp.at(mesh, [0, 0, 0.15], 0.012)
    times = np.linspace(0, 0.5, 6)
    poses = grasp.rest_pose + np.outer(times / 0.5, [0, 0, 3.0, 0, 0, 0])
    result = simulate_dynamics(model, grasp=grasp, poses=poses, times=times)
    assert not result.converged
    assert 1 <= len(result.times) < 6
    assert np.isfinite(result.displacement).all()
    assert "at (" in result.message


def test_motion_goes_on_from_its_last_state(mesh):
    """Two halves, the second from the first's last state, give what one run gives."""
    model = make_model(mesh, damping=RayleighDamping(0.5, 0.005))
    bent = solve_static(model, grasp=tip_of(mesh), grasp_force=[0.02, 0, 0]).require()
    times = np.linspace(0, 0.2, 21)
    settings = EnergyMomentumSettings(tolerance=1e-8)
    whole = simulate_dynamics(model, times=times, start=bent, settings=settings).require()
    first = simulate_dynamics(model, times=times[:11], start=bent, settings=settings).require()
    second = simulate_dynamics(model, times=times[10:], start=first.last,
                               settings=settings).require()
    assert second.displacement[-1] == pytest.approx(whole.displacement[-1], abs=1e-7)


def test_bad_input_is_refused(mesh):
    """Unordered times, poses without a grasp, wrong shapes, settings out of range."""
    model, grasp = make_model(mesh), tip_of(mesh)
    with pytest.raises(InputError, match="ascending"):
        simulate_dynamics(model, times=[0, 0.2, 0.1])
    with pytest.raises(InputError, match="grasp"):
        simulate_dynamics(model, times=[0, 0.1], poses=np.zeros((2, 6)))
    with pytest.raises(InputError, match="shape"):
        simulate_dynamics(model, grasp=grasp, times=[0, 0.1], poses=np.zeros((3, 6)))
    with pytest.raises(InputError, match="beta"):
        NewmarkSettings(beta=0.0)
