"""Samples added until the error that was asked for holds."""

from types import SimpleNamespace

import numpy as np
import pytest

from limber.planning.field import sampling
from limber.planning.field.energy_field import fit_field
from limber.planning.field.sampling import LowEnergySurface, Sampled, refined
from limber.planning.field.stored_states import Solved


@pytest.fixture
def followed(ridge, monkeypatch):
    """What answers for the ridge: its displacement is where its grasp is; it has no solution in a
    corner."""
    def solved(_model, result, target):
        place = result.displacement[0]
        return Solved(target, np.concatenate([place, np.zeros(3)]), ridge.energy(place[None])[0],
                      ridge.force(place[None])[0], 1.5 * place + [0.0, 0.0, 0.3], 0.95,
                      None if place.sum() < 0.2 else "torn", np.empty((0, 3)), np.zeros(3), 0.05,
                      place, 0.0, np.full((3, 6), np.nan), ridge.force(place[None])[0, 2],
                      result.displacement, np.full((3, 1, 3), np.nan))

    monkeypatch.setattr(sampling, "taken", solved)
    return SimpleNamespace(follow=lambda places, _start: [SimpleNamespace(displacement=places)])


def test_poses_are_added_until_the_asked_error_holds(ridge, followed):
    """Where the field is off most, each with its state; what has no solution is refused; a field
    that is good enough is left as it is."""
    samples = ridge.samples(count=60)
    field = fit_field(samples)
    before = Sampled(
        samples, list(samples.positions[:, None]), LowEnergySurface(np.zeros(3), 0.0), {}, 0
    )
    asked = 0.4 * field.errors["energy_error"]
    after, finer = refined(followed, before, field, asked, 200, workers=1)
    assert finer.errors["energy_error"] <= asked and 60 < len(finer.samples.poses) < 200
    assert after.samples is finer.samples
    assert np.allclose(np.concatenate(after.displacements), after.samples.positions)
    truth = ridge.energy(after.samples.positions[60:])
    assert np.allclose(after.samples.energies[60:], truth)
    assert len(refined(followed, before, field, 1e-9, 75, workers=1)[1].samples.poses) == 75
    same, untouched = refined(followed, before, field, 1.0, 200, workers=1)
    assert same is before and untouched is field
