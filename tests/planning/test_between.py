"""Neighbouring samples that do not agree: a branch that gives way to either side."""

from types import SimpleNamespace

import numpy as np
import pytest

from limber.planning.field import sampling
from limber.planning.field.chart import Chart
from limber.planning.field.sampling import SolverPool, disagreeing, jump, sample_between
from limber.planning.field.stored_states import Solved

PLAIN = Chart.about(None, 0.0, np.zeros(3))
LENGTH = 0.4


class Bow:
    """A branch that stands straight above z = 0; pushed below, its tip goes to one side, +1 or -1,
    and stays there unless it is pulled straight or drawn over by more than ``hold`` [m]."""

    needs_guess = True

    def __init__(self, hold):
        self.hold = hold
        self.reach = SimpleNamespace(arc_length=LENGTH)
        self.model = SimpleNamespace(strains=lambda displacement: 0.0 * displacement)

    def side(self, place, before):
        if place[2] >= 0.0 or abs(place[0]) > self.hold:
            return 1.0 if place[0] >= 0.0 else -1.0
        return before

    def follow(self, places, start, guess=None, *, snap):
        """Where a guess is near what stays on its side, the branch is there at once."""
        if guess is not None and abs(guess.displacement[0, 0]) > 0.5:
            start = np.array([[np.sign(guess.displacement[0, 0]), *places[0]]])
        side, here = start[0, 0], start[0, 1:]
        for place in places:
            for part in np.linspace(0.0, 1.0, 21)[1:]:
                side = self.side(here + part * (place - here), side)
            here = place
        return [SimpleNamespace(displacement=np.array([[side, *here]]), converged=True,
                                min_det_f=1.0)]

    def shape(self, displacement):
        side, place = displacement[0, 0], displacement[0, 1:]
        aside = side * np.sqrt(0.05 * max(-place[2], 0.0))
        return np.concatenate([np.zeros(3), place + [aside, 0.0, 0.1]])

    def solved(self, result, _target=-1):
        place, tip = result.displacement[0, 1:], self.shape(result.displacement)[3:]
        slopes = np.zeros((3, 6))
        slopes[:, 3:] = np.eye(3)
        if place[2] < 0.0:
            slopes[2, 3] = -result.displacement[0, 0] * 0.025 / np.sqrt(-0.05 * place[2])
        return Solved(0, np.concatenate([place, np.zeros(3)]), 0.0, np.zeros(3), tip, 1.0, None,
                      np.empty((0, 3)), np.zeros(3), 0.0, np.zeros(3), 0.0, slopes, 0.0,
                      result.displacement,
                      np.concatenate([np.zeros((3, 1, 1)), np.eye(3)[:, None]], axis=2))

    def at(self, places):
        """The states at places, each reached from above."""
        return [self.solved(self.follow(np.array([[p[0], p[1], 0.05], p]), np.array(
            [[1.0, p[0], p[1], 0.05]]), snap=True)[0]) for p in places]


@pytest.fixture
def bow(monkeypatch):
    model = Bow(0.02)
    monkeypatch.setattr(sampling, "taken",
                        lambda branch, result: branch.solved(result))
    return model


def places(count=60):
    generator = np.random.default_rng(1)
    return generator.uniform([-0.1, -0.05, -0.08], [0.1, 0.05, 0.04], (count, 3))


USUAL = places(500)


def test_where_it_may_go_either_way_is_refused_and_elsewhere_a_sample_more(bow):
    """Neighbours on both sides: places between them where both shapes stand are bistable; where one
    shape gives way to the other on the way, or only changes fast, there are new samples."""
    known = bow.at(places())
    added, bistable = sample_between(SolverPool(bow, 1), known, PLAIN, USUAL, 60)
    assert len(bistable) and len(added)
    assert (bistable[:, 2] < 0.0).all() and (np.abs(bistable[:, 0]) <= bow.hold).all()
    for place in bistable:
        shapes = [bow.shape(np.array([[side, *place]])) for side in (-1.0, 1.0)]
        assert np.abs(shapes[1] - shapes[0]).max() > 0.003 * LENGTH
    for one in added:
        assert np.allclose(one.tip, bow.shape(one.displacement)[3:])
    assert len(added) + len(bistable) <= 60
    assert sample_between(SolverPool(bow, 1), known, PLAIN, USUAL, 0)[0] == []


def test_what_many_poses_lie_near_is_asked_first(bow):
    """Of two folds alike, that in the crowd comes first, and of a tetrahedron one pair a round."""
    known = bow.at(places())
    positions = np.array([one.pose[:3] for one in known])
    lower, upper = (sign * USUAL[:, 1] > 0.01 for sign in (-1, 1))
    for crowd in (lower, upper):
        pairs = disagreeing(known, PLAIN, USUAL[crowd], LENGTH)
        first = np.mean([positions[[a, b], 1].mean() for a, b, _ in pairs[:8]])
        assert first * USUAL[crowd, 1].mean() > 0.0
        chosen = sampling._apart(pairs, known, np.empty((0, 3)), PLAIN)
        about = np.concatenate([pairs[k][2] for k in range(len(pairs))
                                if any(known[pairs[k][0]] is pair[0] and known[pairs[k][1]] is
                                       pair[1] for pair, _ in chosen)])
        assert 1 < len(chosen) < len(pairs) and len(about) == len(np.unique(about))


def test_what_agrees_is_asked_nothing(bow):
    """Above its rest the tip follows the grasp: no pair stands out, and slopes of one sample
    alone are enough to say so."""
    known = bow.at(places() + [0.0, 0.0, 0.2])
    assert disagreeing(known, PLAIN, USUAL + [0.0, 0.0, 0.2], LENGTH) == []
    assert sample_between(SolverPool(bow, 1), known, PLAIN, USUAL, 60)[1].shape == (0, 3)
    one, two = bow.at([[-0.05, 0.0, -0.05], [0.05, 0.0, -0.05]])
    assert jump(one, two) == pytest.approx(2.0 * np.sqrt(0.05 * 0.05))
    assert jump(one, bow.at([[-0.06, 0.0, -0.05]])[0]) < 1e-12
