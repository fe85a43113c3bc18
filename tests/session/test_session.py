"""The interactive session: what it answers, which pose wins, who dies when the other does."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from tests.subjects.processes import left_alive

from limber.core.errors import InputError, WorkError
from limber.mechanics import Grasp, solve_static
from limber.session.client import InteractiveSession
from limber.session.frame_buffer import FrameReader, FrameWriter
from limber.store import Branch
from limber.store.loading import load_model

SMALL = {"grasps": 24, "size": 36, "fields": 70, "cache": False}


@pytest.fixture(scope="module")
def session(branch_folder):
    """A session whose reduced model is ready: its tests are slow, as it learns for seconds."""
    with InteractiveSession(branch_folder, mode="point", **SMALL) as running:
        assert running.wait_for("model", 90) is not None, running.events
        yield running


def rest(session) -> np.ndarray:
    """The rest pose."""
    return np.array(session.hello["rest_pose"])


def moved(session, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """The rest pose, displaced."""
    return rest(session) + [x, y, z, 0, 0, 0]


def test_frames_hand_over_what_was_published(tmp_path):
    """A reader sees the newest frame bit for bit, and nothing before the first."""
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    writer = FrameWriter(tmp_path / "frames", faces, 5)
    reader = FrameReader(tmp_path / "frames")
    assert reader.read() is None
    positions = np.arange(15.0).reshape(5, 3)
    for number in range(1, 6):
        writer.publish(positions * number, id=number, energy_j=0.5 * number, is_reduced=1,
                       force_y_n=-2.0, delay_s=0.25)
    frame = reader.read()
    assert (frame.sequence, frame.move_id, frame.energy, frame.delay) == (5, 5, 2.5, 0.25)
    assert frame.is_reduced and not frame.is_trusted
    np.testing.assert_array_equal(frame.positions, np.float32(positions * 5))
    np.testing.assert_array_equal(frame.reaction_force, [0, -2, 0])
    np.testing.assert_array_equal(reader.faces, faces)
    reader.close()
    writer.close()
    assert not (tmp_path / "frames").exists()


def test_a_file_of_another_kind_is_refused(tmp_path):
    """A reader does not take any file for a session's."""
    path = tmp_path / "other"
    path.write_bytes(b"something else" * 20)
    with pytest.raises(InputError, match="LIMBPOS2"):
        FrameReader(path)


@pytest.mark.slow
def test_answers_agree_with_the_full_model(session, branch_folder):
    """A session's energy, force and surface are the full model's."""
    pose = moved(session, x=0.03, y=0.01, z=-0.006)
    frame = session.wait(session.move(pose))
    model = load_model(Branch.open(branch_folder)).as_scanned()
    full = solve_static(model, grasp=Grasp.from_mesh(model.mesh, "point"), pose=pose).require()
    assert frame.is_converged and frame.is_reduced
    assert frame.energy == pytest.approx(full.energy, rel=0.02)
    np.testing.assert_allclose(frame.reaction_force, full.reaction_force,
                               atol=0.03 * np.linalg.norm(full.reaction_force))
    surface = np.unique(model.mesh.surface_faces())
    expected = (model.mesh.nodes + full.displacement)[surface]
    np.testing.assert_allclose(frame.positions, expected, atol=0.005 * 0.2)


@pytest.mark.slow
def test_the_newest_pose_wins(session):
    """Of many poses sent at once the last is answered, and not all the others."""
    before = session.latest().sequence
    for number in range(200):
        last = session.move(moved(session, x=0.0001 * number, z=-0.00001 * number))
    frame = session.wait(last)
    assert frame.move_id == last
    assert frame.sequence - before < 200
    target = session.wait(session.move(moved(session)))
    assert np.abs(frame.positions - target.positions).max() > 0.01


@pytest.mark.slow
def test_a_stiffer_branch_pulls_harder(session):
    """A change of Young's modulus takes effect on the next answer."""
    young = np.array(session.hello["young_pa"])
    pose = moved(session, x=0.02, z=-0.003)
    soft = session.wait(session.move(pose))
    session.set_young(2 * young)
    stiff = session.wait(session.move(pose))
    session.set_young(young)
    assert stiff.energy == pytest.approx(2 * soft.energy, rel=0.05)


@pytest.mark.slow
def test_what_is_not_understood_is_named_and_survived(session):
    """A broken command gets an error with its id; the session goes on."""
    session._child.process.stdin.write('{"command": "move", "id": 77, "pose": [1, 2]}\nnonsense\n')
    session._child.process.stdin.flush()
    assert session.wait_for("error", 5, count=2) is not None
    said = [line for line in session.events if line["event"] == "error"]
    assert said[0]["id"] == 77 and "pose.2" in said[0]["message"]
    assert "nonsense" in said[1]["message"]
    assert session.wait(session.move(moved(session, y=0.01))) is not None


@pytest.mark.slow
def test_motion_goes_on_and_comes_to_rest(session):
    """In dynamics frames keep coming, time advances, and the branch swings after a move."""
    session.wait(session.move(moved(session)))
    session.set_dynamics(True)
    session.move(moved(session, y=0.02, z=-0.003))
    time.sleep(1.0)
    first = session.latest()
    time.sleep(0.5)
    second = session.latest()
    session.set_dynamics(False)
    assert first.time > 0 and second.time > first.time
    assert second.sequence - first.sequence > 10
    assert second.kinetic_energy < 0.01 * second.energy


@pytest.mark.slow
def test_a_strange_client_needs_no_limber(branch_folder):
    """A program that knows only JSON and the file's layout gets positions; leaving ends it all."""
    process = subprocess.Popen([sys.executable, "-m", "limber.session.worker", str(branch_folder),
                                "--settings", '{"reduced": false}'], stdin=subprocess.PIPE,
                               stdout=subprocess.PIPE, text=True)
    hello = next(event for event in map(json.loads, process.stdout) if event["event"] == "hello")
    process.stdin.write(json.dumps({"command": "move", "id": 1, "pose": hello["rest_pose"]}) + "\n")
    process.stdin.flush()
    data = np.memmap(hello["positions"], np.uint8, "r")
    end = time.monotonic() + 30

    def numbers():
        sequence = int(data[40:48].view("<u8")[0])
        start, slot = data[56:72].view("<u8")
        at = int(start + sequence % 3 * slot)
        return at, data[at:at + 256].view("<f8")

    while (frame := numbers())[1][0] != 1 and time.monotonic() < end:
        time.sleep(0.01)
    at = frame[0] + 8 * (32 + 8 * 13)
    positions = data[at:at + 12 * hello["vertex_count"]].view("<f4").reshape(-1, 3)
    assert np.ptp(positions[:, 2]) == pytest.approx(0.2, rel=0.02)
    del positions, frame
    data = None
    process.stdin.close()
    assert process.wait(10) == 0
    process.stdout.close()
    assert not Path(hello["positions"]).exists()


@pytest.mark.slow
def test_the_session_dies_alone_and_its_client_says_so(branch_folder):
    """A killed session is an error at the next call, and leaves no file and no trainer."""
    session = InteractiveSession(branch_folder, **SMALL)
    children = psutil.Process(session.process_id).children()
    path = Path(session.hello["positions"])
    os.kill(session.process_id, signal.SIGKILL)
    with pytest.raises(WorkError, match="has ended"):
        for _ in range(200):
            session.move(moved(session))
            time.sleep(0.01)
    session.close()
    assert not path.exists()
    assert not left_alive(children, 20)


@pytest.mark.slow
def test_no_branch_no_session(tmp_path):
    """A folder that is none gives the reason."""
    with pytest.raises(WorkError, match=r"no folder|branch folder"):
        InteractiveSession(tmp_path / "none.branch")
