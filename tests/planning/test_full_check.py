"""What a refused plan teaches the field."""

import numpy as np
import pytest

from limber.core.errors import Cancelled, NoPathError
from limber.planning import make_plan as planning
from limber.planning.constraints.limits import Limits
from limber.planning.constraints.motion_check import learnt
from limber.planning.field.energy_field import EnergyField, refit
from limber.planning.path_on_full_model import resolve_path
from limber.planning.settings import PlanSettings


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
    settings = PlanSettings(tip_goal=tuple(map(float, field.samples.tips[far])),
                            goal_tolerance=0.02, iterations=300, inertia=False)
    return lambda: planning.plan_motion(field, small_model, settings, workers=1)


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_bound")
def test_a_plan_to_a_region_ends_less_deep_once_the_field_knows_its_end(to_region, monkeypatch):
    """It is cheaper, and still in the region on the full model. If none such holds, or it is
    cancelled, the one before is kept."""
    again = to_region()
    assert len(again.summary["rounds"]) == 2
    tried = planning._Rounds._tried

    def ends_with(error):
        def fails(self, *arguments, **options):
            if self.holding is not None:
                raise error("No path.", "", "")
            return tried(self, *arguments, **options)
        monkeypatch.setattr(planning._Rounds, "_tried", fails)
        return to_region()
    deep, cancelled = ends_with(NoPathError), ends_with(Cancelled)
    assert len(deep.summary["rounds"]) == 1
    assert again.summary["certificate"]["upper_bound"] < (
        0.99 * deep.summary["certificate"]["upper_bound"])
    assert cancelled.summary["stopped"] and not deep.summary["stopped"]
    np.testing.assert_array_equal(cancelled.plan.solved.poses, deep.plan.solved.poses)
    for found in (again, deep, cancelled):
        centre = np.array(found.summary["goal"]["position_m"])
        assert np.linalg.norm(found.plan.solved.tips[-1] - centre) <= 0.02
        assert found.baseline.is_whole and found.summary["certificate"]["lower_bound"] > 0.0
