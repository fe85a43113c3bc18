"""Sampled grasp poses: where they lie, and that their energies and forces belong together."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests.planning.conftest import small_grasp_model

from limber.core.errors import Cancelled, WorkError
from limber.core.progress import Progress
from limber.mechanics import Grasp, solve_static
from limber.planning.field.chart import Chart
from limber.planning.field.energy_field import fit_field
from limber.planning.field.grasp_model import Reach
from limber.planning.field.other_modulus import with_modulus
from limber.planning.field.sampling import (
    LowEnergySurface,
    RodField,
    sample_field,
    sample_positions,
    solve_branch,
    walk_energy_surface,
)
from limber.planning.field.stored_states import States
from limber.stages.paths.energy import EnergySettings
from limber.store import Branch
from limber.store.loading import load_grasp_model

REACH = Reach(np.zeros(3), 0.4, 0.38, np.array([0.0, 0.0, 0.6]))
REST = np.array([0.0, 0.0, 0.38])
SHELL = LowEnergySurface(np.array([0.0, 0.0, 0.08]), 0.3)


def test_positions_stay_in_reach():
    """Within the deflection of rest, above the base, inside the shell."""
    points = sample_positions(REACH, REST, 200, SHELL, deflection=0.4, seed=3)
    assert points.shape == (200, 3)
    assert np.linalg.norm(points - REST, axis=1).max() <= 0.4 * 0.4
    away = np.linalg.norm(points - SHELL.pivot, axis=1)
    assert away.max() <= SHELL.radius + 1e-12
    assert points[:, 2].min() >= 0.0
    assert 0.4 < (away > 0.94 * SHELL.radius).mean() < 0.95, "half lie where gentle paths run"


def test_positions_follow_the_seed():
    """The same seed gives the same positions, another seed others; a longer run only adds."""
    def drawn(count, seed):
        return sample_positions(REACH, REST, count, SHELL, deflection=0.4, seed=seed)

    assert np.array_equal(drawn(50, 1), drawn(80, 1)[:50])
    assert not np.allclose(drawn(50, 1), drawn(50, 2))


def test_no_room_is_an_error():
    """A grasp at the base has nowhere to go, and the message says what to change."""
    with pytest.raises(WorkError, match="farther from its base"):
        sample_positions(Reach(np.zeros(3), 0.4, 0.38, REST), np.array([0, 0, -0.5]), 50,
                         LowEnergySurface(np.zeros(3), 0.5), deflection=0.4)


def sample_branch(model, targets, **options):
    """The full model's samples, and why others were refused."""
    good, bad = solve_branch(model, targets, **options)
    return States.of(model, [model.rest], sloped=True).joined(*(one.state for one in good)), bad


@pytest.fixture(scope="module")
def some(small_model):
    shell = LowEnergySurface(small_model.reach.base, small_model.reach.chord)
    targets = sample_positions(small_model.reach, small_model.rest_position, 14, shell,
                               deflection=0.3)
    return targets, *sample_branch(small_model, targets)


def test_samples_hold_what_was_asked(small_model, some):
    """Rest first with nothing stored; the others where they were sent, bent and not inverted."""
    targets, samples, reasons = some
    assert not reasons and len(samples.poses) == 15
    assert samples.energies[0] == 0.0 and not samples.forces[0].any()
    assert np.allclose(samples.positions[0], small_model.grasp.centre, atol=1e-9)
    assert np.allclose(samples.positions[1:], targets, atol=1e-7)
    assert (samples.energies[1:] > 0).all() and (samples.min_det_f > 0.5).all()


@pytest.mark.slow
def test_force_is_the_gradient_of_the_energy(small_model, some, small_mesh, small_skeleton):
    """Central differences of the solved energy give the gripper's force, with and without weight.

    Under weight that is the potential of strain and weight, not strain energy alone.
    """
    target = some[0][2]
    heavy = small_grasp_model(small_mesh, small_skeleton, (0.0, 0.0, -9.80665))
    for model in (small_model, heavy):
        here = model.follow(target[None], model.rest.displacement)[0]
        step, slope = 1e-4, np.zeros(3)
        for axis in range(3):
            moved = np.eye(3)[axis] * step
            there, back = (model.follow((target + s * moved)[None], here.displacement)[0]
                           for s in (1, -1))
            slope[axis] = (model.energy(there) - model.energy(back)) / (2 * step)
        assert np.allclose(slope, here.reaction_force, rtol=0,
                           atol=2e-3 * np.linalg.norm(here.reaction_force))
    assert abs(here.energy - here.strain_energy) > 1e-3, "the weight must matter here"


def test_firm_grasp_at_the_natural_rotation_costs_no_more(small_model, some):
    """A clamped gripper that turns as the sample says needs the pinned one's energy (2 %)."""
    firm = Grasp.from_mesh(small_model.mesh, mode="rigid")
    for target in some[0][:3]:
        loose = small_model.follow(target[None], small_model.rest.displacement)[0]
        held = solve_static(small_model.model, grasp=firm,
                            pose=small_model.pose(loose.displacement), start=loose.displacement)
        assert held.converged
        assert small_model.energy(held) == pytest.approx(small_model.energy(loose), rel=0.02)


@pytest.mark.slow
def test_states_with_another_modulus_are_those_of_the_full_model(small_mesh, small_skeleton):
    """Stiffer by a half at the base and softer at the tip, under weight: what is not solved is
    nearly what a solution gives."""
    before = small_grasp_model(small_mesh, small_skeleton, (0.0, 0.0, -9.80665))
    targets = sample_positions(
        before.reach, before.rest_position, 64,
        LowEnergySurface(before.reach.base, before.reach.chord), deflection=0.3)
    known = fit_field(sample_branch(before, targets)[0], before.reach.base)
    young = before.model.young * np.interp(small_mesh.centroids[:, 2], [0.0, 0.5], [1.5, 0.8])
    after = replace(before, branch=before.branch.with_young(young))
    found = with_modulus(known, before, after).samples
    guess = found.take(~found.solved)
    truth = sample_branch(after, guess.positions)[0].take(np.arange(1, 17))
    assert found.energies[0] == 0.0 and len(guess.poses) == 16 == len(found.poses) - 49
    np.testing.assert_allclose(guess.energies, truth.energies, rtol=0.01)
    np.testing.assert_allclose(guess.forces, truth.forces, atol=0.01 * truth.force_sizes.max())
    np.testing.assert_allclose(guess.tips, truth.tips, atol=1e-3)
    np.testing.assert_allclose(guess.strains, truth.strains, rtol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_cancel_ends_sampling(small_model, workers):
    """A cancel is obeyed between poses, in this process and across processes."""
    # So many that quick processes are not done before the cancel reaches them.
    targets = sample_positions(small_model.reach, small_model.rest_position, 200, LowEnergySurface(
        small_model.reach.base, small_model.reach.chord), deflection=0.3)
    progress = Progress(lambda fraction, _message, _numbers:
                        progress.cancel() if fraction > 0 else None)
    with pytest.raises(Cancelled):
        sample_branch(small_model, targets, workers=workers, progress=progress)


def test_grasp_moves_on_a_sphere_by_itself(small_model):
    """States under forces across lie on the shell within 0.3 mm, those drawn outward beyond it."""
    energy_surface, states = walk_energy_surface(small_model, 8, deflection=0.4)
    away = np.array([np.linalg.norm(state.places[-1] - energy_surface.pivot)
                     for state in states]) - energy_surface.radius
    assert len(states) == 17 and np.abs(away[:8]).max() < 3e-4
    assert (away[9:] > away[:8]).all()
    assert 0.6 < energy_surface.radius / small_model.reach.chord < 0.95


@pytest.mark.slow
def test_rest_lies_inside_the_sampled_region(small_model):
    """Samples lie beyond rest on all sides, and so do those of the shell about it."""
    sampled = sample_field(small_model, EnergySettings(samples=60))
    field = fit_field(sampled.samples, sampled.energy_surface.pivot, sampled.energy_surface.radius)
    assert sampled.samples.energies[0] == 0.0
    assert field.region.height(field.rest[None])[0] < -1e-4
    around = field.rest + 1e-4 * np.concatenate([np.eye(3), -np.eye(3)])
    assert field.region.contains(around).all()


def test_slopes_of_the_shape_are_those_of_differences(small_model, some):
    """Natural rotation and tip of states solved on both sides agree with the tangent's answer."""
    place, step = some[0][3], 1e-5
    here = small_model.follow(place[None], small_model.rest.displacement)[0].displacement
    slopes = small_model.shape_slopes(here)
    for axis in range(3):
        there, back = (small_model.shape(small_model.follow(
            (place + side * step * np.eye(3)[axis])[None], here)[0].displacement)
            for side in (1, -1))
        assert np.allclose((there - back) / (2 * step), slopes[axis], rtol=1e-3, atol=1e-4)


def test_chart_gradients_are_those_of_the_map():
    """Pulled back through the chart, a gradient is that of the composed function."""
    chart = replace(Chart.about(np.array([0.0, 0.01, -0.02]), 0.4, np.array([0.0, 0.02, 0.37])),
                    stretch=2.5, depth=0.01)
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (20, 3)) + [0, 0, 0.35]
    normal = np.array([0.3, -1.0, 0.6])
    gradient = np.tile(normal, (20, 1))
    step = 1e-6
    differences = np.stack(
        [(chart.map(points + step * axis) - chart.map(points - step * axis)) @ normal / (2 * step)
         for axis in np.eye(3)], axis=1)
    pulled = chart.pull_back(points, gradient)
    assert np.allclose(pulled, differences, atol=1e-7)
    assert np.allclose(chart.push_forward(points, pulled), gradient, atol=1e-9)


def test_weight_leaves_the_scan_as_the_rest_state(planned_branch, small_mesh):
    """With gravity the branch hangs at rest in the shape that was scanned, strained by its weight.
    """
    model = load_grasp_model(Branch.open(planned_branch), gravity=True,
                             progress=Progress(on_warning=pytest.fail))
    assert not model.rest.displacement.any() and model.energy(model.rest) == 0.0
    assert model.peak_load(model.rest.displacement)[0] > 1e-4, "the weight must matter here"
    assert np.allclose(model.rest_position, Grasp.from_mesh(small_mesh).centre, atol=1e-9)


# Neighbouring samples that do not agree: a branch that gives way to either side.

PLAIN = Chart.about(None, 0.0, np.zeros(3))
LENGTH = 0.4


class Bow:
    """A branch that stands straight above z = 0; pushed below, its tip goes to one side, +1 or -1,
    and stays there unless it is pulled straight or drawn over by more than ``hold`` [m]. A state
    is the side, and where the grasp is."""

    def __init__(self, hold):
        self.hold = hold
        self.reach = SimpleNamespace(arc_length=LENGTH)
        self.mesh = SimpleNamespace(nodes=np.zeros((1, 3)))
        self.branch = SimpleNamespace(target_positions=lambda _: np.empty((0, 3)))
        self.rod, self.rest = self, self.state(1.0, np.zeros(3))

    def tip(self, displacement):
        return displacement[0]

    def points(self, places):
        return places

    def state(self, side, place):
        tip = place + [side * np.sqrt(0.05 * max(-place[2], 0.0)), 0.0, 0.1]
        return SimpleNamespace(side=side, place=np.asarray(place), places=np.array([tip, place]))

    def followed(self, state, place):
        side, here = state.side, state.place
        for part in np.linspace(0.0, 1.0, 21)[1:]:
            now, before = here + part * (place - here), side
            if now[2] >= 0.0 or abs(now[0]) > self.hold:
                side = 1.0 if now[0] >= 0.0 else -1.0
            if side != before and now[2] < 0.0 and before:
                return None, part
        return self.state(side, place), 1.0

    def moved(self, state, _points):
        slopes = np.eye(3)[:, None]
        if state.place[2] < 0.0:
            slopes[2, 0, 0] = -state.side * 0.025 / np.sqrt(-0.05 * state.place[2])
        return state.places[:1], slopes

    def field(self, places):
        """What is known at places, each reached from above."""
        field = RodField(self)
        field.add([self.followed(self.state(0.0, np.array([p[0], p[1], 0.05])), p)[0]
                   for p in places])
        return field


@pytest.fixture
def bow():
    return Bow(0.02)


def places(count=60):
    generator = np.random.default_rng(1)
    return generator.uniform([-0.1, -0.05, -0.08], [0.1, 0.05, 0.04], (count, 3))


USUAL = places(500)


def test_where_it_may_go_either_way_is_refused_and_elsewhere_a_sample_more(bow):
    """Neighbours on both sides: places between them where both shapes stand are bistable; where
    the shape only changes fast there are new samples."""
    field = bow.field(places())
    begun = len(field.states)
    field.sample_between(PLAIN, USUAL, 60)
    added, bistable = field.states[begun:], field.bistable
    assert len(bistable) and len(added) and len(field.shapes) == len(field.states)
    assert (bistable[:, 2] < 0.0).all() and (np.abs(bistable[:, 0]) < 0.1).all()
    for place in bistable:
        shapes = [bow.state(side, place).places for side in (-1.0, 1.0)]
        assert np.abs(shapes[1] - shapes[0]).max() > 0.003 * LENGTH
    assert len(added) + len(bistable) <= 60
    field.sample_between(PLAIN, USUAL, 0)
    assert len(field.states) == begun + len(added)


def test_what_many_poses_lie_near_is_asked_first(bow):
    """Of two folds alike, that in the crowd comes first, and of a tetrahedron one pair a round."""
    field = bow.field(places())
    positions = field.positions
    lower, upper = (sign * USUAL[:, 1] > 0.01 for sign in (-1, 1))
    for crowd in (lower, upper):
        pairs = field.disagreeing(PLAIN, USUAL[crowd])
        first = np.mean([positions[[a, b], 1].mean() for a, b, _ in pairs[:8]])
        assert first * USUAL[crowd, 1].mean() > 0.0
        chosen = {pair for pair, _ in field._apart(pairs, PLAIN)}
        about = np.concatenate([tets for a, b, tets in pairs if (a, b) in chosen])
        assert 1 < len(chosen) < len(pairs) and len(about) == len(np.unique(about))


def test_what_agrees_is_asked_nothing(bow):
    """Above its rest the tip follows the grasp: no pair stands out."""
    field = bow.field(places() + [0.0, 0.0, 0.2])
    assert field.disagreeing(PLAIN, USUAL + [0.0, 0.0, 0.2]) == []
    begun = len(field.states)
    field.sample_between(PLAIN, USUAL, 60)
    assert len(field.states) == begun and field.bistable.shape == (0, 3)
