"""The reduced model in time, its measured error, and how it learns."""

import numpy as np
import pytest

from benchmarks.mechanics_reduced import simulate_reduced
from limber.core.errors import InputError
from limber.geometry.tets.tree_sweep import straight_beam
from limber.mechanics import BranchModel, Grasp, RayleighDamping, solve_static
from limber.mechanics.dynamics.integration import NewmarkSettings, simulate_dynamics
from limber.reduced.model_cache import build_reduced
from limber.reduced.reduced_model import ReducedSettings, ReducedStepper
from limber.reduced.refresh import RefreshingModel, estimate_error
from limber.reduced.training import Snapshots, TrainingSettings

YOUNG = np.array([1e8])
SETTINGS = ReducedSettings(size=40, vibration_count=6, field_count=80, training=TrainingSettings(
    grasp_count=24, young_spread=1.0, vibration_every=4, vibration_count=4))


@pytest.fixture(scope="module")
def model() -> BranchModel:
    """A beam of 20 cm, 180 quadratic tetrahedra, no gravity."""
    mesh = straight_beam(0.2, 0.004, 0.003, slice_count=10, grasp_fraction=0.7)
    return BranchModel(mesh, young=1e8, poisson=0.35, density=900.0, gravity=None,
                       damping=RayleighDamping(mass=0.5, stiffness=0.002))


@pytest.fixture(scope="module")
def grasp(model) -> Grasp:
    """The patch, pinned."""
    return Grasp.from_mesh(model.mesh, "point")


@pytest.fixture(scope="module")
def trained(model, grasp):
    """A reduced model and what it was made of; one region."""
    return build_reduced(model, grasp, np.ones((model.mesh.tet_count, 1)), YOUNG, SETTINGS)


def pull(grasp, move, count, seconds=0.4):
    """Times and poses of a smooth pull."""
    times = np.linspace(0, seconds, count)
    part = (1 - np.cos(np.pi * np.clip(2 * times / seconds, 0, 1))) / 2
    return times, grasp.rest_pose + part[:, None] * np.array([*move, 0, 0, 0])


def test_motion_agrees_with_the_full_model(model, grasp, trained):
    """A pull in 0.2 s: positions within 1 % of the length, energy 3 %, force 5 %."""
    times, poses = pull(grasp, [0.03, 0.015, -0.01], 25)
    full = simulate_dynamics(model, grasp=grasp, poses=poses, times=times).require()
    reduced = trained[0]
    motion = simulate_reduced(reduced, poses=poses, times=times)
    assert motion.converged, motion.message
    off = [np.abs(reduced.displacement_of(q) - u).max()
           for q, u in zip(motion.coordinates, full.displacement, strict=True)]
    assert max(off) < 0.01 * 0.2
    assert np.abs(motion.strain_energy - full.strain_energy).max() < 0.03 * full.strain_energy.max()
    # Pushed in along its axis the beam buckles within one step: that instant is left out.
    wrong = np.sort(np.abs(motion.reaction_force - full.reaction_force).max(axis=1))[:-1]
    assert wrong.max() < 0.05 * np.abs(full.reaction_force).max()


@pytest.mark.slow
def test_second_order_in_the_step(grasp, trained):
    """Halving the step quarters the error (a bent branch on, so that nothing buckles)."""
    reduced, ends = trained[0], []
    times, poses = pull(grasp, [-0.01, 0.02, 0.0], 9)
    poses = poses + np.array([0.03, 0, -0.012, 0, 0, 0])
    for step in (0.0025, 0.0003125, 0.000078125):
        settings = NewmarkSettings(max_step=step, tolerance=1e-9)
        ends.append(simulate_reduced(reduced, poses=poses, times=times, settings=settings))
    # All frames: at a single instant an error may happen to cross zero.
    paths = [np.array([reduced.displacement_of(q) for q in run.coordinates]) for run in ends]
    errors = [np.linalg.norm(path - paths[-1]) for path in paths[:-1]]
    # Over three halvings: free ends that vibrate quickly are resolved by the finer steps alone.
    assert np.log2(errors[0] / errors[1]) / 3 == pytest.approx(2.0, abs=0.3)


def test_motion_comes_to_the_static_state(grasp, trained):
    """Held long enough the moving branch is where the static one is."""
    reduced = trained[0]
    times, poses = pull(grasp, [0.02, 0.01, -0.005], 25)
    start = simulate_reduced(reduced, poses=poses, times=times).last
    stepper = ReducedStepper(reduced, start)
    for _ in range(400):
        assert stepper.move(poses[-1], 1 / 60)
    static = reduced.solve_static(poses[-1])
    off = reduced.displacement_of(stepper.state.coordinates - static.coordinates)
    assert np.abs(off).max() < 2e-5
    assert stepper.reaction(poses[-1])[0] == pytest.approx(static.reaction_force, abs=2e-3)


def test_times_that_do_not_ascend_are_refused(grasp, trained):
    """Frames need later and later times."""
    with pytest.raises(InputError, match="ascend"):
        simulate_reduced(trained[0], poses=np.repeat(grasp.rest_pose[None], 3, axis=0),
                         times=np.array([0, 0.2, 0.1]))


def test_measured_error_is_the_error(model, grasp, trained):
    """The estimate by corrections agrees with the full solution, where the error is large."""
    from dataclasses import replace

    from limber.reduced.model_cache import reduce_snapshots

    few = replace(SETTINGS, size=20, vibration_count=0, field_count=36)
    weights = np.ones((model.mesh.tet_count, 1))
    rough = reduce_snapshots(model, grasp, weights, YOUNG, trained[1], few)
    for move in ([0.03, 0.01, -0.01], [-0.01, 0.04, -0.012]):
        pose = grasp.rest_pose + [*move, 0, 0, 0]
        state = rough.solve_static(pose)
        full = solve_static(model, grasp=grasp, pose=pose).require()
        true = np.linalg.norm(rough.displacement(state) - full.displacement, axis=1).max()
        estimate = estimate_error(model, weights, rough, state)
        assert estimate.certain
        assert estimate.position * model.extent == pytest.approx(true, rel=0.3)
        assert estimate.energy == pytest.approx(state.strain_energy / full.strain_energy - 1,
                                                abs=0.002)
        # The reduced model trusts itself where it is off; the check does not.
        assert state.trusted and not replace(estimate, energy=0.01).is_small
        assert replace(estimate, position=0.004, energy=-0.008).is_small


@pytest.mark.slow
def test_it_learns_what_it_did_not_know(model, grasp):
    """Trained on small grasps, large ones are found wrong, solved, and in the next basis."""
    small = TrainingSettings(grasp_count=16, young_spread=1.0, reach=0.1, vibration_every=8,
                             vibration_count=2)
    settings = ReducedSettings(size=26, vibration_count=0, field_count=50, training=small)
    weights = np.ones((model.mesh.tet_count, 1))
    learner = RefreshingModel(model, grasp, weights, settings, *build_reduced(
        model, grasp, weights, YOUNG, settings), refresh_every=3)
    poses = grasp.rest_pose + np.array([[0.06, 0.0, -0.02, 0, 0, 0], [0.062, 0.004, -0.02, 0, 0, 0],
                                        [0.06, -0.006, -0.023, 0, 0, 0]])
    full = solve_static(model, grasp=grasp, pose=poses[0]).require()
    energies = []
    for pose in poses:
        state = learner.reduced.solve_static(pose)
        estimate = learner.check(state)
        assert not (state.converged and estimate.is_small)
        energies.append(learner.learn(pose, YOUNG, estimate).require().strain_energy)
    assert energies[0] == pytest.approx(full.strain_energy, rel=1e-5)
    assert learner.refresh_count == 1
    again = learner.reduced.solve_static(poses[0])
    assert again.converged and learner.check(again).is_small
    assert again.strain_energy == pytest.approx(full.strain_energy, rel=0.01)


def test_snapshots_go_through_plain_arrays(trained):
    """What a file holds makes the same snapshots."""
    arrays = trained[1].arrays()
    again = Snapshots.from_arrays(arrays)
    assert len(again) == len(trained[1])
    np.testing.assert_array_equal(again.pose_tangents, trained[1].pose_tangents)
