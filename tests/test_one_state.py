"""One branch, one state, one force: the same pose through every door gives the same answer."""

from dataclasses import replace

import numpy as np
import pytest

from limber.core.progress import Progress
from limber.estimation.forward.solved_pull import QuasiStaticForward
from limber.estimation.settings import FitSpec, PullSpec
from limber.estimation.simulated_pull import TrueBranch, simulate_pull
from limber.geometry.tets.tet_mesh import mark
from limber.geometry.tets.tree_sweep import curved_beam
from limber.mechanics.pull_simulation import load_case_of, motion_of
from limber.mechanics.settings import SimulateSettings
from limber.recordings.recording import GraspEntry, PullEntry, grasp_on
from limber.recordings.synchronisation import frames_of
from limber.store import Branch
from limber.store.loading import load_branch, load_grasp_model, load_subject

MOVE = np.array([0.05, -0.03, -0.02])
GRAVITY = (0.0, -6.0, -7.76)
"""Of a branch that was turned upright."""
YOUNG = 6e7

REFUSING = Progress(on_warning=pytest.fail)
"""No door has anything to warn of."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory, small):
    """A sagging branch as `limber mesh` leaves it, with a flower on it."""
    skeleton = small.skeleton
    mesh = mark(curved_beam(skeleton.nodes, skeleton.radius, slice_length=5.0, sides=5), skeleton,
                young=YOUNG, poisson=0.35, density=900.0)
    folder = tmp_path_factory.mktemp("state") / "one.branch"
    with Branch.create(folder).stage("mesh", {"grasp_fraction": 2 / 3}) as stage:
        mesh.write(stage.path("mesh.vtu"))
        skeleton.write_swc(stage.path("skeleton.swc"))
        stage.path("targets.json").write_text(
            '{"format_version": 1, "targets": [{"name": "flower", "position_m": '
            f'{skeleton.nodes[-1].tolist()}, "mass_kg": 0.03}}]}}')
        stage.result["gravity_m_s2"] = GRAVITY
    return folder


@pytest.fixture(scope="module")
def expected(folder):
    """The loaded branch itself: pose, energy, force and where the flower is."""
    branch = Branch.open(folder)
    loaded = load_branch(branch, gravity=True, progress=REFUSING)
    grasp = loaded.marked_grasp("point")
    pose = grasp.rest_pose + np.r_[MOVE, np.zeros(3)]
    state = loaded.equilibrium(grasp, pose).require()
    return grasp, pose, state, loaded.target_positions(state.displacement)


def agree(energy, force, state):
    assert energy == pytest.approx(state.energy, rel=1e-4)
    np.testing.assert_allclose(force, state.reaction_force, rtol=1e-4,
                               atol=1e-5 * np.abs(state.reaction_force).max())


def test_weight_matters_here(folder, expected):
    """Without weight force and energy are others: doors that left it out would be found out."""
    grasp, pose, state, _ = expected
    bare = load_branch(Branch.open(folder), gravity=False, progress=REFUSING)
    light = bare.equilibrium(grasp, pose).require()
    assert abs(light.energy / state.energy - 1) > 0.01
    assert np.abs(light.reaction_force - state.reaction_force).max() > 0.01 * np.abs(
        state.reaction_force).max()


def test_simulate(folder, expected):
    """Along its whole way, at the end of it."""
    grasp, _, state, _ = expected
    settings = SimulateSettings(kind="static", move=tuple(MOVE), duration=3 / 60,
                                grasp_mode="point")
    loaded = load_branch(Branch.open(folder), gravity=True, progress=REFUSING)
    motion = motion_of(load_case_of(loaded.model, settings, None, grasp.centre), settings)
    assert motion.energy[0] == 0.0
    agree(motion.energy[-1], motion.grasp_force[-1], state)


def test_energy_and_plan(folder, expected):
    """The model of the energy field and of planned paths."""
    _, pose, state, _ = expected
    model = load_grasp_model(Branch.open(folder), gravity=True, progress=REFUSING)
    np.testing.assert_allclose(model.rest_position, pose[:3] - MOVE, atol=1e-12)
    found = model.follow(pose[None, :3], model.rest.displacement)[0]
    agree(model.energy(found), found.reaction_force, state)


def test_estimate_and_predict(folder, expected):
    """The forward of an estimate at the same pose; its state, under its own force, again."""
    grasp, pose, state, _ = expected
    subject = load_subject(Branch.open(folder), FitSpec())
    entry = PullEntry(grasp=GraspEntry(point_m=tuple(grasp.centre), radius_m=0.012, mode="point"))
    pull = _recorded(pose, state.reaction_force, entry)
    patch = replace(grasp)
    forward = QuasiStaticForward("one", subject.model, subject.weights, entry, frames_of(pull),
                                 grasp.centre[None])
    forward.grasp = patch
    forward.set_key_count(12)
    found = forward.simulate(subject.start, (), False)
    np.testing.assert_allclose(found.forces[-1], state.reaction_force, rtol=1e-4, atol=1e-5)
    moved = forward.displacements()[-1]
    assert np.abs(moved - state.displacement).max() < 1e-6


def _recorded(pose, force, entry):
    from limber.recordings.recording import Pull

    times = np.linspace(0.0, 1.0, 6)
    poses = np.array([pose - np.r_[(1 - t) * MOVE, np.zeros(3)] for t in times])
    wrenches = np.full((6, 6), np.nan)
    wrenches[:, :3] = times[:, None] * force
    return Pull("one", entry, times, poses, wrenches, None)


def test_virtual_pull(folder, expected):
    """A virtual pull of the same mesh: its measured wrench is the force at its measured pose."""
    branch = Branch.open(folder)
    subject = load_subject(branch, FitSpec())
    truth = TrueBranch(subject.mesh, subject.skeleton, subject.control_points,
                       (0.2, 0.4, 0.6, 0.8), subject.start.young, branch.gravity)
    settings = PullSpec(frames=4, position_noise=0.0, force_noise=0.0, reach=0.2,
                        poisson=0.35, density=900.0, phase=0.3)
    pull, moved = simulate_pull(truth, "virtual", settings)
    assert not pull.entry.weightless and pull.entry.gravity_m_s2 is None
    loaded = load_branch(branch, gravity=True, progress=REFUSING)
    bare = loaded.model.without_point_masses()  # the flower is not in the truth
    grasp = grasp_on(loaded.mesh, pull.entry.grasp)
    state = replace(loaded, model=bare).equilibrium(grasp, pull.poses[-1], start=moved[-1])
    np.testing.assert_allclose(pull.wrenches[-1, :3], state.require().reaction_force, rtol=1e-4,
                               atol=1e-5)


@pytest.mark.slow
def test_session(folder, expected):
    """A client of a session that answers with the full model."""
    from limber.session.client import InteractiveSession

    _, pose, state, flower = expected
    with InteractiveSession(folder, mode="point", reduced=False) as session:
        number = session.move(pose)
        frame = session.wait(number, 60.0)
        while frame is not None and not frame.is_reached:
            frame = session.latest()
        agree(frame.energy, frame.reaction_force, state)
        np.testing.assert_allclose(frame.targets, flower, atol=1e-6)
