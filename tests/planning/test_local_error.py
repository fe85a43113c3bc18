"""A field's error as a function of the place, and proofs that the full model is asked about."""

from dataclasses import replace

import numpy as np
import pytest

from limber.planning import make_plan
from limber.planning.certificate.feasibility import judge
from limber.planning.constraints.limits import SURELY, Limits
from limber.planning.cost import STEP, CostWeights, EdgeWeights
from limber.planning.field.energy_field import EnergyField, fit_field
from limber.planning.field.radial import LocalError
from limber.planning.goals.goal import TIP, Goal, allowed_points, grasp_goal
from limber.planning.goals.region import Ball
from limber.planning.make_plan import checked_wall, confirmed, not_confirmed
from limber.planning.path_problem import BlockedError, GentleProblem
from limber.planning.plan_file import read_plan
from limber.planning.planners.least_violation import LeastViolation

AT_REST = grasp_goal((0.0, 0.0, 0.0), 0.01)


def noisy(count, seed):
    """Places in a cube and misses there, ten times as large on its right as on its left."""
    generator = np.random.default_rng(seed)
    places = generator.uniform(size=(count, 3))
    return places, generator.normal(size=count) * np.where(places[:, 0] > 0.5, 1.0, 0.1)


def test_an_error_covers_fresh_places_and_follows_the_place():
    """Of fresh misses the share asked for, on both sides; less where samples are met better."""
    error = LocalError.of(*noisy(300, 1), 0.95)
    places, above = noisy(4000, 2)
    stated = error.at(places)
    assert 0.93 <= (above <= stated).mean() <= 0.98
    left, right = places[:, 0] < 0.4, places[:, 0] > 0.6
    assert np.median(stated[right]) > 4.0 * np.median(stated[left])
    assert LocalError.of(*noisy(300, 1), 1.0).factor > error.factor
    assert (LocalError.of(*noisy(300, 1), 1.0, most=0.3).at(places) <= 0.3).all()


def test_what_is_too_little_adds_nothing_and_too_few_samples_say_nothing():
    """Where a field says too little it closes nothing; of few samples the largest error counts."""
    places, above = noisy(300, 1)
    assert LocalError.of(places, -np.abs(above), 1.0).at(places).max() == 0.0
    few = LocalError.of(places[:5], above[:5], 0.95, most=2.0)
    assert (few.at(places) == 2.0).all()
    unknown = LocalError.of(places, np.full(300, np.nan), 0.95)
    assert (unknown.at(places) == np.inf).all()


@pytest.fixture(scope="module")
def half_rough(well):
    """A strain with a wall across x = 0, which no fit can score_unused where y is above 0."""
    samples = well.samples(count=200)
    generator = np.random.default_rng(1)
    x, y = samples.positions[:, 0], samples.positions[:, 1]
    rough = np.where(y > 0.0, 0.3, 0.003) * generator.uniform(-1.0, 1.0, len(x))
    return fit_field(replace(samples, strains=1.0 + 2.0 * np.exp(-(x / 0.08)**2) + rough))


def test_cells_close_by_the_error_of_their_place(half_rough):
    """A limit that the largest error anywhere would leave in doubt closes the smooth half."""
    start, goal = np.array([-0.12, -0.05, 0.0]), grasp_goal((0.12, -0.05, 0.0), 0.01)
    limits = Limits(strain=2.2)
    weights = CostWeights.between(half_rough, start, goal.region.middle, deformation=1.0,
                                  distance=1.5).weights
    problem = GentleProblem(half_rough, limits.on(half_rough), weights, start, goal,
                            sure=limits.on(half_rough, SURELY))
    points = half_rough.region.draw(500, np.random.default_rng(0))
    one, = problem.surely_limited()
    spare = one.largest - one.limit_at(points)
    smooth = points[:, 1] < -0.05
    assert spare[smooth].mean() > 2.0 * spare[points[:, 1] > 0.05].mean() >= 0.0
    error = limits.errors(half_rough)["strain"].at(half_rough.region.chart.plain.map(points))
    assert np.allclose(one.limit_at(points), 2.2 + error, rtol=1e-12)


def test_a_limit_in_doubt_is_extended_by_the_error_of_its_place(half_rough):
    """Poses over the limit by less than the field's error there are allowed, others are not."""
    limits = Limits(strain=2.2)
    points = half_rough.region.draw(3000, np.random.default_rng(0))
    over = np.abs(half_rough.load(points, "strain")) - 2.2
    error = limits.errors(half_rough)["strain"].at(half_rough.region.chart.plain.map(points))
    allowed = allowed_points(points, limits.on(half_rough, SURELY))
    trusted = half_rough.region.contains(points)
    assert np.array_equal(allowed, trusted & (over <= error))
    assert (allowed & (over > 0.0)).sum() > 20 < (trusted & ~allowed).sum()


@pytest.fixture(scope="module")
def apart(planned_branch):
    """The small branch's field, two gentle poses far from its samples, and the forces there."""
    field = EnergyField.read(planned_branch / "energy.npz")
    points = field.region.draw(2000, np.random.default_rng(0))
    away = np.linalg.norm(points[:, None] - field.samples.positions[None], axis=2).min(axis=1)
    points = points[away > 0.01]
    points = points[np.argsort(field.energy(points))]
    far = np.flatnonzero(np.linalg.norm(points - points[0], axis=1) > 0.03)[0]
    places = points[[0, far]]
    return field, places, np.linalg.norm(field.force(places), axis=1)


def test_a_wall_is_confirmed_by_the_full_model_or_refuted(apart, small_model, monkeypatch):
    """States over the limit confirm a proof; states that keep it, or that the field was farther
    above than its error, refute it and are learnt."""
    field, places, forces = apart
    monkeypatch.setattr(make_plan, "_STATES", 2)
    none = BlockedError("No path exists.", "Proven on a grid.", "").behind(places)
    low, high = Limits(force=0.3 * forces.min()), Limits(force=3.0 * forces.max())
    monkeypatch.setattr(Limits, "errors", lambda self, known: {})
    check = checked_wall(field, small_model, low, none, AT_REST)
    assert check.bears_out and check.learnt is None and check.solved == 2
    assert "2 states of the full model, where the way is closed, confirm it" in str(
        confirmed(none, check))
    refuted = checked_wall(field, small_model, high, none, AT_REST)
    assert not refuted.bears_out and len(refuted.learnt.poses) == 2
    again = small_model.follow(refuted.learnt.poses[:1, :3], small_model.rest.displacement)[0]
    assert np.allclose(again.reaction_force, refuted.learnt.forces[0], atol=1e-3 * forces.max())
    wrong = LocalError(np.zeros((1, 3)), np.zeros(1), 1.0, 0.0, -1.0)  # the field says too much
    monkeypatch.setattr(Limits, "errors", lambda self, known: {"force": wrong})
    assert checked_wall(field, small_model, low, none, AT_REST).learnt is not None
    assert checked_wall(field, small_model, low, BlockedError("No."), AT_REST).bears_out
    monkeypatch.setattr(make_plan, "solve_branch", lambda *_, **__: ([], []))
    unsolved = checked_wall(field, small_model, low, none, AT_REST)
    assert not unsolved.bears_out and unsolved.learnt is None


def test_a_target_out_of_reach_is_confirmed_by_the_full_model(apart, small_model, monkeypatch):
    """States near the goal confirm that the target stays outside it; one in it, or nearer than the
    field's error allows, refutes that. A state over a limit refutes nothing."""
    field, places, forces = apart
    monkeypatch.setattr(make_plan, "_STATES", 2)
    none = BlockedError("No path exists.", "Proven on a grid.", "").behind(
        np.empty((0, 3)), places[:1])
    tip = field.tip(places[:1])[0]
    off = float(field.place_errors(None, places[:1])[0])
    away = Goal(TIP, Ball(tuple(tip + [0.0, 0.0, 0.02 + 3.0 * off]), 0.01))
    check = checked_wall(field, small_model, Limits(), none, away)
    assert check.bears_out and check.solved == 1
    inside = Goal(TIP, Ball(tuple(tip), 0.01 + 3.0 * off))
    refuted = checked_wall(field, small_model, Limits(), none, inside)
    assert not refuted.bears_out and len(refuted.learnt.poses) == 1
    low = Limits(force=0.3 * forces.min())
    assert checked_wall(field, small_model, low, none, inside).bears_out
    monkeypatch.setattr(Goal, "uncertainty", lambda self, field, points: np.full(
        len(points), -1.0))
    assert not checked_wall(field, small_model, Limits(), none, away).bears_out


def test_a_proof_that_is_not_borne_out_is_none():
    """What is said then proves nothing, and names the limits."""
    said = not_confirmed(Limits(force=4.0), LeastViolation(np.zeros((2, 3)), 1.04))
    assert not said.is_proven and "force 4 N" in said.seen and "104 % of a limit" in said.why
    assert "easiest" not in not_confirmed(Limits(force=4.0), None).why
    assert BlockedError("No path exists.", "Proven.", "").is_proven


def test_a_plan_keeps_off_a_limit_by_the_error_of_the_place(half_rough):
    """What compiled loops allow is the field below its limit less the share of the error there; of
    an old field, whose error is not known, less the most that margins are."""
    limits, chart = Limits(strain=2.2), half_rough.region.chart.plain
    points = half_rough.region.draw(800, np.random.default_rng(3))
    strain = np.abs(half_rough.load(points, "strain"))
    places, inner = chart.map(half_rough.samples.positions), ~half_rough.region.is_face()
    error = LocalError.of(places[inner], -limits.above(half_rough)["strain"][inner], 0.95,
                          0.3 * 2.2).at(chart.map(points))
    assert np.ptp(error) > 0.1
    for share in (0.0, 0.5, 1.0):
        allowed = allowed_points(points, limits.on(half_rough, share))
        assert np.array_equal(allowed, strain <= 2.2 - share * error)
    old = replace(half_rough, missed=np.full_like(half_rough.missed, np.nan))
    assert np.array_equal(allowed_points(points, limits.on(old, 1.0)), strain <= 0.7 * 2.2)
    force = Limits(force=1.0, energy=0.05).on(half_rough, 1.0)
    kept = points[allowed_points(points, force)]
    assert len(kept) and np.linalg.norm(half_rough.force(kept), axis=1).max() < 1.0


def test_a_proof_tells_where_the_way_is_closed(half_rough):
    """The wall lies between start and goal, and is over the limit there."""
    start, goal = np.array([-0.12, 0.0, 0.0]), grasp_goal((0.12, 0.0, 0.0), 0.01)
    limits = Limits(strain=1.5)
    weights = CostWeights.between(half_rough, start, goal.region.middle, deformation=1.0,
                                  distance=1.5).weights
    found = judge(GentleProblem(half_rough, limits.on(half_rough), weights, start, goal,
                                sure=limits.on(half_rough, SURELY)))
    assert found.proven and len(found.wall) > 20
    assert (np.abs(found.wall[:, 0]) < 0.1).all()
    assert half_rough.load(found.wall, "strain").min() > 1.5


@pytest.mark.parametrize("name", ["strain", "force", "energy", "axial_force"])
def test_a_limit_that_a_known_path_keeps_is_never_proven_impossible(planned_branch, name):
    """The path's own peak on the full model as the limit, on a field of few samples: whatever the
    field says of it, there is a path."""
    field = EnergyField.read(planned_branch / "energy.npz")
    way = read_plan(planned_branch / "plans/there.json").plan
    peaks = {"strain": way.strains, "force": way.force_sizes, "energy": way.energies,
             "axial_force": np.abs(way.axial_forces)}
    limits = Limits(**{name: (1.0 + 1e-6) * float(peaks[name].max())})
    start, end = way.poses[[0, -1], :3]
    goal = grasp_goal(tuple(map(float, end)), 0.005)
    found = judge(GentleProblem(field, limits.on(field), EdgeWeights(0.0, 1.0, STEP), start, goal,
                                sure=limits.on(field, SURELY)))
    assert not found.proven
