"""Motions in time on the full model: slow ones are static, fast ones are slowed until they hold."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from tests.stages.specified import Planned

import limber.planning.make_plan as plan_module
from limber.cell.obstacles import Box
from limber.core.errors import Cancelled, NoPathError
from limber.core.progress import SILENT
from limber.mechanics import simulate_dynamics
from limber.mechanics.dynamics.motion import EnergyMomentumSettings
from limber.planning import make_plan as planning
from limber.planning.constraints.limits import Limits, Obstacles
from limber.planning.constraints.motion_check import MotionCheck, check_motion, learnt
from limber.planning.field.energy_field import EnergyField, refit
from limber.planning.goals.goal import TIP, Goal
from limber.planning.goals.region import Ball
from limber.planning.path_on_full_model import resolve_path
from limber.planning.plan_file import read_plan
from limber.planning.settings import PlanSpec
from limber.planning.timing import Pace, poses_at, time_law

BRISK = Pace(0.25, 2.0)


@pytest.fixture(scope="module")
def heavy(small_model):
    """The small branch as heavy as lead six times over, and without weight: inertia is felt."""
    branch = small_model.branch
    model = branch.model.with_parameters(density=60.0 * branch.model.density)
    return replace(small_model, branch=replace(branch, model=model))


@pytest.fixture(scope="module")
def bent(small_model):
    """The weightless small branch, taken to the side by 5 cm."""
    side = np.linspace(0.0, 1.0, 9)[1:, None] * np.array([0.0, 0.05, -0.003])
    return resolve_path(small_model, small_model.rest_position + side,
                        small_model.rest_position[None])


def peak_force(small_model, path, pace):
    """By the energy-momentum scheme, in steps of 6 ms: another scheme than the check's."""
    poses = path.ahead.poses
    law = time_law(poses[:, :3], pace)
    times = np.arange(0.0, law.duration + 0.3, 0.006)
    places = poses_at(poses, law, times)[:, :3]
    found = simulate_dynamics(
        small_model.model, grasp=small_model.grasp, times=times,
        start=path.ahead.displacements[0], poses=np.hstack([places, 0 * places]),
        settings=EnergyMomentumSettings(max_step=0.006))
    assert found.converged
    return np.linalg.norm(found.reaction_force, axis=1).max()


@pytest.mark.slow
def test_a_slow_motion_is_as_standing_still(small_model, bent):
    """At 5 mm/s inertia adds under a percent to any limit's value, and nothing is slowed down."""
    standing = bent.ahead.force_sizes.max()
    limits = Limits(force=1.2 * standing, strain=0.2, axial_force=2 * standing)
    found = check_motion(small_model, bent, limits, Pace(0.005, 0.02), slowings=2)
    assert not found.broken and found.slowings == 0
    assert found.peaks["force"] == pytest.approx(standing, rel=0.01)
    assert found.peaks["strain"] == pytest.approx(bent.ahead.strains.max(), rel=0.01)


@pytest.mark.slow
def test_a_motion_that_inertia_takes_over_a_limit_is_slowed_until_it_holds(heavy, bent):
    """Fast, another scheme finds more force than is allowed; at the pace that was found, not."""
    standing, brisk = bent.ahead.force_sizes.max(), peak_force(heavy, bent, BRISK)
    assert brisk > 1.05 * standing
    limit = 0.7 * standing + 0.3 * brisk
    found = check_motion(heavy, bent, Limits(force=limit), BRISK, slowings=4)
    assert not found.broken and found.slowings >= 1
    assert found.pace.speed < BRISK.speed
    assert peak_force(heavy, bent, found.pace) <= 1.005 * limit
    told = found.describe()
    assert told["peaks"]["force_n"]["moving"] <= limit and told["slowings"] == found.slowings


def test_what_no_pace_keeps_is_broken_with_its_place(small_model, bent):
    """Standing still is over already: it is said at once, where."""
    limits = Limits(force=0.9 * bent.ahead.force_sizes.max())
    found = check_motion(small_model, bent, limits, Pace(0.1, 1.0), slowings=4)
    assert found.slowings == 0 and found.excess["force"] > 1.0
    assert "force in motion" in found.broken[0] and "at (" in found.broken[0]


@pytest.mark.slow
def test_an_obstacle_is_met_in_motion(small_model, bent):
    """A post where the tip comes to: named with its depth; one that is farther off is not met."""
    tip = bent.solved.tips[-1]
    for place, met in ((tip, True), (tip + [0.0, 0.1, 0.0], False)):
        post = Box("the post", np.full(3, 0.01), place, np.eye(3))
        limits = Limits(constraints=(Obstacles((post,)),))
        found = check_motion(small_model, bent, limits, Pace(0.1, 1.0), slowings=0)
        assert any("inside the post" in words for words in found.broken) == met


@pytest.mark.slow
def test_a_plan_that_inertia_breaks_is_refused(planned_branch, tmp_path, monkeypatch):
    """With exit code 3, where and what, however slow it was tried; and nothing is written."""
    folder = shutil.copytree(planned_branch, tmp_path / "copy.branch")
    known = read_plan(folder / "plans/there.json")
    there, most = known.plan, 1.5 * float(known.motion.force_sizes.max())
    words = "force in motion [N] 99 exceeds the limit 60 at (0.1, 0.2, 0.3) m"
    monkeypatch.setattr(plan_module, "check_motion", lambda *_, **__: MotionCheck(
        Pace(0.001, 0.001), [words], {"force": 99.0}, {"force": 10.0}, 4, {"force": 1.65}, 9, 0.1))
    monkeypatch.setattr(plan_module, "_REPLANS", 0)
    with pytest.raises(NoPathError, match="force in motion") as refused:
        Planned(branch_folder=folder, max_force=most, iterations=100, name="shaken",
                start=tuple(there.poses[0, :3]), goal=tuple(there.poses[-1, :3])).run()
    assert refused.value.exit_code == 3 and not (folder / "plans/shaken.json").exists()


# What a refused plan teaches the field.


def test_a_path_of_known_states_teaches_nothing_and_breaks_nothing(planned_branch, small_model):
    field = EnergyField.read(planned_branch / "energy.npz")
    there = field.rest[None]
    found = learnt(field, small_model, resolve_path(small_model, there, there), Limits())
    assert len(found.poses) == 0
    again = refit(field, found)
    np.testing.assert_array_equal(again.samples.poses, field.samples.poses)
    place = field.rest + [0.01, 0.0, 0.0]
    np.testing.assert_allclose(again.energy(place[None]), field.energy(place[None]))


@pytest.fixture
def to_region(planned_branch, small_model):
    """Plan to a ball about the tip's place far from rest, by a field that is 3 mm off there."""
    field = EnergyField.read(planned_branch / "energy.npz")
    far = np.linalg.norm(field.samples.positions - field.rest, axis=1).argmax()
    field.misplaced[:] = 0.003
    settings = PlanSpec(tip_goal=tuple(map(float, field.samples.tips[far])),
                            goal_tolerance=0.02, iterations=300, inertia=False)
    return lambda: planning.plan_motion(field, small_model, settings)


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_bound")
def test_a_plan_to_a_region_ends_less_deep_once_the_field_knows_its_end(to_region, monkeypatch):
    """It is cheaper, and still in the region on the full model. If none such holds, or it is
    cancelled, the one before is kept."""
    again = to_region()
    assert len(again.summary["rounds"]) == 2
    tried, left = planning._Rounds._tried, []

    def ends_with(error):
        def fails(self, *arguments, **options):
            if self.holding is not None:
                left.append(self.aim.margin)
                raise error("No path.", "", "")
            return tried(self, *arguments, **options)
        monkeypatch.setattr(planning._Rounds, "_tried", fails)
        return to_region()
    deep, cancelled = ends_with(NoPathError), ends_with(Cancelled)
    assert len(deep.summary["rounds"]) == 1 and left == [planning._KNOWN] * 2
    assert again.summary["certificate"]["upper_bound"] < (
        0.995 * deep.summary["certificate"]["upper_bound"])
    middle = again.summary["goal"]["position_m"]
    off = [np.linalg.norm(found.plan.solved.tips[-1] - middle) for found in (again, deep)]
    assert off[0] > off[1] + 1e-3
    assert cancelled.summary["stopped"] and not deep.summary["stopped"]
    np.testing.assert_array_equal(cancelled.plan.solved.poses, deep.plan.solved.poses)
    for found in (again, deep, cancelled):
        assert np.linalg.norm(found.plan.solved.tips[-1] - middle) <= 0.02
        assert found.baseline.is_whole and found.summary["certificate"]["lower_bound"] > 0.0


def test_a_goal_that_a_miss_made_too_small_is_planned_to_without_its_margins(monkeypatch):
    """Less deep by the field's error, then also by what an earlier plan missed."""
    tried = []

    def fails(_field, _start, aim, *_, **__):
        tried.append((aim.margin, aim.inset))
        if any(tried[-1]):
            raise NoPathError("No path.", "", "")
        return "paths"
    monkeypatch.setattr(planning, "plan_within", fails)
    aim = Goal(TIP, Ball((0.0, 0.0, 0.3), 0.05), margin=0.5, inset=0.02)
    rounds = planning._Rounds(*[None] * 8, aim, *[None] * 2, SILENT)
    assert rounds._within_goal(SILENT) == "paths"
    assert tried == [(0.5, 0.02), (0.0, 0.02), (0.0, 0.0)]
