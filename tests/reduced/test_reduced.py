"""The reduced model: exact on its subspace, linear in Young's modulus, near the full model."""

from dataclasses import replace

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.tets.tree_sweep import straight_beam
from limber.mechanics import BranchModel, Grasp, solve_static, young_weights
from limber.reduced.basis import GraspCoordinates, gradient_metric
from limber.reduced.model_cache import (
    as_control_points,
    build_reduced,
    read_model,
    reduce_snapshots,
    write_model,
)
from limber.reduced.reduced_model import ReducedModel, ReducedSettings, ReducedStaticSettings
from limber.reduced.training import TrainingSettings

YOUNG = np.array([1.2e8, 0.8e8])
TRAINING = TrainingSettings(grasp_count=28, young_spread=3.0, vibration_every=10, vibration_count=3)


@pytest.fixture(scope="module")
def model() -> BranchModel:
    """A beam of 20 cm that tapers, 180 quadratic tetrahedra, two control points, gravity."""
    mesh = straight_beam(0.2, 0.004, 0.003, slice_count=10, grasp_fraction=0.7)
    weights = young_weights(mesh, np.array([[0, 0, 0.06], [0, 0, 0.14]]))
    return BranchModel(mesh, young=weights @ YOUNG, poisson=0.35, density=900.0)


@pytest.fixture(scope="module")
def weights(model) -> np.ndarray:
    """From the control points to the tetrahedra."""
    return young_weights(model.mesh, np.array([[0, 0, 0.06], [0, 0, 0.14]]))


@pytest.fixture(scope="module")
def grasp(model) -> Grasp:
    """The patch, pinned."""
    return Grasp.from_mesh(model.mesh, "point")


@pytest.fixture(scope="module")
def trained(model, grasp, weights):
    """A reduced model of 40 coordinates and what it was made of."""
    settings = ReducedSettings(size=40, vibration_count=3, field_count=75, training=TRAINING)
    return build_reduced(model, grasp, weights, YOUNG, settings)


@pytest.fixture(scope="module")
def exact(model, grasp, weights, trained) -> ReducedModel:
    """The same with 18 coordinates and all strain fields."""
    settings = ReducedSettings(size=18, vibration_count=0, field_count=None, training=TRAINING)
    return reduce_snapshots(model, grasp, weights, YOUNG, trained[1], settings)


def random_coordinates(reduced: ReducedModel, seed: int = 0) -> np.ndarray:
    """Coordinates as large as the training's."""
    largest = np.abs(reduced.basis.states).max(axis=0)
    return largest * np.random.default_rng(seed).uniform(-1, 1, reduced.size)


def test_unprojected_energy_and_force_are_the_full_models(model, exact):
    """On the subspace energy and force agree with the full model's to round-off."""
    for seed in range(3):
        q = random_coordinates(exact, seed)
        energy, force = exact.energy_force(q)
        full = model.internal(exact.displacement_of(q))
        projected = np.tensordot(exact.basis.columns, full.force, 2)
        assert energy == pytest.approx(full.strain_energy, rel=1e-10)
        np.testing.assert_allclose(force, projected, atol=1e-10 * np.abs(projected).max())


def test_unprojected_model_agrees_at_other_moduli(model, exact, weights):
    """It does so at any Young's modulus and Poisson's ratio, from the same coefficients."""
    young, q = YOUNG * [3.0, 0.4], random_coordinates(exact)
    full = model.with_parameters(young=weights @ young, poisson=0.2).internal(
        exact.displacement_of(q))
    energy, _ = exact.with_young(young, poisson=0.2).energy_force(q)
    assert energy == pytest.approx(full.strain_energy, rel=1e-10)


def test_energy_is_linear_in_each_youngs_modulus(trained):
    """Also projected: energies of two distributions add up to that of their sum."""
    reduced, _ = trained
    q, other = random_coordinates(reduced), np.array([0.3e8, 2e8])
    parts = [reduced.with_young(y).strain_energy(q) for y in (YOUNG, other, YOUNG + other)]
    assert parts[0] + parts[1] == pytest.approx(parts[2], rel=1e-12)


def test_force_and_tangent_are_derivatives(trained):
    """Central differences of energy and force give force and tangent, 1e-6 relative."""
    reduced, _ = trained
    q = reduced.basis.states[3]
    direction = np.random.default_rng(1).normal(size=reduced.size) * 1e-8
    _, force = reduced.energy_force(q)
    _, _, lower = reduced.tangent(q)
    tangent = lower + np.tril(lower, -1).T
    ahead, behind = reduced.energy_force(q + direction), reduced.energy_force(q - direction)
    assert ahead[0] - behind[0] == pytest.approx(2 * force @ direction, rel=1e-5)
    np.testing.assert_allclose((ahead[1] - behind[1]) / 2, tangent @ direction,
                               atol=1e-6 * np.abs(tangent @ direction).max())


def test_the_grasp_follows_the_pose_exactly(model):
    """Clamped and pinned: the patch (or its mean) is where the pose puts it, whatever y is."""
    from limber.reduced.basis import make_basis
    from limber.reduced.training import Trainer, sample_poses, sample_young

    weights, young = as_control_points(model)
    for mode in ("rigid", "point"):
        grasp = Grasp.from_mesh(model.mesh, mode)
        rng = np.random.default_rng(5)
        poses = sample_poses(model, grasp, 6, rng, TRAINING)
        trainer = Trainer(model, grasp, weights, young)
        snapshots = trainer.take(poses, sample_young(young, 6, rng, 1.0))
        basis = make_basis(model, grasp, snapshots, 26)
        held = GraspCoordinates(grasp)
        pose = grasp.rest_pose + [0.01, -0.02, -0.004, 0.1, 0.2, -0.1]
        q = np.concatenate([held.at(pose), rng.normal(size=26 - held.count)])
        moved = np.tensordot(q, basis.columns, 1)[grasp.nodes]
        if mode == "rigid":
            np.testing.assert_allclose(moved, grasp.displacement(model.mesh.nodes, pose), atol=1e-9)
        else:
            np.testing.assert_allclose(grasp.weights @ moved, pose[:3] - grasp.centre, atol=1e-9)
        modes = basis.columns[held.count:].reshape(26 - held.count, -1, 3)
        metric = gradient_metric(model)
        gram = np.einsum("ink,jnk->ij", modes, [metric @ mode for mode in modes])
        np.testing.assert_allclose(gram, np.eye(len(modes)), atol=1e-6)


def test_training_states_come_back(trained):
    """At the training poses and moduli the reduced equilibria are the full ones."""
    reduced, snapshots = trained
    off = []
    for pose, young, energy, displacement in zip(
            snapshots.poses, snapshots.young, snapshots.energy, snapshots.displacement,
            strict=True):
        state = reduced.with_young(young).solve_static(pose)
        assert state.converged and state.trusted
        assert state.strain_energy == pytest.approx(energy, rel=2e-3)
        off.append(np.abs(reduced.displacement(state) - displacement).max() / 0.2)
    assert np.median(off) < 0.001
    # A strongly pushed-in branch is soft: small errors of force move its free end.
    assert max(off) < 0.02


def test_held_out_grasps_at_another_modulus(model, grasp, weights, trained):
    """Between the training grasps and moduli: energy and force within 2 %, positions 1 %."""
    reduced, _ = trained
    young = YOUNG * [2.5, 0.6]
    for move in ([0.03, 0.01, -0.01], [-0.02, 0.03, -0.012]):
        pose = grasp.rest_pose + [*move, 0, 0, 0]
        full = solve_static(model.with_young(weights @ young), grasp=grasp, pose=pose).require()
        state = reduced.with_young(young).solve_static(pose)
        assert state.strain_energy == pytest.approx(full.strain_energy, rel=0.02)
        assert np.linalg.norm(state.reaction_force - full.reaction_force) < 0.03 * np.linalg.norm(
            full.reaction_force)
        assert np.abs(reduced.displacement(state) - full.displacement).max() < 0.01 * 0.2


def test_projection_beats_plain_galerkin(model, grasp, weights, trained):
    """With the same coordinates, strains of true solutions only are nearer than all strains."""
    _, snapshots = trained
    few = {"size": 18, "vibration_count": 0, "training": TRAINING}
    plain = reduce_snapshots(model, grasp, weights, YOUNG, snapshots,
                             ReducedSettings(field_count=None, **few))
    projected = reduce_snapshots(model, grasp, weights, YOUNG, snapshots,
                                 ReducedSettings(field_count=40, **few))
    errors = []
    for candidate in (plain, projected):
        off = [candidate.with_young(y).solve_static(p).strain_energy / e - 1
               for p, y, e in zip(snapshots.poses, snapshots.young, snapshots.energy, strict=True)]
        errors.append(np.median(np.abs(off)))
    assert errors[1] < 0.7 * errors[0]


def test_reaction_is_the_energys_derivative(trained, grasp):
    """Force times motion of the gripper is the change of energy, gravity included."""
    reduced, _ = trained
    pose, step = grasp.rest_pose + [0.02, 0.01, -0.006, 0, 0, 0], 1e-5
    state = reduced.solve_static(pose)
    for axis in range(3):
        potential = []
        for sign in (1, -1):
            moved = pose.copy()
            moved[axis] += sign * step
            other = reduced.solve_static(moved, start=state)
            potential.append(other.strain_energy - reduced.load @ other.coordinates)
        slope = (potential[0] - potential[1]) / (2 * step)
        assert slope == pytest.approx(state.reaction_force[axis],
                                      abs=1e-4 * np.linalg.norm(state.reaction_force))


def test_sensitivities_are_derivatives(trained, grasp):
    """Derivatives to log Young's modulus agree with differences of two equilibria."""
    reduced, _ = trained
    pose, step = grasp.rest_pose + [0.02, -0.015, -0.006, 0, 0, 0], 1e-4
    state = reduced.solve_static(pose)
    found = reduced.sensitivities(state)
    for k in range(2):
        ends = []
        for sign in (1, -1):
            young = YOUNG * np.exp(sign * step * np.eye(2)[k])
            ends.append(reduced.with_young(young).solve_static(pose, start=state))
        change = (ends[0].coordinates - ends[1].coordinates) / (2 * step)
        np.testing.assert_allclose(found.coordinates[:, k], change,
                                   atol=1e-3 * np.abs(change).max())
        force = (ends[0].reaction_force - ends[1].reaction_force) / (2 * step)
        np.testing.assert_allclose(found.reaction_force[:, k], force,
                                   atol=1e-3 * np.abs(force).max())
        energy = (ends[0].strain_energy - ends[1].strain_energy) / (2 * step)
        assert found.strain_energy[k] == pytest.approx(energy, rel=1e-3)


def test_nodal_forces_act(model, grasp, trained):
    """Dead loads like those of the training (twenty times the weight) act as in the full model."""
    reduced, _ = trained
    forces = 20 * model.weight_force
    pose = grasp.rest_pose + [0.02, 0.01, -0.008, 0, 0, 0]
    full = solve_static(model, grasp=grasp, pose=pose, nodal_forces=forces).require()
    bare = solve_static(model, grasp=grasp, pose=pose).require()
    state = reduced.solve_static(pose, nodal_forces=forces)
    effect = full.reaction_force - bare.reaction_force
    found = state.reaction_force - reduced.solve_static(pose).reaction_force
    assert np.linalg.norm(effect) > 0.3 * np.linalg.norm(forces.sum(axis=0))
    assert np.linalg.norm(found - effect) < 0.05 * np.linalg.norm(effect)


def test_what_lies_outside_is_not_trusted(trained, grasp):
    """Neither is a pose far off, nor a modulus far off."""
    reduced, _ = trained
    far = reduced.solve_static(grasp.rest_pose + [0.0, 0.0, 0.1, 0, 0, 0])
    assert not far.trusted
    soft = reduced.with_young(YOUNG / 20).solve_static(grasp.rest_pose + [0.01, 0, 0, 0, 0, 0])
    assert not soft.trusted


def test_a_search_ends_with_its_iterations(trained, grasp):
    """A state beyond the training is sought from other starts too; cut short, the first counts."""
    reduced, _ = trained
    pose = grasp.rest_pose + [0.02, 0.01, 0.0, 0, 0, 0]
    doubted = ReducedStaticSettings(novelty_limit=0.5 * reduced.solve_static(pose).novelty)
    first = reduced.solve_static(pose, settings=replace(doubted, start_count=1))
    assert first.converged
    assert reduced.solve_static(pose, settings=doubted).iterations > first.iterations
    short = reduced.solve_static(pose, settings=replace(doubted, iteration_limit=first.iterations))
    assert short.converged and short.iterations == first.iterations
    assert np.array_equal(short.coordinates, first.coordinates)
    shorter = reduced.solve_static(
        pose, settings=replace(doubted, iteration_limit=first.iterations - 1))
    assert not shorter.converged and shorter.iterations == first.iterations - 1


@pytest.mark.slow
def test_file_holds_the_model(trained, grasp, tmp_path):
    """Written and read again it gives the same answer; another file is refused."""
    reduced, _ = trained
    pose = grasp.rest_pose + [0.02, 0.0, -0.004, 0, 0, 0]
    write_model(reduced, tmp_path / "model.npz")
    again = read_model(tmp_path / "model.npz").solve_static(pose)
    assert again.strain_energy == reduced.solve_static(pose).strain_energy
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    with pytest.raises(InputError, match="format"):
        read_model(tmp_path / "other.npz")


def test_other_materials_are_refused(model, grasp, weights, trained):
    """Only StVK's force is a polynomial: others are an error, not a wrong answer."""
    neo = BranchModel(model.mesh, young=weights @ YOUNG, poisson=0.35, density=900.0,
                      material="stable_neo_hookean")
    with pytest.raises(InputError, match="cubic"):
        reduce_snapshots(neo, grasp, weights, YOUNG, trained[1],
                         ReducedSettings(size=20, vibration_count=0, field_count=40))
