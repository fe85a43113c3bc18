"""A grasp model that asks a reduced model first, and the full one where that is in doubt."""

from dataclasses import replace

import numpy as np
import pytest
from tests.stages.specified import Sampled

from limber.planning.field.energy_field import EnergyField
from limber.planning.field.grasp_model import CorrectedResult, Guess, LearntGraspModel
from limber.planning.field.stored_states import (
    extrapolated,
    guess_of,
    midpoint_blend,
    straight_on,
    taken,
)
from limber.reduced import model_cache
from limber.reduced.model_cache import ReducedCache
from limber.reduced.reduced_model import ReducedSettings
from limber.reduced.training import TrainingSettings
from limber.stages.paths.energy import EnergySpec
from limber.store import Branch

FEW = ReducedSettings(size=40, field_count=70, training=TrainingSettings(
    grasp_count=30, young_spread=1.0, vibration_every=0))


@pytest.fixture(scope="module")
def learnt(small_model, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("limber.planning.field.grasp_model.SHARED", FEW)
        return LearntGraspModel.learnt(small_model, ReducedCache(tmp_path_factory.mktemp("kept")))


@pytest.fixture(scope="module")
def places(small_model):
    """Positions of the grasp some centimetres from rest, to the sides and inwards."""
    ways = np.array([[0.03, 0.0, -0.01], [0.0, -0.05, -0.02], [-0.04, 0.03, -0.03]])
    return small_model.rest_position + ways


def test_states_are_those_of_the_full_model(small_model, learnt, places):
    """Energy, force, strain, det F, shape and its slopes, for one step of the full model each."""
    before = small_model.model.equations((small_model.grasp,)).factorisation_count
    quick = [taken(learnt, learnt.follow(place[None], learnt.rest.displacement)[0])
             for place in places]
    count = learnt.model.equations((learnt.grasp,)).factorisation_count - before
    full = [taken(small_model, one)
            for one in small_model.follow(places, small_model.rest.displacement)]
    assert count == len(places)
    for one, true in zip(quick, full, strict=True):
        assert one.reduced and not true.reduced
        np.testing.assert_allclose(one.pose, true.pose, atol=1e-4)
        assert one.energy == pytest.approx(true.energy, rel=1e-3)
        np.testing.assert_allclose(one.force, true.force, atol=5e-3 * np.linalg.norm(true.force))
        np.testing.assert_allclose(one.tip, true.tip, atol=1e-4)
        assert one.strain == pytest.approx(true.strain, rel=1e-2)
        assert one.min_det_f == pytest.approx(true.min_det_f, abs=1e-3)
        np.testing.assert_allclose(one.shape_slopes, true.shape_slopes,
                                   atol=1e-2 * np.abs(true.shape_slopes).max())


def test_a_force_leads_where_it_leads_the_full_model(small_model, learnt):
    """Across the branch, as those that follow its shell; pressed until it folds the way ends, and
    the full model says so."""
    rest = learnt.rest.displacement
    for force in ([2.0, 1.0, 0.0], [-1.0, 2.0, 1.0]):
        quick, full = (one.pulled(np.array(force), rest) for one in (learnt, small_model))
        assert isinstance(quick, CorrectedResult)
        np.testing.assert_allclose(quick.displacement, full.displacement, atol=2e-4)
        there = small_model.follow(quick.pose[None, :3], full.displacement)[0]
        np.testing.assert_allclose(quick.reaction_force, there.reaction_force, atol=5e-2)
    folded = learnt.pulled(np.array([0.0, 0.0, -60.0]), rest)
    assert not isinstance(folded, CorrectedResult)


def test_the_full_model_solves_what_is_doubted(learnt, places):
    """Of another branch's reduced model it believes nothing."""
    wrong = replace(learnt, reduced=learnt.reduced.with_young(1.05 * learnt.reduced.young))
    found = wrong.follow(places[:1], learnt.rest.displacement)[0]
    assert found.converged and not isinstance(found, CorrectedResult)
    assert not taken(wrong, found).reduced


@pytest.mark.slow
def test_no_state_is_jumped_to(learnt):
    """Led from one side to the other below its rest the branch stays in a shape of more energy than
    the one that Newton's iteration falls into: the full model finds it."""
    reduced, rest = learnt.reduced, learnt.rest_position
    sides = rest + np.array([[0.06, 0.0, -0.12], [-0.06, 0.0, -0.12]])
    q = reduced.followed(np.zeros(reduced.size), np.append(sides[0], [0, 0, 0])).coordinates
    there = reduced.followed(q, np.append(sides[1], [0, 0, 0]))
    full = learnt.follow(sides, learnt.rest.displacement)
    assert not there.converged and there.energy < 0.9 * full[1].energy
    assert full[1].converged and not isinstance(full[1], CorrectedResult)


@pytest.mark.slow
def test_a_field_says_which_model_it_came_from(small_model, small_mesh, small_skeleton, tmp_path,
                                               monkeypatch):
    """Sampled on a model that is learnt once; samples that are added later are the full model's."""
    monkeypatch.setattr("limber.planning.field.grasp_model.SHARED", FEW)
    monkeypatch.setattr("limber.planning.field.grasp_model.default_folder",
                        lambda: tmp_path / "kept")
    branch = Branch.create(tmp_path / "small.branch")
    with branch.stage("mesh") as stage:
        small_mesh.write(stage.path("mesh.vtu"))
        small_skeleton.write_swc(stage.path("skeleton.swc"))
    asked = EnergySpec(samples=45, forward="reduced", gravity=False)
    result = Sampled.of(asked, branch_folder=branch.folder).run()
    field = EnergyField.read(branch.path("energy.npz"))
    samples = field.samples
    assert result["forward"] == "reduced" and len(list((tmp_path / "kept").glob("*.npz"))) == 1
    # The rest state is the full model's.
    assert result["reduced_count"] == samples.reduced.sum() > 0.8 * len(samples.poses)
    assert not samples.reduced[0]
    place = samples.positions[np.flatnonzero(samples.reduced)[-1]]
    true = small_model.follow(place[None], small_model.rest.displacement)[0]
    assert field.energy(place)[0] == pytest.approx(true.energy, rel=1e-2)
    added = samples.joined(replace(samples.take(np.arange(3)), reduced=None))
    assert len(added.reduced) == len(added.poses) and not added.reduced[-3:].any()


def test_sessions_and_fields_learn_the_same():
    """So either finds what the other has learnt."""
    from limber.session.protocol import SessionSettings
    from limber.session.session_branch import reduced_settings

    assert reduced_settings(SessionSettings()) == model_cache.SHARED


# What states say of a place near them, and what that saves.

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
