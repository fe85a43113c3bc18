"""Goals that a robot's cell gives: the target where the second arm takes it, or the camera sees it.
"""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from tests.stages.specified import Planned

from limber.cell.cell_file import Cell, write_cell
from limber.cell.obstacles import Box
from limber.core.errors import NoPathError
from limber.planning.field.energy_field import EnergyField
from limber.planning.field.stored_states import States
from limber.planning.goals.goal import (
    TIP,
    CellPlace,
    Goal,
    GoalRequest,
    goal_points,
    with_near_side,
)
from limber.planning.goals.goal_kinds import CellGoal, goal_of
from limber.planning.goals.region import Ball
from limber.planning.plan_file import read_plan
from limber.planning.settings import PlanSpec
from limber.stages.paths.plan_cell import cell_positions, hiding
from limber.store import Branch

pytestmark = pytest.mark.usefixtures("rough_plan")
SETTINGS = PlanSpec(iterations=300, inertia=False)
AWAY = 0.04  # [m] that the tip must be brought


@pytest.fixture(scope="module")
def field(planned_branch):
    return EnergyField.read(planned_branch / "energy.npz")


def cell_of(**content):
    return Cell(**{"robot": {"model": "ur5e"}, "base": {"pose": (0.55, 0.1, 0.0, 0, 0, 0.4)},
                   "tool": {"grasp_pose": (0, 0, 0.15, 0, 0, 0)},
                   "limits": {"soft_force_n": 60.0, "hard_force_n": 80.0}} | content)


def left_half(place, _surface):
    """A place that does for targets on the side where y is below 0."""
    return "a wall is there" if place[1] >= 0.0 else ""


def side_goal(field, small_model, blocked=left_half):
    middle = tuple(field.tip(field.rest[None])[0])
    place = CellPlace(Ball(middle, 0.5), blocked, False, "arm's length", "Nobody takes {what}",
                      "Move the wall")
    return CellGoal(TIP, place.region, advice=place.advice, cell_place=place,
                    grasp_model=small_model)


@pytest.mark.slow
def test_a_region_of_which_half_does_has_its_border_there(field, small_model):
    """Nearly all poses on the right side count, nearly none on the wrong one; then nothing is
    proven; a place that does nowhere is refused with its reason."""
    goal = side_goal(field, small_model).learnt(field)
    points = field.region.draw(1000, np.random.default_rng(5))
    inside = goal.excess(field, points) <= 0.0
    y = field.tip(points)[:, 1]
    assert inside[y < -0.03].mean() > 0.95 and inside[y > 0.0].mean() < 0.02
    assert (goal.uncertainty(field, points) == np.inf).all()
    reached = goal_points(goal, field, field.limited())
    assert len(reached) == 200 and field.tip(reached)[:, 1].max() < 0.015
    everywhere = side_goal(field, small_model, lambda *_: "").learnt(field)
    assert np.array_equal(everywhere.excess(field, points), Goal.excess(everywhere, field, points))
    stated = everywhere.uncertainty(field, points)
    assert 0.0 < stated.min() < stated.max() <= field.position_error()
    with pytest.raises(NoPathError) as refused:
        side_goal(field, small_model, lambda *_: "a wall is there").learnt(field)
    assert re.match(r"Nobody takes the tip at any of the \d+ poses that were checked: a wall is "
                    r"there at each\. At these poses the tip lies within arm's length\. Move the "
                    r"wall, or sample farther", str(refused.value))


def test_a_refusal_counts_its_causes(field, small_model):
    """Each cause with the number of poses, the most frequent one first."""
    goal = side_goal(field, small_model, lambda place, _surface: (
        "a wall is there" if place[1] >= 0.0 else "the floor is there")).learnt
    with pytest.raises(NoPathError) as refused:
        goal(field)
    found = re.search(r"checked: (.*) at (\d+), (.*) at (\d+)\.", str(refused.value))
    assert {found[1], found[3]} == {"a wall is there", "the floor is there"}
    assert int(found[2]) >= int(found[4]) > 0


def test_a_refusal_describes_its_region_in_words(field, small_model):
    """No refusal prints stored data, and each advises what its own kind of goal can change."""
    far, cell = (9.0, 0.0, 0.5), cell_of(
        second_arm={"model": "ur5", "base_pose": (9.0, 0, 0, 0, 0, 0)},
        camera=camera_cell(1.0).camera.model_copy(update={"pose": (9.0, 0, 0, 0, 0, 0)}))
    asked = {
        "goal": (far, "the grasp within 0.010 m of (9.000, 0.000, 0.500) m", "--goal-tolerance"),
        "tip_goal": (far, "the tip within 0.010 m of (9.000, 0.000, 0.500) m", "--goal-tolerance"),
        "target_box": ((9.0, 0, 0, 9.1, 1, 1), "the tip within the box from (9.000, 0.000, 0.000) "
                       "to (9.100, 1.000, 1.000) m", "a larger --target-box"),
        "view": ("view", "the tip within the image of the camera at (9.000, 0.000, 0.000) m that "
                 "looks along (0.000, 0.000, 1.000), 0.300 to 1.000 m ahead of it",
                 "Move the camera"),
        "second_arm": ("second_arm", "of the shoulder of the second arm (ur5) at (9.000, ",
                       "Move the second arm")}
    for name, (value, words, advice) in asked.items():
        name = "goal_in" if name == value else name
        settings = SETTINGS.model_copy(update={name: value})
        goal = goal_of(GoalRequest(field, small_model, settings, field.limited(),
                                   cell_positions(cell)))
        with pytest.raises(NoPathError) as refused:
            goal_points(goal, field, field.limited())
        text = str(refused.value)
        assert words in text and advice in text and "{" not in text
        assert ("--goal-tolerance" in text) == ("--goal-tolerance" in advice)


def test_the_sight_is_refined_on_the_branch_model(field, small_model):
    """Between a pose that hides the target and one that does not, states of the branch are solved;
    the border found there is the one of their surface, and not the field's."""
    def half(place, surface):
        assert surface is not None
        return "it is hidden" if place[1] >= 0.0 else ""
    goal = side_goal(field, small_model, half)
    goal = replace(goal, cell_place=replace(goal.cell_place, of_surface=True)).learnt(field)
    assert set(goal.causes) == {"it is hidden"} and len(goal.causes) == len(goal.refused)
    assert field.tip(goal.taken)[:, 1].max() < 0.01
    border = np.linalg.norm(goal.taken[-4:] - goal.refused[-4:], axis=1)
    others = np.linalg.norm(goal.taken[:-4, None] - goal.refused[None, :-4], axis=2)
    assert border.max() < 0.2 * others.min(axis=0).max()


def test_a_plan_ends_deeper_in_a_region_than_the_field_is_wrong(field):
    """Poses of the goal less the margin are inside by the stated error; where that leaves none, a
    fraction of it, and a bound is for all of the goal."""
    tips = field.tip(field.region.draw(4000, np.random.default_rng(3)))
    rest = field.tip(field.rest[None])[0]
    away = np.linalg.norm(tips - rest, axis=1)
    goal = Goal(TIP, Ball(tuple(tips[np.argmin(np.abs(away - 0.08))]), 0.03))
    assert goal.excess(field, field.rest[None])[0] > 0.0
    inner = goal.with_margin(field, field.limited(), field.rest)
    points = goal_points(inner, field, field.limited())
    depth = -goal.region.distance(field.tip(points))
    stated = field.place_errors(None, points, 0.95)
    assert inner.margin == 1.0 and stated.min() > 0.0
    assert (depth >= np.minimum(stated, 0.4 * 0.03) - 1e-9).all()
    assert (inner.uncertainty(field, points) > goal.uncertainty(field, points)).all()
    # A ball that the tip only touches: nothing is left of it with the whole margin.
    far = tips[np.argmax(tips[:, 0])]
    touched = Goal(TIP, Ball(tuple(far + [0.2998, 0.0, 0.0]), 0.3))
    assert touched.with_margin(field, field.limited(), field.rest).margin < 1.0
    # A start that is in the goal stays where it is.
    around = Goal(TIP, Ball(tuple(rest), 0.03))
    assert around.with_margin(field, field.limited(), field.rest) is around


def test_states_of_a_plan_refine_the_border(field, small_model):
    """An end that does not do is a refused pose from then on, and no longer in the goal; and what
    the field took for valid is asked of the branch model."""
    states = States.of(small_model, [small_model.rest])
    goal = side_goal(field, small_model).learnt(field)
    wrong = replace(states, poses=states.poses + [0, 0.02, 0, 0, 0, 0],
                    tips=states.tips + [0, 0.03, 0])
    right = replace(states, tips=states.tips - [0, 0.03, 0])
    assert len(goal.drawn_in(wrong).refused) > len(goal.refused)
    assert len(goal.drawn_in(right).taken) == len(goal.taken) + 1
    points = field.region.draw(1000, np.random.default_rng(5))
    closer = goal.drawn_in(wrong).excess(field, points) <= 0.0
    known = replace(goal.drawn_in(wrong), caution=1.0).excess(field, points) <= 0.0
    assert 0 < closer.sum() < known.sum() and (known | ~closer).all(), "ends nearer to what does"
    assert goal.drawn_in(wrong).excess(field, wrong.poses[:, :3])[0] > 0.0
    with pytest.raises(NoPathError, match=r"Nobody takes the tip at the end of the path: a wall"):
        goal.require_end(small_model, wrong)


def test_large_goals_are_aimed_at_from_the_near_side(field, small_model):
    """Besides drawn poses, those where straight ways enter the goal; they lie on its border."""
    goal = side_goal(field, small_model).learnt(field)
    start = field.region.draw(500, np.random.default_rng(1))
    start = start[np.argmax(field.tip(start)[:, 1])]
    drawn = goal_points(goal, field, field.limited())
    points = with_near_side(drawn, start, goal, field, field.limited())
    near = points[len(drawn):]
    assert len(near) > 20
    assert np.allclose(goal.excess(field, near), 0.0, atol=1e-6)
    away = np.linalg.norm(points - start, axis=1)
    assert away[len(drawn):].min() < away[:len(drawn)].min()
    everywhere = field.region.draw(4000, np.random.default_rng(2))
    inside = everywhere[goal.excess(field, everywhere) <= 0.0]
    assert away.min() <= 1.02 * np.linalg.norm(inside - start, axis=1).min()


def test_a_region_that_no_draw_comes_near_is_found_from_the_samples(field, small_model,
                                                                    monkeypatch):
    """The tip of a state of the full model is reachable, however small the region about it; into
    one beside it the branch model leads."""
    monkeypatch.setattr(Goal, "_walked", lambda self, field, points, generator: points)
    inner = field.samples.positions[field.region.contains(field.samples.positions)]
    tip = field.tip(inner[[5]])[0]
    goal = Goal(TIP, Ball(tuple(map(float, tip)), 1e-5))
    assert np.allclose(goal_points(goal, field, field.limited(), count=20), inner[5], atol=1e-3)
    assert np.linalg.norm(goal.centre(field) - inner[5]) < 1e-3
    beside = Goal(TIP, Ball(tuple(tip + [0.004, 0.0, 0.0]), 5e-4))
    assert beside.missed_by(beside.grown(field, small_model).samples) <= 0.0


def test_walking_into_a_large_region_stays_among_the_samples(field):
    """Poses outside it step to its border, not to places far beyond the branch's reach."""
    rest = field.tip(field.rest[None])[0]
    tips = field.tip(field.region.draw(500, np.random.default_rng(3)))
    far = tips[np.argsort(np.linalg.norm(tips - rest, axis=1))[400]]
    outward = (far - rest) / np.linalg.norm(far - rest)
    for radius in (0.005, 0.05, 1.0):
        goal = Goal(TIP, Ball(tuple(far + (radius - 0.004) * outward), radius))
        points = goal.guess(field, 100, np.random.default_rng(0))
        reached = points[goal.excess(field, points) <= 0.0]
        assert field.region.contains(reached).sum() > 20


def test_an_obstacle_hides_what_is_behind_it():
    view = cell_positions(camera_cell(1.0))["view"].region
    place = np.array([0.1, 0.0, 0.45])
    box = Box("the post", np.full(3, 0.02), np.array([0.05, -0.4, 0.47]), np.eye(3))
    assert hiding(view, (), place, None) == ""
    assert hiding(view, (box,), place, None) == "the post hides it"


def camera_cell(far):
    """A camera 0.8 m aside that looks along y and sees up to ``far`` [m]."""
    return cell_of(camera={
        "mount": "branch", "width": 640, "height": 480, "focal_px": (600.0, 600.0),
        "centre_px": (320.0, 240.0), "pose": (0.0, -0.8, 0.5, -np.pi / 2, 0, 0),
        "range_m": (0.3, far)})


def arm_cell(tip):
    """A second arm that stands just too far from the tip to take it where it is."""
    low, high = -1.4, -0.6
    for _ in range(12):
        middle = 0.5 * (low + high)
        cell = cell_of(second_arm={"model": "ur5", "base_pose": (middle, 0, 0, 0, 0, 0)})
        try:
            cell_positions(cell)["second_arm"].require("the tip", tip, None)
            high = middle
        except NoPathError:
            low = middle
    return cell_of(second_arm={"model": "ur5", "base_pose": (low - AWAY, 0, 0, 0, 0, 0)})


@pytest.mark.slow  # two plans on the full model
@pytest.mark.usefixtures("coarse_bound")
@pytest.mark.parametrize("kind", ["second_arm", "view"])
def test_a_target_is_brought_where_it_can_be_taken_or_seen(planned_branch, tmp_path, kind):
    """From rest, where it cannot: the end does on the full model, and is not far in."""
    folder = shutil.copytree(planned_branch, tmp_path / "copy.branch")
    tip = read_plan(folder / "plans/there.json").motion.tips[0]
    cell = arm_cell(tip) if kind == "second_arm" else camera_cell(float(tip[1]) + 0.8 - AWAY)
    place = cell_positions(cell)[kind]
    path = tmp_path / "cell.toml"
    write_cell(path, cell.model_copy(update={"branch": Branch.open(folder).uuid}))
    Planned.of(SETTINGS.model_copy(update={"goal_in": kind}), branch_folder=folder, name="brought",
               cell=path).run()
    plan = read_plan(folder / "plans/brought.json")
    end = np.array(plan.summary["target_end_m"])
    place.require("the tip", end, None)
    assert place.region.distance(end[None])[0] <= 1e-4
    assert 0.5 * AWAY < np.linalg.norm(end - tip) < 8.0 * AWAY
    assert plan.summary["plan"]["length_m"] > 0.01
    # RRT* of 300 iterations.
    assert plan.summary["baseline"]["length_m"] <= 1.3 * plan.summary["plan"]["length_m"]
