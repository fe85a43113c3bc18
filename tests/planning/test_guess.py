"""What states say of a place near them, and what that saves."""

import numpy as np
import pytest

from limber.planning.field.grasp_model import Guess
from limber.planning.field.stored_states import (
    extrapolated,
    guess_of,
    midpoint_blend,
    straight_on,
    taken,
)

ASIDE = np.array([0.03, 0.015, -0.006])


@pytest.fixture(scope="module")
def states(small_model):
    """At rest, half aside, aside; three more beside the way."""
    rest = small_model.rest_position
    places = [rest + ASIDE * part for part in (0.25, 0.5, 1.0)]
    places += [rest + 0.5 * ASIDE + step for step in 0.003 * np.eye(3)]
    found = [taken(small_model, one) for one in small_model.follow(
        np.array(places), small_model.rest.displacement)]
    return [taken(small_model, small_model.rest), *found]


def factorised(model, function):
    """Return what a function gives, and how often the stiffness was factorised for it."""
    equations = model.model.equations((model.grasp,))
    before = equations.factorisation_count
    return function(), equations.factorisation_count - before


def guesses(model, states):
    """Of the state half aside, from those about it."""
    rest, quarter, half, aside, *others = states
    about = [rest, quarter, aside, *others]
    return half, {
        "radial": guess_of(model, about, np.array([one.pose[:3] for one in about]), half.pose[:3]),
        "half-way": midpoint_blend(model, rest, aside, half.pose[:3]),
        "alone": extrapolated(model, rest, half.pose[:3]),
        "straight on": straight_on(model, rest.displacement, quarter.displacement, half.pose[:3])}


def test_the_strain_of_a_guess_is_nearer_the_branch_s_than_that_of_its_displacement(
        small_model, states):
    """All are near; what lies between states that are turned has strain of its own, and the more
    is left of it the farther they are apart."""
    half, told = guesses(small_model, states)
    truth = small_model.model.strains(half.displacement)
    way = np.linalg.norm(half.displacement - states[0].displacement)
    for name, guess in told.items():
        assert np.linalg.norm(guess.displacement - half.displacement) < 0.2 * way, name
        own = small_model.model.strains(guess.displacement)
        assert np.linalg.norm(guess.strain - truth) < 0.5 * np.linalg.norm(own - truth), (
            name, np.linalg.norm(guess.strain - truth), np.linalg.norm(own - truth))


def test_a_guess_leads_to_the_same_state_in_fewer_factorisations(small_model, states):
    """Fewer still where its strain is known."""
    half, told = guesses(small_model, states)
    begin, place = states[0].displacement, half.pose[None, :3]
    for name in ("half-way", "alone"):
        with_strain, few = factorised(
            small_model, lambda name=name: small_model.follow(place, begin, told[name])[0])
        bare, more = factorised(small_model, lambda name=name: small_model.follow(
            place, begin, Guess(told[name].displacement))[0])
        assert with_strain.converged and bare.converged and few < more
        assert np.allclose(with_strain.displacement, half.displacement, atol=1e-7)


def test_a_way_that_turns_says_nothing_of_what_comes(small_model, states):
    """Nor one that stands."""
    rest, quarter, half, *_ = (one.displacement for one in states)
    here = states[1].pose[:3]
    assert straight_on(small_model, rest, quarter, here + [0.0, 0.01, 0.0]) is None
    assert straight_on(small_model, rest, quarter, here) is None
    assert straight_on(small_model, half, quarter, states[0].pose[:3]) is not None
