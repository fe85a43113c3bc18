"""The add-on's end of a session: a branch held by the worker; what is refused is said."""

import json
import os
import signal
import sys
import time

import numpy as np
import pytest
from tests.addon.conftest import part

SCRIPT = """
import sys
print({first!r}, flush=True)
sys.stdin.read()
"""


@pytest.fixture
def session_module(addon):
    return part("bend.session")


@pytest.fixture
def started(session_module):
    """Start sessions that are closed in the end."""
    opened = []

    def start(command, vertex_count=3):
        opened.append(session_module.Session(command, vertex_count))
        return opened[-1]
    yield start
    for session in opened:
        session.close()


def until(session, is_there, seconds=200.0):
    """Poll until something is there, or the session has ended; returns it."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        told = session.poll()
        found = is_there(told)
        if found or session.error:
            return found
        time.sleep(0.02)
    raise TimeoutError(session.message)


@pytest.mark.slow
def test_a_branch_is_held_and_bent(started, beam):
    """The frame that answers a move has the grasp's place where it was sent, at some force."""
    session = started([sys.executable, "-m", "limber", "session", "--no-grasp", "--no-reduced",
                       str(beam.folder)], len(beam.surface))
    until(session, lambda _: session.hello)
    assert session.frame().who == "full" and session.frame().force == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(session.frame().positions, beam.surface, atol=1e-6)
    asked = session.grasp((0.0, 0.0, 0.55), 0.02)
    reply = until(session, lambda told: [event for event in told if event["id"] == asked])[0]
    x, y, z = reply["pose"][:3]
    sent = session.move(reply["grasp"], (x + 0.02, y, z))

    def answered(_):
        frame = session.frame()
        return frame if frame.answers >= sent and frame.positions[:, 0].max() > 0.02 else None
    frame = until(session, answered)
    assert frame.energy > 0 and frame.force[0] > 0
    session.close()
    assert not os.path.exists(session.hello["positions"])


@pytest.mark.slow
def test_another_mesh_is_refused(started, beam):
    session = started([sys.executable, "-m", "limber", "session", "--no-grasp",
                       str(beam.folder)], 17)
    until(session, lambda _: session.hello)
    assert "Open the result again" in session.error and session.frame() is None


@pytest.mark.parametrize(("first", "words"), [
    (json.dumps({"event": "hello", "protocol": 99}), "protocol 99"),
    (json.dumps({"event": "failed", "message": "There is no mesh."}), "There is no mesh."),
    (json.dumps({"event": "hello", "protocol": 2, "positions": "/nowhere"}), "nowhere")])
def test_what_it_cannot_use_is_said(started, first, words):
    session = started([sys.executable, "-c", SCRIPT.format(first=first)])
    until(session, lambda _: session.hello)
    assert words in session.error


def test_a_killed_session_is_told(started):
    """And what is sent afterwards does no harm."""
    session = started([sys.executable, "-c", SCRIPT.format(first="rubbish among the lines")])
    os.kill(session.pid, getattr(signal, "SIGKILL", signal.SIGTERM))
    until(session, lambda _: False)
    assert "ended" in session.error
    session.move(1, (0.0, 0.0, 0.0))
