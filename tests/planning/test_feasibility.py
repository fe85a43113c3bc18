"""Narrow places: found or excluded by cells, and asked of the full model where the field errs."""

from dataclasses import replace

import numpy as np
import pytest

from limber.core.progress import Progress
from limber.planning import make_plan as planning
from limber.planning.baseline_and_plan import plan_within
from limber.planning.certificate.cells import Cells
from limber.planning.certificate.feasibility import judge
from limber.planning.constraints.limits import Limits
from limber.planning.cost import CostWeights, resample
from limber.planning.field.chart import Chart
from limber.planning.field.energy_field import EnergyField, fit_field
from limber.planning.field.stored_states import States
from limber.planning.goals.goal import grasp_goal
from limber.planning.goals.goal_kinds import default_goal
from limber.planning.make_plan import solved_if_undecided
from limber.planning.path_problem import BlockedError, GentleProblem
from limber.planning.planners.least_violation import easiest_path
from limber.planning.planners.refine import plan_gentle, refine
from limber.planning.settings import PlanSpec

RADIUS = 0.2  # [m] of the shell about the origin
ALONG, OFF = 20.0, 4e4  # [N/m] along the shell and off it: it yields a two thousandth as easily
GOAL = grasp_goal((0.06, 0.0, float(np.sqrt(RADIUS**2 - 0.06**2))), 0.004)


@pytest.fixture(scope="module")
def shell_field():
    """A stiff shell: a spring along it about the rest pose and a far stiffer one off it."""
    generator = np.random.default_rng(4)
    chart = Chart.about(np.zeros(3), RADIUS, np.array([0.0, 0.0, RADIUS]))
    flat = np.concatenate([np.zeros((1, 3)), generator.uniform(-0.1, 0.1, (250, 3))])
    flat[1:, 2] = 0.004 * generator.uniform(-1.0, 1.0, 250)
    points = chart.curved(flat)
    slope = flat * [ALONG, ALONG, OFF]
    nothing = np.zeros((len(points), 3))
    return fit_field(States(
        np.hstack([points, nothing]), 0.5 * (flat * slope).sum(axis=1),
        chart.pull_back(points, slope), 1.5 * points, np.ones(len(points)), np.empty((0, 6)),
        np.full(len(points), 0.01)), np.zeros(3), RADIUS)


def problem_on(field, **limits):
    """From rest to the goal, the field taken for the branch."""
    limited = field.limited(**limits)
    weights = CostWeights.between(field, field.rest, GOAL.centre(field), deformation=1.0,
                                  distance=1.5).weights
    return GentleProblem(field, limited, weights, field.rest.copy(), GOAL, sure=limited)


@pytest.mark.slow
def test_a_force_just_too_low_is_proven_and_one_just_enough_has_a_path(shell_field):
    """In a valley a twentieth of a millimetre wide, where the goal asks for a force near the limit;
    poses drawn in the goal say of neither that it can be kept."""
    held = np.linalg.norm(shell_field.force(GOAL.region.middle[None]))
    wide = problem_on(shell_field, max_force=1.05 * held)
    way = judge(wide).path
    assert way is not None and np.linalg.norm(way[-1] - GOAL.region.centre) <= GOAL.tolerance
    assert np.linalg.norm(shell_field.force(resample(way, 0.001)), axis=1).max() < 1.1 * held
    found = plan_gentle(wide, enough=1e6)
    assert found.cost == wide.cost(found.points) < np.inf
    none = problem_on(shell_field, max_force=0.8 * held)
    assert judge(none).proven
    with pytest.raises(BlockedError, match=r"No path exists.*proven on a grid"):
        plan_gentle(none)


@pytest.mark.slow
@pytest.mark.parametrize("share", [1.02, 1.2])
def test_a_chord_far_over_a_limit_is_refined_into_the_valley(shell_field, share):
    """From a chord of the shell with many times the force that is allowed: the path keeps the limit
    and is no dearer than from the easiest way."""
    start = shell_field.region.chart.plain.curved(np.array([[-0.03, 0.05, 0.0]]))[0]
    ends = np.stack([start, GOAL.region.centre])
    limit = share * np.linalg.norm(shell_field.force(ends), axis=1).max()
    problem = replace(problem_on(shell_field, max_force=limit), start=start)
    chord = resample(ends, 0.002)
    assert np.linalg.norm(shell_field.force(chord), axis=1).max() > 10.0 * limit
    path, cost = refine(chord, problem)
    easy = easiest_path(shell_field, problem.limits, start, GOAL)
    assert cost == problem.cost(path) <= 1.002 * refine(easy.points, problem)[1] < np.inf


@pytest.mark.slow
def test_the_easiest_way_goes_round_what_is_dearest(ridge_field):
    """Its worst force is less than the straight line's, and no more than a free path's; with a
    limit above it nothing is over."""
    start, goal = np.array([-0.06, -0.06, 0.0]), grasp_goal((0.1, 0.1, 0.0), 0.01)
    weights = CostWeights.between(ridge_field, start, goal.centre(ridge_field), deformation=1.0,
                                  distance=1.5).weights
    free = plan_gentle(GentleProblem(ridge_field, ridge_field.limited(), weights, start, goal),
                       enough=0.1).points
    line = start + np.linspace(0.0, 1.0, 100)[:, None] * (goal.centre(ridge_field) - start)
    limit = 2.0
    way = easiest_path(ridge_field, ridge_field.limited(max_force=limit), start, goal)

    def worst(points):
        return np.linalg.norm(ridge_field.force(resample(points, 0.001)), axis=1).max() / limit
    assert way.worst < 0.9 * worst(line) and way.worst < 1.03 * worst(free)
    assert np.linalg.norm(way.points[-1] - goal.region.centre) <= goal.tolerance


def test_a_level_is_the_least_at_which_cells_connect(ridge_field):
    """By brute force: at any level the first cell connects to those whose level is no higher."""
    cells = replace(Cells.over(ridge_field), numbers=np.argwhere(np.ones((4, 4, 4))))
    heights = np.random.default_rng(2).permutation(64) + 1.0
    found = cells.levels(heights, 5)
    for level in heights[heights >= heights[5]]:
        low = heights <= level
        together = cells.take(low).connected(np.flatnonzero(low) == 5)
        assert np.array_equal(found[low] <= level, together)


@pytest.fixture
def narrow(planned_branch):
    """The small branch's field, a goal on it, and the force that the goal takes."""
    field = EnergyField.read(planned_branch / "energy.npz")
    goal = default_goal(field, 0.01)
    return field, goal, float(np.linalg.norm(field.force(goal.region.middle[None]), axis=1)[0])


def test_poses_are_asked_where_the_fields_error_leaves_it_in_doubt(narrow, small_model):
    """Those of the way that comes nearest, by the full model; none where the limit is far off."""
    field, goal, held = narrow
    found = solved_if_undecided(field, small_model, field.rest, goal,
                                Limits(force=held * (1.0 + 1e-6)))
    assert 1 <= len(found.learnt.poses) <= 12 and "N, at (" in found.summary
    again = small_model.follow(found.learnt.poses[:1, :3], small_model.rest.displacement)[0]
    assert np.allclose(again.reaction_force, found.learnt.forces[0], rtol=1e-3, atol=1e-3 * held)
    assert solved_if_undecided(field, small_model, field.rest, goal,
                               Limits(force=0.1 * held)) is None


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_bound")
@pytest.mark.parametrize("blind", [1, 4])
def test_a_plan_that_a_wrong_field_excludes_is_made_with_more_poses(
        blind, narrow, small_model, monkeypatch):
    """Planned anew with what the full model says; after the stated number of times it is said that
    no path was found, and what the way that comes nearest takes."""
    field, goal, held = narrow
    counts = []

    def excluded(known, *arguments, **options):
        counts.append(len(known.samples.poses))
        if len(counts) <= blind:
            raise BlockedError("No path exists.", "Proven on a grid.", "Raise the limit.")
        return plan_within(known, *arguments, **options)

    monkeypatch.setattr(planning, "plan_within", excluded)
    warnings = []
    settings = PlanSpec(goal=goal.region.centre, goal_tolerance=goal.tolerance, iterations=300,
                            max_force=1.3 * held, inertia=False)
    monkeypatch.setattr(planning, "_REPLANS", 2)

    def made():
        return planning.plan_motion(field, small_model, settings,
                                    progress=Progress(on_warning=warnings.append))
    if blind == 1:
        found = made()
        assert np.linalg.norm(found.plan.solved.forces, axis=1).max() <= 1.3 * held
        assert counts[1] > counts[0] and "poses are added" in warnings[0]
    else:
        with pytest.raises(BlockedError,
                           match=r"No path exists.*poses were added .* of .* N, at \("):
            made()
        assert len(counts) <= 3
