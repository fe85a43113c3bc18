"""What a refused plan teaches the field."""

import numpy as np

from limber.planning.constraints.full_model_check import learnt
from limber.planning.constraints.limits import Limits
from limber.planning.field.energy_field import EnergyField, refit
from limber.planning.path_on_full_model import resolve_path


def test_a_path_of_known_states_teaches_nothing_and_breaks_nothing(planned_branch, small_model):
    field = EnergyField.read(planned_branch / "energy.npz")
    there = field.rest[None]
    found = learnt(field, small_model, resolve_path(small_model, there, there), Limits())
    assert len(found.poses) == 0
    again = refit(field, found)
    np.testing.assert_array_equal(again.samples.poses, field.samples.poses)
    place = field.rest + [0.01, 0.0, 0.0]
    np.testing.assert_allclose(again.energy(place[None]), field.energy(place[None]))
