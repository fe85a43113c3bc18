"""Grasps, releases, weight and loads against the full model; bad commands to a real process."""

import json
import os
import shutil
import subprocess
import sys
import time

import numpy as np
import psutil
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.subjects.processes import left_alive

from limber.cli.main import call
from limber.core.errors import InputError, WorkError
from limber.core.json_values import plain
from limber.mechanics import BranchModel, Grasp, solve_static
from limber.session import client
from limber.session.client import InteractiveSession
from limber.session.frame_buffer import MAGIC, FrameReader, FrameWriter, HeldAt, Status
from limber.session.protocol import LINE_LIMIT, PROTOCOL, Lines, Move, NotUnderstood, parse_command
from limber.store import Branch
from limber.store.loading import load_model


@pytest.fixture(scope="module")
def session(branch_folder):
    """A session that the full model answers; nothing is held at the start."""
    with InteractiveSession(branch_folder, grasp=False, reduced=False) as running:
        yield running


@pytest.fixture(scope="module")
def model(branch_folder) -> BranchModel:
    return load_model(Branch.open(branch_folder)).as_scanned()


def settled(session, number: int):
    """The frame in which what was asked has been reached."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        frame = session.wait(number, 10)
        if frame is not None and (frame.is_reached or not frame.is_converged):
            return frame
        time.sleep(0.01)
    raise AssertionError("not reached")


def tip_vertex(session) -> int:
    return int(session.latest().positions[:, 2].argmax())


def test_two_grasps_and_a_release(session, model):
    """Both grasps' forces and the surface are those of the full model; let go, it springs back."""
    assert not session.hello["grasps"]
    rest = session.latest().positions
    one = session.grab(point=[0.0, 0.0, 0.1], mode="rigid", radius=0.011)
    two = session.grab(vertex=tip_vertex(session), radius=0.011)
    numbers = [one["grasp"], two["grasp"]]
    assert numbers[1] == numbers[0] + 1
    first = np.array(one["pose"]) + [0.01, 0, 0, 0, 0.1, 0]
    # A little in tension: pushed together, it could buckle to either side.
    second = np.array(two["pose"]) + [0.02, 0.01, -0.0005, 0, 0, 0]
    session.move(first, grasp=numbers[0])
    frame = settled(session, session.move(second, grasp=numbers[1]))
    grasps = [Grasp.at(model.mesh, [0, 0, 0.1], 0.011, "rigid"),
              Grasp.at(model.mesh, rest[rest[:, 2].argmax()], 0.011, "point")]
    full = solve_static(model, grasp=grasps, pose=np.array([first, second])).require()
    assert frame.status == Status.full and frame.is_trusted
    assert [held.number for held in frame.grasps] == numbers
    for held, force, torque in zip(frame.grasps, full.reaction_force, full.reaction_torque,
                                   strict=True):
        np.testing.assert_allclose(held.force, force, atol=1e-4 * np.abs(force).max())
        np.testing.assert_allclose(held.torque, torque, atol=1e-4 * np.abs(torque).max() + 1e-9)
    assert frame.energy == pytest.approx(full.energy, rel=1e-4)
    assert frame.min_det_f == pytest.approx(full.min_det_f, rel=1e-4)
    # The greatest strain is where a clamped grasp ends or at the base, and the colours show it.
    assert frame.greatest_strain > 0.001
    assert frame.strains.max() == pytest.approx(frame.greatest_strain, rel=1e-4)
    assert np.abs(frame.positions - frame.strain_place).sum(axis=1).min() < 0.01
    reply = session.release(numbers[0])
    assert reply["grasps"] == numbers[1:]
    free = settled(session, session.release()["id"])
    np.testing.assert_allclose(free.positions, rest, atol=1e-6)
    assert abs(free.energy) < 1e-9 and not free.grasps


def test_a_hung_weight_is_a_force(session, model):
    """Loads displace the branch as nodal forces do, and gravity can be switched."""
    session.release()
    vertex = tip_vertex(session)
    reply = session.set_loads([{"vertex": vertex, "force_n": [0.05, 0, 0]}])
    frame = settled(session, reply["id"])
    surface = np.unique(model.mesh.surface_faces())
    forces = np.zeros_like(model.mesh.nodes)
    forces[surface[vertex], 0] = 0.05
    full = solve_static(model, nodal_forces=forces).require()
    np.testing.assert_allclose(frame.positions, (model.mesh.nodes + full.displacement)[surface],
                               atol=1e-6)
    assert frame.gravity_on
    session.set_loads([])


def test_without_weight_the_branch_rises(session, branch_folder):
    """Weight taken away is the shape without stress that inverse statics finds."""
    from limber.mechanics.statics.rest_shape import unloaded_rest_shape

    session.release()
    prestress = settled(session, session.set_gravity(True)["id"])
    light = settled(session, session.set_gravity(False)["id"])
    session.set_gravity(True)
    assert prestress.gravity_on and not light.gravity_on
    scanned = load_model(Branch.open(branch_folder))
    surface = np.unique(scanned.mesh.surface_faces())
    np.testing.assert_allclose(prestress.positions, scanned.mesh.nodes[surface], atol=1e-7)
    expected = unloaded_rest_shape(scanned).nodes[surface]
    rise = np.abs(expected - prestress.positions).max()
    assert rise > 1e-6
    np.testing.assert_allclose(light.positions, expected, atol=0.05 * rise)


@pytest.mark.parametrize(("command", "fields", "words"), [
    ("move", {"pose": [0, 0, 0.1, 0, 0, 0]}, "No grasp is held"),
    ("grasp", {"vertex": 10**9}, "no vertex"),
    ("grasp", {"point": [5.0, 0, 0]}, "No node lies"),
    ("grasp", {"point": [0.0, 0, 0], "radius_m": 0.01}, "fixed base"),
    ("release", {"grasp": 99}, "No grasp is held|no grasp"),
    ("young", {"young_pa": [1e7] * 999}, "999 moduli"),
    ("dynamics", {"on": True}, "reduced model"),
    ("hello", {"protocol": PROTOCOL + 1}, "different versions"),
])
def test_what_cannot_be_done_is_refused(session, command, fields, words):
    """Each gets an error with the reason, and the session goes on."""
    session.release()
    with pytest.raises(InputError, match=words):
        session.request(command, **fields)
    assert session.request("status")["grasps"] == []
    assert session.request("hello", protocol=PROTOCOL)["event"] == "reply"


@pytest.mark.slow
def test_grasps_do_not_overlap(session):
    """One node cannot follow two grippers."""
    session.release()
    session.grab(point=[0.0, 0.0, 0.15], radius=0.02)
    with pytest.raises(InputError, match="another grasp"):
        session.grab(point=[0.0, 0.0, 0.16], radius=0.02)
    assert len(session.request("status")["grasps"]) == 1
    session.release()


@pytest.mark.slow
def test_another_protocol_is_refused_by_the_client(branch_folder, monkeypatch):
    """A session of another version is not talked to, and both versions are named."""
    monkeypatch.setattr(client, "PROTOCOL", PROTOCOL + 1)
    with pytest.raises(WorkError, match=f"speaks protocol {PROTOCOL} .* this client"):
        InteractiveSession(branch_folder, reduced=False)


def test_damaged_frame_files_are_refused(tmp_path):
    """No size of a header is believed that the file cannot hold."""
    writer = FrameWriter(tmp_path / "frames", np.array([[0, 1, 2]]), 3, target_count=2)
    writer.publish(np.ones((3, 3)), targets=np.arange(6.0).reshape(2, 3), status=Status.full,
                   grasps=(HeldAt(4, np.arange(6.0), np.ones(3), np.zeros(3)),))
    whole = (tmp_path / "frames").read_bytes()
    reader = FrameReader(tmp_path / "frames")
    frame = reader.read()
    np.testing.assert_array_equal(frame.targets, np.arange(6.0).reshape(2, 3))
    assert frame.grasps[0].number == 4 and frame.status == Status.full
    reader.close()
    writer.close()
    path = tmp_path / "damaged"
    rng = np.random.default_rng(0)
    for number in range(300):
        damaged = bytearray(whole[:rng.integers(8, len(whole))] if number % 3 == 0 else whole)
        for at in rng.integers(8, min(len(damaged), 80), 4):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            reader = FrameReader(path)
        except InputError:
            continue
        reader.close()
    assert whole.startswith(MAGIC)


class _Process:
    """A session's process, spoken to in bytes."""

    def __init__(self, folder):
        self.process = subprocess.Popen(
            [sys.executable, "-m", "limber.session.worker", str(folder), "--settings",
             json.dumps({"reduced": False})], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.hello = json.loads(self.process.stdout.readline())
        self.asked = 0

    def send(self, content: bytes) -> None:
        self.process.stdin.write(content)
        self.process.stdin.flush()

    def answers(self) -> list[dict]:
        """Ask for the status; return all events up to its reply."""
        self.asked += 1
        number = 10**9 + self.asked
        self.send(b"\n" + json.dumps({"command": "status", "id": number}).encode() + b"\n")
        events = []
        while True:
            events.append(json.loads(self.process.stdout.readline()))
            if events[-1].get("id") == number:
                return events

    def close(self) -> int:
        self.process.stdin.close()
        code = self.process.wait(15)
        self.process.stdout.close()
        return code


@pytest.fixture(scope="module")
def process(branch_folder):
    running = _Process(branch_folder)
    yield running
    assert running.close() == 0


COMMANDS = st.sampled_from([
    '{"command": "move", "id": 1, "pose": [0, 0, 0.14, 0, 0, 0]}', '{"command": "status"}',
    '{"command": "grasp", "vertex": 30}', '{"command": "release"}',
    '{"command": "loads", "loads": [{"vertex": 3, "force_n": [0, 0, -0.01]}]}',
    '{"command": "gravity", "on": true}', '{"command": "young", "young_pa": [1e8]}'])


@given(COMMANDS, st.lists(st.tuples(st.floats(0, 1), st.binary(min_size=0, max_size=3),
                                    st.integers(0, 4)), min_size=1, max_size=4))
@settings(max_examples=60, deadline=20_000, suppress_health_check=list(HealthCheck))
def test_no_mutation_of_a_command_ends_a_session(process, command, changes):
    """Bytes put in and cut out anywhere: the session answers the next command, in bounded time."""
    line = command.encode()
    for place, added, cut in changes:
        at = int(place * len(line))
        line = line[:at] + added + line[at + cut:]
    line = b" ".join(part for part in line.split(b"\n") if b"close" not in part)
    process.send(line)
    assert process.answers()[-1]["event"] == "reply"


@pytest.mark.slow
@pytest.mark.parametrize("line", [
    b'{"command": "move", "id": 1e400, "pose": [0, 0, 0.14, 0, 0, 0]}',
    b"[" * 200_000, b"\xff\xfe\xfa", b"x" * (3 << 20),
], ids=["id", "deep", "bytes", "long"])
def test_what_killed_the_reading_thread_gets_an_error(process, line):
    """An id of 1e400, deep JSON, bytes that are no text, an endless line: said, and survived."""
    process.send(line)
    events = process.answers()
    assert [event["event"] for event in events] == ["error", "reply"]


def test_an_endless_line_takes_no_memory(process):
    """100 MB without a newline leave the process as large as it was."""
    before = psutil.Process(process.process.pid).memory_info().rss
    for _ in range(100):
        process.send(b"x" * (1 << 20))
    assert process.answers()[0]["event"] == "error"
    grown = psutil.Process(process.process.pid).memory_info().rss - before
    assert grown < 40 << 20


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="SIGSTOP and pipes as on POSIX")
def test_the_session_ends_with_a_client_that_was_killed(branch_folder, tmp_path):
    """A client killed in the middle of a move leaves no process and no file."""
    script = (
        "import numpy as np, sys, time\n"
        "from limber.session.client import InteractiveSession\n"
        # So much to learn that it would go on for a quarter of an hour.
        f"s = InteractiveSession({str(branch_folder)!r}, grasps=9000, cache=False)\n"
        "print(s.process_id, s.hello['positions'], flush=True)\n"
        "while True:\n"
        "    s.move(np.array(s.hello['rest_pose']) + [0.05, 0, 0, 0, 0, 0]); time.sleep(0.01)\n")
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE,
                          text=True) as holder:
        number, path = holder.stdout.readline().split(maxsplit=1)
        family = [psutil.Process(int(number))]
        family += family[0].children(recursive=True)
        holder.kill()
    assert not left_alive(family, 20)
    assert not os.path.exists(path.strip())


@pytest.mark.slow
def test_the_command_is_a_session(branch_folder, tmp_path, capsys):
    """`limber session` speaks the protocol; a folder that is none ends it with code 2."""
    command = [sys.executable, "-m", "limber", "session", str(branch_folder)]
    with subprocess.Popen([*command, "--no-reduced", "--no-grasp"],
                          stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        hello = json.loads(process.stdout.readline())
        assert (hello["protocol"], hello["grasps"]) == (PROTOCOL, [])
        process.stdin.close()
        assert json.loads(process.stdout.readline())["event"] == "closed"
        assert process.wait(15) == 0
    assert call(["session", str(tmp_path)]) == 2
    assert json.loads(capsys.readouterr().out)["event"] == "failed"


@pytest.mark.slow
def test_named_targets_are_followed(branch_folder, tmp_path):
    """A target of the folder is in each frame, where the surface about it has gone."""
    folder = tmp_path / "beam.branch"
    shutil.copytree(branch_folder, folder)
    targets = [{"name": "flower", "position_m": [0.0, 0.0, 0.18], "mass_kg": 0.002}]
    with Branch.open(folder).stage("target") as stage:
        stage.path("targets.json").write_text(json.dumps({"format_version": 1, "targets": targets}))
    with InteractiveSession(folder, reduced=False, mode="point") as session:
        assert session.hello["targets"] == ["flower"]
        rest = session.latest()
        np.testing.assert_allclose(rest.targets, [[0, 0, 0.18]], atol=1e-6)
        pose = np.array(session.hello["rest_pose"]) + [0.02, 0, 0, 0, 0, 0]
        frame = settled(session, session.move(pose))
        about = np.abs(rest.positions[:, 2] - 0.18) < 0.011
        moved = (frame.positions - rest.positions)[about].mean(axis=0)
        np.testing.assert_allclose(frame.targets[0] - rest.targets[0], moved, atol=1e-3)
        assert frame.targets[0, 0] > 0.02


# What a client may send: whatever it is, it is a command or is refused, in bounded memory.

GOOD = [
    {"command": "hello", "protocol": PROTOCOL},
    {"command": "grasp", "vertex": 3, "mode": "rigid", "radius_m": 0.02},
    {"command": "grasp", "point": [0.0, 0.1, 0.2]},
    {"command": "release"}, {"command": "release", "grasp": 2},
    {"command": "move", "id": 5, "pose": [0, 0, 0.2, 0.0, 0.1, 0]},
    {"command": "loads", "loads": [{"vertex": 1, "force_n": [0, 0, -1]}]},
    {"command": "gravity", "on": False}, {"command": "dynamics", "on": True},
    {"command": "young", "young_pa": [1e7, 2e7]},
    {"command": "status"}, {"command": "close"},
]
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=7) | st.dictionaries(
        st.sampled_from(["command", "id", "pose", "vertex", "loads", "force_n"]), inner),
    max_leaves=12)


@pytest.mark.parametrize("command", GOOD, ids=lambda command: command["command"])
def test_every_command_is_understood(command):
    """What the documentation says may be sent, may."""
    assert parse_command(json.dumps(command).encode()).command == command["command"]


@pytest.mark.parametrize(("line", "words"), [
    (b'{"command": "move", "id": 1e400, "pose": [0, 0, 0, 0, 0, 0]}', "whole number"),
    (b'{"command": "move", "id": ' + b"9" * 5000 + b', "pose": [0, 0, 0, 0, 0, 0]}', "JSON"),
    (b'{"command": "move", "pose": [NaN, 0, 0, 0, 0, 0]}', "finite"),
    (b'{"command": "move", "pose": [1e300, 0, 0, 0, 0, 0]}', "1000"),
    (b'{"command": "move", "pose": [0, 0, 0, 0, 0, 0], "id": true}', "whole number"),
    (b"[" * 100_000, "JSON"),
    (b"\xff\xfe\x00", "JSON"),
    (b"{}", "command"),
    (b'{"command": ["move"]}', "move"),
    (b'{"command": "grasp"}', "either"),
    (b'{"command": "grasp", "vertex": 1, "point": [0, 0, 0]}', "either"),
    (b'{"command": "young", "young_pa": [0]}', "greater than 0"),
    (b'{"command": "close", "more": 1}', "more"),
])
def test_what_is_no_command_is_refused_with_its_reason(line, words):
    """One error type, whatever is wrong: numbers too large, JSON too deep, no text, no field."""
    with pytest.raises(NotUnderstood, match=words):
        parse_command(line)


@pytest.mark.slow
@given(st.sampled_from(GOOD), st.sampled_from(["command", "id", "pose", "grasp", "on", "loads"]),
       VALUES)
@settings(max_examples=300, deadline=None)
def test_a_mutated_command_is_a_command_or_is_refused(command, name, value):
    """No value anywhere raises anything else, and an error carries the id where there is one."""
    line = json.dumps(command | {name: value}).encode()
    try:
        parsed = parse_command(line)
    except NotUnderstood as error:
        assert 0 <= error.reply_id <= 2**53
        assert len(str(error)) < 2000
    else:
        assert 0 <= parsed.id <= 2**53
        if isinstance(parsed, Move):
            assert len(parsed.pose) == 6 and all(abs(x) <= 1e6 for x in parsed.pose)


@given(st.binary(max_size=400))
@settings(max_examples=300, deadline=None)
def test_bytes_of_any_kind_are_refused(line):
    """A line of noise is an error and nothing worse."""
    with pytest.raises(NotUnderstood):
        parse_command(line)


@pytest.mark.slow
@given(st.lists(st.binary(max_size=30), max_size=12), st.data())
@settings(max_examples=200, deadline=None)
def test_lines_do_not_depend_on_how_they_are_cut(lines, data):
    """Pieces of any size give the lines that were sent; those over the limit give None."""
    lines = [line.replace(b"\n", b"") for line in lines]
    stream, limit = b"".join(line + b"\n" for line in lines), 20
    reader, found = Lines(limit), []
    while stream:
        size = data.draw(st.integers(1, len(stream)))
        found += reader.feed(stream[:size])
        stream = stream[size:]
    assert found == [line if len(line) <= limit else None for line in lines]


def test_a_line_without_an_end_takes_no_memory():
    """128 MB without a newline is dropped as it comes; the next line is read again."""
    reader = Lines()
    piece = b"x" * (1 << 16)
    for _ in range(1 << 11):
        assert list(reader.feed(piece)) == []
        assert len(reader._part) <= LINE_LIMIT
    assert list(reader.feed(b'\n{"command": "close"}\n')) == [None, b'{"command": "close"}']


def test_what_is_not_finite_becomes_null():
    """Events are JSON for every reader: NaN and infinity are not."""
    import numpy as np

    line = plain({"a": np.array([1.0, np.nan]), "b": [np.inf, {"c": np.float32(2)}]})
    assert json.dumps(line, allow_nan=False) == '{"a": [1.0, null], "b": [null, {"c": 2.0}]}'
