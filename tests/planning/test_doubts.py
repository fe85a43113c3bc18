"""The field's error counts in every proof: of each limit, and of where a target is."""

from dataclasses import replace

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.core.progress import Progress
from limber.planning import baseline_and_plan
from limber.planning.certificate import feasibility
from limber.planning.certificate.feasibility import judge
from limber.planning.constraints.limits import SURELY, Limits
from limber.planning.cost import CostWeights
from limber.planning.field.energy_field import EnergyField, fit_field
from limber.planning.goals.goal import TIP, Goal, grasp_goal
from limber.planning.goals.region import Ball
from limber.planning.path_problem import UNPROVEN, BlockedError, GentleProblem
from limber.planning.settings import PlanSpec

START, GOAL = np.array([-0.12, 0.0, 0.0]), grasp_goal((0.12, 0.0, 0.0), 0.01)
LEVEL, RISE, ROUGH = 1.0, 2.0, 0.15
"""Of a load: everywhere, more of it in a layer across the way, and what no fit can score_unused."""


@pytest.fixture(autouse=True)
def few_cells(monkeypatch):
    """The finest grids take seconds and add nothing here."""
    monkeypatch.setattr(feasibility, "_MOST_CELLS", 40_000)


@pytest.fixture(scope="module")
def rough_samples(well):
    """Every load has a wall across x = 0 and is rough; the tip's place is rough by 4 mm."""
    samples = well.samples(count=150)
    generator = np.random.default_rng(1)
    load = (LEVEL + RISE * np.exp(-(samples.positions[:, 0] / 0.08)**2)
            + ROUGH * generator.uniform(-1.0, 1.0, len(samples.poses)))
    return replace(samples, strains=load, stresses=load, axial_forces=load,
                   torques=np.column_stack([load, 0 * load, 0 * load]),
                   tips=samples.tips + 0.004 * generator.uniform(-1.0, 1.0, samples.tips.shape))


@pytest.fixture(scope="module")
def rough_field(rough_samples):
    return fit_field(rough_samples)


def lowest_in_the_wall(field, name):
    """Return the least of a load where the way crosses x = 0, by the field."""
    points = field.region.draw(4000, np.random.default_rng(0)) * [0.0, 1.0, 1.0]
    return field.load(points[field.region.contains(points)], name).min()


def problem_on(field, limits, goal=GOAL):
    weights = CostWeights.between(field, START, GOAL.region.middle, deformation=1.0,
                                  distance=1.5).weights
    surely = limits.on(field, SURELY)
    return GentleProblem(field, limits.on(field), weights, START, goal, sure=surely)


@pytest.mark.parametrize("name", ["strain", "stress", "axial_force", "torque"])
def test_what_the_field_may_be_wrong_by_is_no_proof(rough_field, name):
    """A wall of a load, over the limit by less than the field's error, proves nothing; a limit that
    is too low for that as well does."""
    lowest = lowest_in_the_wall(rough_field, name)
    uncertainty = Limits(**{name: lowest}).doubts(rough_field)[name]
    assert 0.5 * ROUGH < uncertainty < 5.0 * ROUGH
    near = problem_on(rough_field, Limits(**{name: lowest - 0.4 * uncertainty}))
    held_for_true = judge(replace(near, sure=near.limits))
    assert held_for_true.proven, "the field alone would have been a proof"
    assert not judge(near).proven
    assert judge(problem_on(rough_field, Limits(**{name: lowest - 1.4 * uncertainty}))).proven


@pytest.mark.parametrize("seen", [f"None was found, {UNPROVEN}.", "No path exists."])
def test_what_only_the_fields_error_forbids_is_planned(rough_field, monkeypatch, seen):
    """With the limit looser by that error, for the full model to decide; and it is said. What is
    proven is tried neither so nor without margins."""
    settings, limits, told, tried = PlanSpec(), Limits(strain=2.4), [], []
    there = baseline_and_plan.plan_pair(rough_field, START, grasp_goal(START, 0.01), settings)

    def plan_pair(_field, _start, _goal, _settings, tried_limits, *, sure, **_options):
        tried.append(2.4 - tried_limits.slack.most.sum())
        assert sure.max_loads[0] - sure.slack.most.sum() == pytest.approx(2.4 + uncertainty)
        if tried[-1] <= 2.4:
            raise BlockedError(seen, "On a grid.", "Raise the limit.")
        return there

    uncertainty = limits.doubts(rough_field)["strain"]
    monkeypatch.setattr(baseline_and_plan, "plan_pair", plan_pair)
    monkeypatch.setattr(baseline_and_plan, "_closed_by_field", lambda *_: (None, True))
    arguments = rough_field, START, GOAL, settings, limits
    progress = Progress(on_warning=told.append)
    if UNPROVEN in seen:
        found = baseline_and_plan.plan_within(*arguments, progress=progress)
        assert not any(found.margins.values()) and tried[-1] == pytest.approx(2.4 + uncertainty)
        assert found.in_doubt is not None
        assert any("field's error, at most strain 0." in words for words in told)
    else:
        with pytest.raises(BlockedError, match="No path exists"):
            baseline_and_plan.plan_within(*arguments, progress=progress)
        assert max(tried) <= 2.4 and len(tried) == 1, "without margins it is proven as well"


def test_where_cells_close_the_way_by_the_field_only_its_error_is_tried(rough_field, monkeypatch):
    """Neither margins nor the limits themselves can be kept on the field then; no close bound is
    computed before the full model has decided."""
    limits, tried = Limits(strain=2.4), []

    def plan_pair(_field, _start, _goal, _settings, tried_limits, *, is_bounded=True, **_options):
        tried.append((2.4 - tried_limits.slack.most.sum(), is_bounded))
        raise BlockedError(f"None was found, {UNPROVEN}.", "On a grid.", "Raise the limit.")

    monkeypatch.setattr(baseline_and_plan, "plan_pair", plan_pair)
    with pytest.raises(BlockedError, match=UNPROVEN):
        baseline_and_plan.plan_within(rough_field, START, GOAL, PlanSpec(), limits)
    uncertainty = limits.doubts(rough_field)["strain"]
    assert tried == [(pytest.approx(2.4 + uncertainty), False)]


def test_a_target_may_be_nearer_than_the_field_has_it(rough_field):
    """A ball just beyond the tip's reach by the field is not proven away, one far off is."""
    reach = rough_field.tip(rough_field.region.draw(4000, np.random.default_rng(0)))
    points = rough_field.region.draw(4000, np.random.default_rng(0))
    top = points[np.argmax(rough_field.tip(points)[:, 2])]
    off = float(rough_field.place_errors(None, top[None])[0])
    assert 0.002 < off <= rough_field.position_error() < 0.02
    for away, proven in ((0.5 * off, False), (4.0 * off, True)):
        centre = (0.0, 0.0, float(reach[:, 2].max()) + 0.005 + away)
        problem = problem_on(rough_field, Limits(), Goal(TIP, Ball(centre, 0.005)))
        assert judge(problem).proven == proven


def without(arrays, *names):
    return {name: values for name, values in arrays.items() if name not in names}


def test_a_field_is_read_with_its_errors(rough_field, tmp_path):
    """They are measured anew from its samples; without strains none is limited."""
    rough_field.write(tmp_path / "new.npz")
    with np.load(tmp_path / "new.npz") as arrays:
        np.savez(tmp_path / "oldest.npz", **without(arrays, "strains"))
    new = EnergyField.read(tmp_path / "new.npz")
    assert np.array_equal(new.misplaced, rough_field.misplaced)
    assert np.array_equal(new.missed, rough_field.missed, equal_nan=True)
    assert judge(problem_on(new, Limits(strain=0.9))).proven
    with pytest.raises(InputError, match="contains no strain"):
        Limits(strain=0.9).margins(EnergyField.read(tmp_path / "oldest.npz"))
