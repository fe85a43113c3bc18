"""Goals that a robot's cell gives: the target where the second arm takes it, or the camera sees it.
"""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from limber.core.errors import NoPathError
from limber.planning.baseline_and_plan import PlanSettings
from limber.planning.constraints.obstacles import Box
from limber.planning.field.energy_field import EnergyField
from limber.planning.goals.allowed_poses import goal_points, with_near_side
from limber.planning.goals.cell_region import CellGoal
from limber.planning.goals.goal import CellPlace
from limber.planning.goals.regions import Ball
from limber.planning.goals.target_goal import TargetGoal
from limber.planning.path_on_full_model import SolvedPoses
from limber.planning.plan_file import read_plan
from limber.robot.cell.cell import Cell, write_cell
from limber.stages.paths.plan import plan as plan_paths
from limber.stages.paths.plan_cell import cell_positions, require_seen
from limber.store import Branch

SETTINGS = PlanSettings(iterations=300, field_error=20.0, inertia=False)
AWAY = 0.04  # [m] that the tip must be brought


@pytest.fixture(scope="module")
def field(planned_branch):
    return EnergyField.read(planned_branch / "energy.npz")


def cell_of(**content):
    return Cell(**{"robot": {"model": "ur5e"}, "base": {"pose": (0.55, 0.1, 0.0, 0, 0, 0.4)},
                   "tool": {"grasp_pose": (0, 0, 0.15, 0, 0, 0)},
                   "limits": {"soft_force_n": 60.0, "hard_force_n": 80.0}} | content)


def left_half(what, place, _surface):
    """A place that does for targets on the side where y is below 0."""
    if place[1] >= 0.0:
        raise NoPathError("Not there.", "", "")


def side_goal(field, small_model, require=left_half):
    middle = tuple(field.tip(field.rest[None])[0])
    place = CellPlace(Ball(middle, 0.5), require, False, "Nobody takes {what}")
    return CellGoal(place.region, cell_place=place, grasp_model=small_model)


def test_a_region_of_which_half_does_has_its_border_there(field, small_model):
    """Nearly all poses on the right side count, nearly none on the wrong one; then nothing is
    proven; a place that does nowhere is refused with its reason."""
    goal = side_goal(field, small_model).learnt(field)
    points = field.region.draw(1000, np.random.default_rng(5))
    inside = goal.distance(field, points) <= goal.tolerance
    y = field.tip(points)[:, 1]
    assert inside[y < -0.03].mean() > 0.95 and inside[y > 0.0].mean() < 0.02
    assert (goal.uncertainty(field, points) == np.inf).all()
    reached = goal_points(goal, field, field.limited())
    assert len(reached) == 200 and field.tip(reached)[:, 1].max() < 0.01
    everywhere = side_goal(field, small_model, lambda *_: None).learnt(field)
    assert np.array_equal(everywhere.distance(field, points),
                          TargetGoal.distance(everywhere, field, points))
    stated = everywhere.uncertainty(field, points)
    assert 0.0 < stated.min() < stated.max() <= field.position_error()

    def nowhere(*_):
        raise NoPathError("No.", "", "")
    with pytest.raises(NoPathError, match=r"Nobody takes the tip at any of the \d+ poses"):
        side_goal(field, small_model, nowhere).learnt(field)


def test_states_of_a_plan_refine_the_border(field, small_model):
    """An end that does not do is a refused pose from then on, and no longer in the goal."""
    states = SolvedPoses.of(small_model, [small_model.rest])
    goal = side_goal(field, small_model).learnt(field)
    wrong = replace(states, poses=states.poses + [0, 0.02, 0, 0, 0, 0],
                    tips=states.tips + [0, 0.03, 0])
    right = replace(states, tips=states.tips - [0, 0.03, 0])
    assert len(goal.drawn_in(wrong).refused) == len(goal.refused) + 1
    assert len(goal.drawn_in(right).taken) == len(goal.taken) + 1
    assert goal.drawn_in(wrong).distance(field, wrong.poses[:, :3])[0] > goal.tolerance
    with pytest.raises(NoPathError, match="Not there"):
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
    assert np.allclose(goal.distance(field, near), goal.tolerance, atol=1e-6)
    away = np.linalg.norm(points - start, axis=1)
    assert away[len(drawn):].min() < away[:len(drawn)].min()
    everywhere = field.region.draw(4000, np.random.default_rng(2))
    inside = everywhere[goal.distance(field, everywhere) <= goal.tolerance]
    assert away.min() <= 1.02 * np.linalg.norm(inside - start, axis=1).min()


def test_a_region_that_no_draw_comes_near_is_found_from_the_samples(field, monkeypatch):
    """The tip of a state of the full model is reachable, however small the region about it."""
    monkeypatch.setattr(TargetGoal, "_walked", lambda self, field, points, generator: points)
    inner = field.samples.positions[field.region.contains(field.samples.positions)]
    tip = field.tip(inner[[5]])[0]
    goal = TargetGoal(Ball(tuple(map(float, tip)), 1e-5))
    assert np.allclose(goal_points(goal, field, field.limited(), count=20), inner[5], atol=1e-3)
    assert np.linalg.norm(goal.centre(field) - inner[5]) < 1e-3


def test_walking_into_a_large_region_stays_among_the_samples(field):
    """Poses outside it step to its border, not to places far beyond the branch's reach."""
    rest = field.tip(field.rest[None])[0]
    tips = field.tip(field.region.draw(500, np.random.default_rng(3)))
    far = tips[np.argsort(np.linalg.norm(tips - rest, axis=1))[400]]
    outward = (far - rest) / np.linalg.norm(far - rest)
    for radius in (0.005, 0.05, 1.0):
        goal = TargetGoal(Ball(tuple(far + (radius - 0.004) * outward), radius))
        points = goal.guess(field, 100, np.random.default_rng(0))
        reached = points[goal.distance(field, points) <= goal.tolerance]
        assert field.region.contains(reached).sum() > 20


def test_an_obstacle_hides_what_is_behind_it():
    view = cell_positions(camera_cell(1.0))["in_view"].region
    place = np.array([0.1, 0.0, 0.45])
    box = Box("the post", np.full(3, 0.02), np.array([0.05, -0.4, 0.47]), np.eye(3))
    require_seen(view, (), "the tip", place, None)
    with pytest.raises(NoPathError, match="the post hides the tip"):
        require_seen(view, (box,), "the tip", place, None)


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
@pytest.mark.parametrize("kind", ["second_arm", "in_view"])
def test_a_target_is_brought_where_it_can_be_taken_or_seen(planned_branch, tmp_path, kind):
    """From rest, where it cannot: the end does on the full model, and is not far in."""
    folder = shutil.copytree(planned_branch, tmp_path / "copy.branch")
    tip = read_plan(folder / "plans/there.json").motion.tips[0]
    cell = arm_cell(tip) if kind == "second_arm" else camera_cell(float(tip[1]) + 0.8 - AWAY)
    place = cell_positions(cell)[kind]
    path = tmp_path / "cell.toml"
    write_cell(path, cell.model_copy(update={"branch": Branch.open(folder).uuid}))
    plan_paths(folder, SETTINGS.model_copy(update={kind: True}), name="brought", cell_file=path,
               workers=1)
    plan = read_plan(folder / "plans/brought.json")
    end = np.array(plan.summary["target_end_m"])
    place.require("the tip", end, None)
    assert place.region.distance(end[None])[0] <= 1e-4
    assert 0.5 * AWAY < np.linalg.norm(end - tip) < 8.0 * AWAY
    assert plan.summary["plan"]["length_m"] > 0.01
    # RRT* of 300 iterations.
    assert plan.summary["baseline"]["length_m"] <= 1.2 * plan.summary["plan"]["length_m"]
