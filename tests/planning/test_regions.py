"""Regions that a place on the branch may be brought into, and goals in them."""

from dataclasses import replace

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.planning.baseline_and_plan import plan_pair
from limber.planning.constraints.limits import Limits
from limber.planning.field.energy_field import fit_field
from limber.planning.goals.goal import TIP, Goal, GoalRequest, Point, goal_points
from limber.planning.goals.goal_kinds import default_goal, goal_of, second_arm_goal, tip_goal
from limber.planning.goals.region import Ball, BoxRegion, View
from limber.planning.path_problem import random_start
from limber.planning.settings import PlanSpec

# A camera a metre along x that looks back at the origin; its picture is 0.6 m wide there.
BACK = np.array([[0, 0, -1, 1], [1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], float)
VIEW = View(BACK, (-0.3, 0.3, -0.2, 0.2), (0.5, 1.5))
BOX = BoxRegion((0.0, 0.0, 0.0), (0.2, 0.1, 0.4))


@pytest.mark.parametrize("region", [Ball((0.1, 0.0, 0.2), 0.05), BOX, VIEW])
def test_distances_bound_the_way_out(region):
    """Drawn points are inside; the middle is the region's depth inside; a step changes a distance
    by its length at most."""
    generator = np.random.default_rng(3)
    drawn = region.draw(300, generator)
    assert region.distance(drawn).max() <= 1e-12
    assert region.distance(region.middle[None])[0] == pytest.approx(-region.depth)
    points = region.middle + generator.normal(size=(300, 3))
    moved = points + 0.1 * generator.normal(size=(300, 3))
    change = np.abs(region.distance(points) - region.distance(moved))
    assert (change <= np.linalg.norm(points - moved, axis=1) + 1e-12).all()


def test_a_view_ends_at_its_picture_and_its_range():
    """Points on its borders, from the camera's own description."""
    ahead = [[0.5, 0, 0], [-0.5, 0, 0], [0, 0.3, 0], [0, 0, 0.2], [0, 0, 0]]
    assert VIEW.distance(np.array(ahead)) == pytest.approx([0, 0, 0, 0, -0.2 / np.hypot(1, 0.2)],
                                                           abs=1e-12)
    assert VIEW.distance(np.array([[0, 0.31, 0], [0, 0, -0.21], [0.6, 0, 0]])).min() > 0.0


def test_a_surface_hides_what_is_behind_it():
    """A triangle between; one behind the target, one beside the line and the target's own skin do
    not hide it."""
    wall = np.array([[[0.3, -1, -1], [0.3, 1, -1], [0.3, 0, 1]]], float)
    place = np.zeros(3)
    assert VIEW.hidden_by(wall, place, 0.003)
    for shift in ([-0.5, 0, 0], [0, 2, 0], [-0.299, 0, 0]):
        assert not VIEW.hidden_by(wall + shift, place, 0.003)


def test_a_named_target_is_brought_into_a_box(ridge):
    """Goal poses put that target, and not the tip, into the box by the field."""
    samples = ridge.samples(count=80)
    flower = 2.0 * samples.positions + [0.0, 0.1, 0.2]
    field = fit_field(replace(samples, targets=flower[:, None]))
    box = BoxRegion((0.1, 0.0, 0.1), (0.2, 0.15, 0.3))
    points = goal_points(Goal(Point("flower", 0), box), field, field.limited())
    found = 2.0 * points + [0.0, 0.1, 0.2]
    assert len(points) > 20 and box.distance(found).max() < 2e-3
    assert box.distance(1.5 * points + [0.0, 0.0, 0.3]).max() > 0.01


def test_a_region_larger_than_what_was_sampled_has_goal_poses(ridge_field):
    """A ball that holds many sampled poses and none deep inside, as a second arm's reach is."""
    goal = Goal(TIP, Ball((0.0, 0.7, 0.3), 0.65))
    everywhere = ridge_field.region.draw(2000, np.random.default_rng(0))
    inside = goal.excess(ridge_field, everywhere) <= 0.0
    assert 0.3 < inside.mean() < 0.8
    points = goal_points(goal, ridge_field, ridge_field.limited())
    assert len(points) == 200
    assert goal.excess(ridge_field, points).max() <= 0.0
    assert np.ptp(points, axis=0).min() > 0.5 * np.ptp(everywhere[inside], axis=0).min()
    assert ridge_field.region.contains(goal.centre(ridge_field)[None])[0]


def test_a_start_in_the_goal_stays_there(ridge_field):
    """Both paths have no length, and no path costs less."""
    goal = Goal(TIP, Ball((0.0, 0.7, 0.3), 0.65))
    start = np.array([0.0, 0.1, 0.0])
    found = plan_pair(ridge_field, start, goal, PlanSpec())
    assert found.stays and found.certificate.gap == 0.0
    for path in (found.plan, found.baseline):
        assert np.array_equal(path.points, [start, start])
    assert np.allclose(found.approach[[0, -1]], [ridge_field.rest, start])


def test_an_empty_workspace_names_its_axis():
    """The side that is wrong, and none of those that were not given."""
    asked = PlanSpec(workspace=(-1.0, 0.2, 0.0, 1.0, 0.1, 1.0))
    with pytest.raises(InputError, match=r"workspace is empty along y, from 0\.200 to 0\.100 m"):
        Limits.of(asked)
    inner = Limits.of(PlanSpec(workspace=(-1.0, -1.0, -1.0, 20.0, 20.0, 20.0)))
    with pytest.raises(InputError, match=r"empty along x, from -1\.000 to -2\.000 m"):
        inner.with_cell(None, np.array([-2.0, 1.0, 1.0]), np.inf, ())


def test_a_random_start_is_far_from_a_large_goal(ridge_field):
    """The grasp, by half of the largest deflection, also where the goal is deeper than that."""
    goal = Goal(TIP, Ball((0.0, 0.9, 0.3), 0.8))
    away = np.linalg.norm(ridge_field.samples.positions - ridge_field.rest, axis=1)
    inside = goal_points(goal, ridge_field, ridge_field.limited(), seed=1)
    for seed in range(4):
        start = random_start(ridge_field, goal, PlanSpec(), seed)
        # Of other poses in the goal than those drawn there, one may be a little nearer.
        assert np.linalg.norm(inside - start, axis=1).min() >= 0.48 * away.max()


def test_a_second_arm_reaches_a_part_of_the_poses_and_not_rest(ridge_field):
    """The paper's goal: a ball of that arm's reach, into which the tip must be moved."""
    goal = second_arm_goal(ridge_field)
    points = ridge_field.region.draw(2000, np.random.default_rng(0))
    assert 0.02 < (goal.excess(ridge_field, points) <= 0.0).mean() < 0.5
    assert goal.excess(ridge_field, ridge_field.rest[None])[0] > 0.01
    far = default_goal(ridge_field, 0.01).centre(ridge_field)
    assert goal.excess(ridge_field, far[None])[0] < 0.0


def test_the_goal_of_a_demo_is_a_small_ball_that_the_tip_reaches(ridge_field):
    """Outside of rest, and smaller than the branch."""
    goal = tip_goal(ridge_field)
    points = ridge_field.region.draw(20_000, np.random.default_rng(0))
    assert goal.tolerance <= 0.02
    assert (goal.excess(ridge_field, points) <= 0.0).any()
    assert goal.excess(ridge_field, ridge_field.rest[None])[0] > 0.0


@pytest.mark.parametrize(("settings", "words"), [
    ({"goal": (0, 0, 1), "target_box": (0, 0, 0, 1, 1, 1)}, "--goal and --target-box"),
    ({"target": "flower"}, "without a goal for it"),
    ({"target": "flower", "tip_goal": (0, 0, 1)}, "no target named flower"),
    ({"target_box": (0, 0, 1, 1, 1, 0)}, r"box is empty along z, from 1\.000 to 0\.000 m"),
    ({"goal_in": "view"}, r"without a cell that has a \[camera\]"),
    ({"goal_in": "second_arm"}, r"without a cell that has a \[second_arm\]"),
])
def test_goals_that_make_no_sense_are_refused(small_model, ridge_field, settings, words):
    with pytest.raises(InputError, match=words):
        goal_of(GoalRequest(ridge_field, small_model, PlanSpec(**settings),
                            ridge_field.limited(), {}))
