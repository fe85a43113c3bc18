"""Which model answers: learning, reduced, full, untrusted; what was learnt is not learnt again."""

import time

import numpy as np
import pytest

from limber.session.client import InteractiveSession
from limber.session.frame_buffer import Status

# Each needs a session that has learnt, for seconds.
pytestmark = pytest.mark.slow

SMALL = {"grasps": 24, "size": 36, "fields": 70}


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """A folder of learnt models that the tests of this file share."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def session(branch_folder, cache):
    """A session that was seen to learn, and is ready."""
    with InteractiveSession(branch_folder, mode="point", cache_folder=cache, **SMALL) as running:
        pose = np.array(running.hello["rest_pose"]) + [0.01, 0, 0, 0, 0, 0]
        running.early = running.wait(running.move(pose))
        event = running.wait_for("model", 90)
        assert event is not None and not event["from_cache"], running.events
        yield running


def at(session, x: float, y: float = 0.0, z: float = 0.0):
    """The frame of a pose that far from rest."""
    rest = np.array(session.hello["rest_pose"])
    return session.wait(session.move(rest + [x, y, z, 0, 0, 0]))


def test_the_full_model_answers_while_it_learns_and_the_reduced_one_then(session):
    """Both say who they are, and agree."""
    assert session.early.status == Status.learning and not session.early.is_reduced
    frame = at(session, 0.01)
    assert frame.status == Status.reduced and frame.is_trusted and frame.is_reached
    full = session.early
    if full.is_reached:
        assert frame.energy == pytest.approx(full.energy, rel=0.02)
    assert frame.greatest_strain > 0
    assert frame.strains.shape == (len(frame.positions),)


def test_what_is_out_of_reach_is_not_trusted(session):
    """Three lengths away there is no equilibrium: said, and the branch stays where it was."""
    before = at(session, 0.02)
    frame = at(session, 0.6)
    assert frame.status == Status.untrusted and not frame.is_trusted and not frame.is_converged
    np.testing.assert_allclose(frame.positions, before.positions, atol=1e-6)
    assert at(session, 0.02).status == Status.reduced


def test_a_second_grasp_is_the_full_models_and_its_release_the_reduced_ones(session):
    """Nothing is learnt anew when the second gripper lets go."""
    at(session, 0.01)
    count = sum(line["event"] == "model" for line in session.events)
    second = session.grab(point=[0.0, 0.0, 0.08], radius=0.01)
    frame = session.wait(session.move(second["pose"], grasp=second["grasp"]))
    assert frame.status == Status.full and len(frame.grasps) == 2
    session.release(second["grasp"])
    frame = at(session, 0.012)
    assert frame.status == Status.reduced and len(frame.grasps) == 1
    assert sum(line["event"] == "model" for line in session.events) == count


def test_loads_are_not_answered_by_a_model_that_does_not_know_them(session):
    """A hung weight goes to the full model; in motion the reduced one is not trusted with it."""
    place = {"point": [0.0, 0.0, 0.2], "force_n": [0.02, 0, 0]}
    session.set_loads([place])
    frame = at(session, 0.01)
    assert frame.status == Status.full
    session.set_dynamics(True)
    time.sleep(0.3)
    moving = session.latest()
    assert moving.status == Status.untrusted and moving.time > 0
    session.set_dynamics(False)
    session.set_loads([])
    assert at(session, 0.01).status == Status.reduced


def test_a_second_session_does_not_learn_again(session, branch_folder, cache):
    """It finds the model, and answers the same."""
    first = at(session, 0.015, 0.004)
    with InteractiveSession(branch_folder, mode="point", cache_folder=cache, **SMALL) as second:
        event = second.wait_for("model", 60)
        assert event is not None and event["from_cache"]
        frame = at(second, 0.015, 0.004)
        assert frame.status == Status.reduced
        assert frame.energy == pytest.approx(first.energy, rel=1e-6)


@pytest.mark.usefixtures("session")
def test_a_damaged_cache_is_said_and_learnt_again(branch_folder, cache, tmp_path):
    """A broken file costs a warning and the time to learn, not the session."""
    (path,) = cache.glob("*.npz")
    (tmp_path / path.name).write_bytes(path.read_bytes()[:1000])
    options = {"mode": "point", "cache_folder": tmp_path, **SMALL}
    with InteractiveSession(branch_folder, **options) as second:
        event = second.wait_for("model", 90)
        assert event is not None and not event["from_cache"]
        assert any("damaged" in line.get("message", "") for line in second.events)
