"""Samples added until the error that was asked for holds."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from limber.planning.field import refining
from limber.planning.field.energy_field import fit_field
from limber.planning.field.refining import TIP_ERROR, refined
from limber.planning.field.sampling import Sampled
from limber.planning.field.solved import Solved
from limber.planning.field.valley import Valley


def tip_of(place):
    """Moves with the grasp, and on one side sways across it besides."""
    sway = 0.02 * np.sin(40.0 * place[..., 0]) * (place[..., 0] > 0.0)
    return 1.5 * place + np.stack([0.0 * sway, sway, 0.3 + 0.0 * sway], axis=-1)


@pytest.fixture
def followed(ridge, monkeypatch):
    """What answers for the ridge: its displacement is where its grasp is; it has no solution in a
    corner."""
    def solved(model, result, target):
        place = result.displacement[0]
        return Solved(target, np.concatenate([place, np.zeros(3)]), ridge.energy(place[None])[0],
                      ridge.force(place[None])[0], model.tip(place), 0.95,
                      None if place.sum() < 0.2 else "torn", np.empty((0, 3)), np.zeros(3), 0.05,
                      place, 0.0, np.full((3, 6), np.nan), ridge.force(place[None])[0, 2],
                      result.displacement, np.full((3, 1, 3), np.nan))

    monkeypatch.setattr(refining, "taken", solved)
    return SimpleNamespace(follow=lambda places, _start: [SimpleNamespace(displacement=places)],
                           tip=lambda place: 1.5 * place)


def sampled(ridge, tips):
    samples = ridge.samples(count=60)
    samples = replace(samples, tips=tips(samples.positions))
    return fit_field(samples), Sampled(samples, list(samples.positions[:, None]),
                                       Valley(np.zeros(3), 0.0), {}, 0)


def test_poses_are_added_until_the_asked_error_holds(ridge, followed):
    """Where the field is off most, each with its state; what has no solution is refused; a field
    that is good enough is left as it is."""
    field, before = sampled(ridge, followed.tip)
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


def test_poses_are_added_where_the_tip_is_off(ridge, followed):
    """Though the energy is good enough; until it is there at 95 % of the poses, and on the side
    where it sways."""
    followed.tip = tip_of
    field, before = sampled(ridge, tip_of)
    assert field.errors["tip_error_most_m"] > TIP_ERROR
    after, finer = refined(followed, before, field, 1.0, 400, workers=1)
    added = after.samples.positions[60:]
    assert finer.errors["tip_error_most_m"] <= TIP_ERROR and 0 < len(added) < 340
    assert (added[:, 0] > -0.02).mean() > 0.8
    places = np.random.default_rng(5).uniform(-0.08, 0.08, (200, 3))
    off = [np.linalg.norm(one.tip(places) - tip_of(places), axis=1) for one in (field, finer)]
    assert np.quantile(off[1], 0.95) < 0.5 * np.quantile(off[0], 0.95)
