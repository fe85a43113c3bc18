"""`limber record` on the virtual robot that holds a branch, and what it refuses."""

import json
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.robot.test_realsense import Library

from benchmarks.robot_cells import (
    cell_file,
    robot_holding,
    sideways,
    standing_at,
    stepped_robot_holding,
)
from benchmarks.robot_faults import restored
from limber.cell.cell_file import CameraEntry, Cell
from limber.cell.known_arms import arm_named
from limber.cli.stage_command import StageCommand
from limber.cli.virtual_camera import VirtualCamera
from limber.core.errors import BranchFolderError, InputError, NoPathError, SafetyStop, WorkError
from limber.core.numerics.rigid import matrices
from limber.core.progress import SILENT
from limber.geometry.cloud.camera import D455
from limber.perception.observe import observe
from limber.recordings.recording import read_pull
from limber.robot.motion.trajectory import Trajectory
from limber.robot.recorder import MarkerStream, PullRecorder, known_errors
from limber.stages.pulls.record import RecordPull, _remove_empty
from limber.stages.pulls.record_path import arc_path, suggested_pull, there_and_back, waypoint_path
from limber.stages.pulls.record_prediction import PullModel
from limber.store import Branch
from limber.store.loading import load_skeleton

pytest.importorskip("rtde_control")

MARKERS = 63400


def sideways_pull(branch_folder, **changes) -> dict:
    direction = tuple(map(float, sideways(Branch.open(branch_folder))))
    return {"direction": direction, "distance": 0.012, "speed": 0.01, "pause": 0.2,
            "shape": "straight", **changes}


def cell_at(branch_folder, address, **limits) -> Cell:
    return standing_at(Branch.open(branch_folder), address, grip_seconds=0.3, **limits)


@pytest.fixture(scope="module")
def shared_robot(branch_template, worker_address, tmp_path_factory):
    """With the branch between its jaws; every test's folder is a copy of that branch's."""
    cell = cell_at(branch_template, worker_address)
    with robot_holding(Branch.open(branch_template), cell, tmp_path_factory.mktemp("truth")) as it:
        yield it


@pytest.fixture(scope="module")
def shared_stepped(branch_template, own_address, tmp_path_factory):
    """The same without its process, in its own time."""
    cell = cell_at(branch_template, own_address)
    return stepped_robot_holding(Branch.open(branch_template), cell,
                                 tmp_path_factory.mktemp("truth"))


@pytest.fixture
def _soon(monkeypatch):
    """Before a pull a robot is waited for less than beside a real branch."""
    monkeypatch.setattr("limber.stages.pulls.record._TARE_SECONDS", 0.3)
    monkeypatch.setattr("limber.stages.pulls.record._SETTLE_SECONDS", 0.2)


@pytest.fixture
def robot(shared_robot, _soon):
    restored(shared_robot)
    return shared_robot


@pytest.fixture
def stepped(shared_stepped, _soon):
    with shared_stepped.here():
        restored(shared_stepped)
        yield shared_stepped


def test_a_recorded_pull_is_what_the_branch_did(branch_folder, tmp_path, robot):
    """No sample lost; the piece goes out and back; force rises and falls; markers beside it."""
    path = cell_file(cell_at(branch_folder, robot.address), tmp_path)
    result = RecordPull(branch_folder=branch_folder, cell=path, name="robot-1",
                        **sideways_pull(branch_folder, speed=0.02), confirm="robot-1",
                        markers=MARKERS).run()
    assert result["ended"] == "reached" and result["marker_frames"] > 5
    pull = read_pull(branch_folder / "pulls" / "robot-1")
    assert np.diff(pull.times) == pytest.approx(np.full(len(pull.times) - 1, 0.002), abs=1e-5)
    start = np.array(pull.entry.grasp.point_m)
    assert pull.poses[0, :3] == pytest.approx(start, abs=1e-4)
    away = np.linalg.norm(pull.poses[:, :3] - start, axis=1)
    assert away.max() == pytest.approx(0.012, abs=3e-4) and away[-1] < 5e-4
    farthest = int(away.argmax())
    direction = sideways(Branch.open(branch_folder))
    assert pull.poses[farthest, :3] - start == pytest.approx(0.012 * direction, abs=3e-4)
    # The gripper pulls the branch the way it goes; the noise is 0.15 N.
    force = pull.wrenches[:, :3]
    assert force[farthest - 50:farthest + 50].mean(axis=0) @ direction > 0.3
    seen = pull.observations
    assert seen.positions[-1] == pytest.approx(seen.positions[0], abs=3e-3)


def test_nothing_moves_without_a_typed_name(branch_folder, tmp_path):
    path = cell_file(standing_at(Branch.open(branch_folder), "127.0.0.98"), tmp_path)
    for confirm in (None, "something"):
        with pytest.raises(InputError, match="Nobody confirmed"):
            RecordPull(branch_folder=branch_folder, cell=path, name="r", confirm=confirm).run()


@pytest.mark.slow
def test_a_recording_that_never_began_leaves_nothing(branch_folder, tmp_path):
    """Nobody answers at the address: the name stays free, nothing is told to be cut off."""
    path = cell_file(standing_at(Branch.open(branch_folder), "127.0.0.98"), tmp_path)
    for _ in range(2):
        with pytest.raises(WorkError, match="No robot answers"):
            RecordPull(branch_folder=branch_folder, cell=path, name="r", confirm="r").run()
    assert Branch.open(branch_folder).streams() == []


def test_a_cell_of_another_branch_is_refused(branch_folder, tmp_path):
    cell = standing_at(Branch.open(branch_folder), "127.0.0.98")
    path = cell_file(cell.model_copy(update={"branch": "another"}), tmp_path)
    with pytest.raises(InputError, match="calibrated for branch another"):
        RecordPull(branch_folder=branch_folder, cell=path, name="r", confirm="r").run()


@pytest.mark.slow
def test_a_stop_keeps_what_was_recorded(branch_folder, tmp_path, stepped):
    """A force limit that the pull breaks: exit 4, a recording that says where it ended."""
    cell = cell_at(branch_folder, stepped.address, soft_force_n=1.2, hard_force_n=1.4)
    with pytest.raises(SafetyStop, match=r"force limit.*samples are in"):
        RecordPull(branch_folder=branch_folder, cell=cell_file(cell, tmp_path), name="stopped",
                   **sideways_pull(branch_folder), confirm="stopped").run()
    assert np.linalg.norm(stepped.state["tool_speed"]) < 1e-3
    found = Branch.open(branch_folder).manifest.stages["record:stopped"].result
    assert "force limit" in found["ended"] and found["sample_count"] > 100
    assert read_pull(branch_folder / "pulls" / "stopped").entry.observation == "none"


def flange_of(robot) -> np.ndarray:
    """Position of the flange, base frame [m]; a tool that is set does not move it."""
    return arm_named(robot.model).forward(np.array(robot.state["joints"]))[:3, 3]


@contextmanager
def after_a_way(robot, way: float, action: str, **values):
    """Do ``action`` in the robot once its flange is ``way`` [m] away from where it stood."""
    start = flange_of(robot)

    def watch() -> None:
        if np.linalg.norm(robot.controller.flange[:3, 3] - start) > way:
            robot.each_step = lambda: None
            robot.ask(action, **values)
    robot.each_step = watch
    yield


@pytest.mark.slow
def test_a_pull_is_predicted_at_a_gripper_that_yields(branch_folder):
    """Fingers and branch are springs in a row: along its axis the branch is the stiffer one."""
    cell = cell_at(branch_folder, "127.0.0.1")
    point, branch = np.array([0.0, 0.0, 0.2]), Branch.open(branch_folder)
    forces = {}
    for compliance in (0.0, 1e-4):
        cell = cell.model_copy(update={"tool": cell.tool.model_copy(
            update={"compliance_m_per_n": compliance})})
        model = PullModel.of_branch(branch, cell, point, SILENT)
        poses = np.zeros((2, 6))
        poses[1, :3] = 1e-3 * matrices(np.array(cell.base.pose))[2, :3]
        forces[compliance] = model.predicted(Trajectory(np.array([0.0, 1.0]), poses)).forces[-1]
    stiffness = model.stiffness
    wanted = np.linalg.solve(np.eye(3) + 1e-4 * stiffness, forces[0.0])
    assert forces[1e-4] == pytest.approx(wanted, rel=0.05, abs=0.02)
    assert np.linalg.norm(forces[1e-4]) < 0.7 * np.linalg.norm(forces[0.0])


@pytest.mark.slow
def test_a_sensor_that_a_nudge_finds_wrong_stops_before_the_pull(branch_folder, tmp_path, stepped,
                                                                 monkeypatch):
    """The prediction is turned round instead of the sensor: nothing is recorded, the name is free.
    """
    predicted, motions = PullModel.predicted, []

    def turned_round(model: PullModel, trajectory):
        found = predicted(model, trajectory)
        motions.append(trajectory)
        return found if len(motions) == 1 else replace(found, forces=-found.forces)
    monkeypatch.setattr(PullModel, "predicted", turned_round)
    begin = flange_of(stepped)
    path = cell_file(cell_at(branch_folder, stepped.address), tmp_path)
    with pytest.raises(SafetyStop, match="implausible: the force points against") as stop:
        RecordPull(branch_folder=branch_folder, cell=path, name="turned",
                   **sideways_pull(branch_folder), confirm="turned").run()
    assert stop.value.result["sample_count"] == 0
    assert np.linalg.norm(flange_of(stepped) - begin) < 0.005
    assert np.linalg.norm(stepped.state["tool_speed"]) < 1e-3
    branch = Branch.open(branch_folder)
    assert branch.streams() == [] and not branch.has("pulls/turned/pull.toml")


@pytest.mark.slow
@pytest.mark.parametrize("action, values, told", [
    ("creep", {"part": 1.0}, "slips slowly in the gripper"),
    ("tool", {"offset": [0.005, 0, 0.15, 0, 0, 0]}, "tool centre point in the controller was")])
def test_what_goes_wrong_during_a_pull_is_noticed_within_ten_millimetres(
        branch_folder, tmp_path, stepped, action, values, told):
    """From 6 mm on, which the nudge does not reach, the branch slides in the jaws; the tool is set
    anew on the pendant.
    """
    path = cell_file(cell_at(branch_folder, stepped.address), tmp_path)
    begin = flange_of(stepped)
    with after_a_way(stepped, 0.006, action, **values), pytest.raises(SafetyStop, match=told):
        RecordPull(branch_folder=branch_folder, cell=path, name="wrong",
                   **sideways_pull(branch_folder, distance=0.03, speed=0.02),
                   confirm="wrong").run()
    assert 0.006 < np.linalg.norm(flange_of(stepped) - begin) < 0.016
    assert np.linalg.norm(stepped.state["tool_speed"]) < 1e-3


@pytest.mark.slow
def test_a_pull_against_something_stiff_is_let_back_after_its_pause(branch_folder, tmp_path,
                                                                    stepped, capfd):
    """Along its axis a branch is stiff: 30 N within a millimetre or two, and more on the way."""
    skeleton = load_skeleton(Branch.open(branch_folder))
    axis = skeleton.point_at(0.92) - skeleton.point_at(0.87)
    path = cell_file(cell_at(branch_folder, stepped.address), tmp_path)
    with pytest.raises(SystemExit) as stop:
        StageCommand(RecordPull).main(
            [str(branch_folder), "--cell", str(path), "--name", "stiff", "--confirm", "stiff",
             "--after-stop", "retreat", "--shape", "straight", "--direction", *map(str, axis),
             "--distance", "0.03", "--speed", "0.007", "--json"], standalone_mode=False)
    out, errors = capfd.readouterr()
    told = json.loads(out.splitlines()[-1])
    assert stop.value.code == 4, (told, errors, stepped.state)
    assert "force limit" in told["ended"] and told["peak_force_n"] > 30
    after = told["after_stop"]
    assert after["choice"] == "retreat" and after["retreated"] and not after["gripper_opened"]
    assert after["force_n"] < 3
    assert after["outcome"] in told["error"] and after["outcome"] in errors


def test_a_killed_recording_is_taken_over(branch_folder, tmp_path, robot):
    """kill -9 in the middle: the arm stops, all but the last second is there afterwards."""
    branch = Branch.open(branch_folder)
    path = cell_file(cell_at(branch_folder, robot.address), tmp_path)
    process = subprocess.Popen(
        [sys.executable, "-m", "limber", "record", str(branch_folder), "--cell", str(path),
         "--name", "cut", "--confirm", "cut", "--direction", *(str(x) for x in sideways(branch)),
         "--distance", "0.03", "--speed", "0.006", "--json"],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    end = time.monotonic() + 60
    # Rows begin with the pull, after the nudge.
    while not any(path.read_text().count("\n") > 50 for path in branch_folder.rglob("robot.csv")
                  if path.parent.name == "cut"):
        assert time.monotonic() < end and process.poll() is None, process.stdout.read()
        time.sleep(0.02)
    begin = robot.state["clock"]
    time.sleep(1.4)
    killed = robot.state["clock"]
    process.send_signal(signal.SIGKILL)
    process.wait()
    time.sleep(0.5)
    assert np.linalg.norm(robot.state["tool_speed"]) < 1e-3
    branch = Branch.open(branch_folder)
    assert "pulls/cut/robot.csv" in branch.streams()
    result = RecordPull(branch_folder=branch_folder, cell=path, name="cut", recover=True).run()
    assert result["seconds"] > killed - begin - 1.0
    pull = read_pull(branch_folder / "pulls" / "cut")
    assert np.all(np.diff(pull.times) > 0) and np.isfinite(pull.poses).all()


def test_a_recording_killed_before_its_pull_leaves_its_name_free(branch_folder, tmp_path):
    """Its title line alone is no recording: it cannot be recovered, and blocks nothing."""
    branch = Branch.open(branch_folder)
    path = cell_file(standing_at(branch, "127.0.0.98"), tmp_path)
    with branch.stream("pulls/cut/robot.csv") as lines:
        lines.append("t_s,x_m")
    with pytest.raises(InputError, match="before its pull began"):
        RecordPull(branch_folder=branch_folder, cell=path, name="cut", recover=True).run()
    # No robot answers there: it got as far as that.
    with pytest.raises(WorkError, match="No robot answers"):
        RecordPull(branch_folder=branch_folder, cell=path, name="cut", confirm="cut").run()
    _remove_empty(branch, "cut")
    assert branch.streams() == []


def test_the_piece_moves_with_the_gripper_as_one_body():
    """A gripper turned about its own middle carries the piece round; its torque moves along."""
    lines = []

    class Lines:
        def append(self, line: str) -> None:
            lines.append(line)

    recorder = PullRecorder(Lines(), np.array([0.0, 0.01, 0.5]))
    sample = np.full((1, 31), np.nan)
    sample[0, :13] = [5.0, 0, 0, 0.5, 0, 0, 0, 1.0, 0, 0, 0, 0, 0]
    recorder.take(sample)
    assert len(lines) == 1
    recorder.close_gripper()
    turned = sample.copy()
    turned[0, 0], turned[0, 6] = 5.002, np.pi / 2
    recorder.take(np.vstack([sample, turned]))
    rows = np.array([[float(x) for x in line.split(",")] for line in lines[1:]])
    assert rows[0, 1:7] == pytest.approx([0, 0.01, 0.5, 0, 0, 0])
    assert rows[1, 1:7] == pytest.approx([-0.01, 0, 0.5, 0, 0, np.pi / 2], abs=1e-6)
    # Force 1 N along x at the gripper: about the piece, 10 mm beside it, 0.01 N m about z.
    assert rows[0, 7:] == pytest.approx([1, 0, 0, 0, 0, 0.01], abs=1e-9)


def test_the_piece_stays_behind_by_what_gripper_and_arm_give_way():
    recorder = PullRecorder(lines := Appended(), np.array([0.0, 0.0, 0.5]), compliance=1e-4)
    sample = np.full((1, 37), np.nan)
    sample[0, :19] = [5.0, 0, 0, 0.5, *(0,) * 15]
    recorder.take(sample)
    recorder.close_gripper()
    pulled = sample.copy()
    pulled[0, [0, 1, 7, 13]] = [5.5, 0.02, 6.0, 6.0]
    recorder.take(pulled)
    row = [float(x) for x in lines[-1].split(",")]
    assert row[1:4] == pytest.approx([0.02 - 6e-4, 0, 0.5])


class Appended(list):
    """Lines of a stream."""


def test_an_arc_stretches_nothing(branch_folder):
    """It goes as far as asked across the branch, comes nearer to the root, and turns with it."""
    branch = Branch.open(branch_folder)
    skeleton = load_skeleton(branch)
    point, way = skeleton.point_at(0.9), sideways(branch)
    frames = arc_path(branch, point, way, 0.04, SILENT)
    assert frames[0] == pytest.approx(np.eye(4), abs=1e-9)
    moved = frames[:, :3, :3] @ point + frames[:, :3, 3]
    away = moved - moved[0]
    assert np.linalg.norm(away[-1]) == pytest.approx(0.04, rel=0.05)
    assert away[-1] @ way == pytest.approx(np.linalg.norm(away[-1]), rel=0.05)
    chord = np.linalg.norm(moved - skeleton.nodes[0], axis=1)
    assert np.all(np.diff(chord) < 0)
    turn = Rotation.from_matrix(frames[-1, :3, :3]).as_rotvec()
    assert np.linalg.norm(turn) > 0.04 / np.linalg.norm(point - skeleton.nodes[0])
    assert abs(turn @ way) < 0.3 * np.linalg.norm(turn)


def test_a_suggested_pull_is_taken_where_it_holds_the_branch(branch_folder):
    branch, point = Branch.open(branch_folder), np.array([0.0, 0.0, 0.4])
    with pytest.raises(BranchFolderError, match="suggest"):
        suggested_pull(branch, point)
    best = {"grasp_point_m": [0.0, 0.0, 0.4], "end_m": [0.03, 0.0, 0.396], "travel_m": 0.0303}
    with branch.stage("suggest-pull") as stage:
        stage.path("suggested_pull.json").write_text(json.dumps({"best": best, "others": []}))
    direction, distance = suggested_pull(branch, point + 0.004)
    assert direction == pytest.approx([0.03, 0, 0]) and distance == 0.0303
    with pytest.raises(InputError, match="20 mm from where the suggested pull"):
        suggested_pull(branch, point - [0, 0, 0.02])


def test_way_points_begin_at_the_gripper(tmp_path):
    path = tmp_path / "way.csv"
    gripper = np.array([0.1, 0.0, 0.4, 0.0, 0.0, 0.2])
    path.write_text("x_m,y_m,z_m\n0.101,0,0.4\n0.12,0,0.4\n0.12,0.02,0.39\n")
    frames = waypoint_path(path, gripper)
    assert frames[:, :3, 3] == pytest.approx(np.array(
        [[0.1, 0, 0.4], [0.12, 0, 0.4], [0.12, 0.02, 0.39]]))
    assert frames[:, :3, :3] == pytest.approx(np.tile(frames[0, :3, :3], (3, 1, 1)))
    with pytest.raises(InputError, match=r"10\.0 mm away from the gripper"):
        waypoint_path(path, gripper + np.r_[-9e-3, np.zeros(5)])


def test_way_points_out_of_reach_are_refused(tmp_path):
    """Before anything moves; said with the place, and how far the arm comes."""
    path = tmp_path / "way.csv"
    path.write_text("x_m,y_m,z_m\n0,0,0.5\n0,0,0.55\n-0.9,0,0.55\n")
    cell = Cell(robot={"model": "ur5e"}, base={"pose": (0.55, 0.1, 0.0, 0, 0, 0.4)},
                tool={"grasp_pose": (0, 0, 0.15, 0, 0, 0)})
    frames = waypoint_path(path, np.array([0.0, 0.0, 0.5, 0, 1.2, 0]))
    with pytest.raises(NoPathError, match=r"out of the arm.s reach.*nearer"):
        there_and_back(cell, frames, speed=0.03, cycles=1, pause=0.5)


def test_out_and_back_takes_as_long_each_way():
    cell = Cell(robot={"model": "ur5e"}, base={"pose": (0.55, 0.1, 0.0, 0, 0, 0.4)},
                tool={"grasp_pose": (0, 0, 0.15, 0, 0, 0)}, limits={"contact_n_per_m": 1000.0})
    frames = np.tile(matrices(np.array([0.0, 0.0, 0.5, 0, 1.2, 0])), (3, 1, 1))
    frames[1, 0, 3], frames[2, 0, 3], frames[2, 1, 3] = 0.02, 0.02, 0.03
    made = there_and_back(cell, frames, speed=0.03, cycles=2, pause=0.5)
    ends = np.flatnonzero(np.diff(made.times) > 0.4)
    assert len(ends) == 3
    assert made.poses[ends[0]] == pytest.approx(made.poses[ends[0] + 1])
    assert made.poses[-1] == pytest.approx(made.poses[0])
    assert made.duration == pytest.approx(4 * made.times[ends[0]] + 3 * 0.5)


def test_what_a_cell_leaves_open_of_a_recording():
    cell = Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6, "position_sigma_m": 4e-4},
                sensor={"drift_n_per_minute": 6.0}, tool={"grip_seconds": 2.0})
    known = known_errors(cell, 30.0, tare_sigma=[0.4, 0.1, 0.1, 0.01, 0.02, 0.01])
    assert known.force_drift_sigma_n == pytest.approx(3.0)
    assert known.force_bias_sigma_n == pytest.approx(0.5)
    assert known.torque_bias_sigma_nm == 0.02 and known.pose_sigma_m == 4e-4


@contextmanager
def _tracker(lines: list[str], base=(0.0,) * 6):
    """A stream of markers on which ``lines`` have come."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        stream = MarkerStream("127.0.0.1", server.getsockname()[1], base)
        theirs, _ = server.accept()
        with theirs:
            theirs.sendall("".join(f"{line}\n" for line in lines).encode())
            yield stream
        stream.close()


def test_a_tracker_on_the_base_is_turned_into_the_branchs_frame():
    with _tracker(['{"t_s": 1.0, "frame": "base", "points_m": [[0.1, 0, 0]]}',
                   '{"t_s": 1.1, "points_m": [[0.1, 0, 0]]}'],
                  (0.5, 0.1, -0.2, 0, 0, np.pi / 2)) as stream:
        frames = stream.read(1.0)
    assert [time for time, _ in frames] == [1.0, 1.1]
    assert frames[0][1] == pytest.approx(np.array([[0.5, 0.2, -0.2]]))
    assert frames[1][1] == pytest.approx(np.array([[0.1, 0, 0]]))


def _resting(*frames):
    """What a tracker's resting points and their noise are told as that sends ``frames``."""
    with _tracker([json.dumps({"t_s": number / 30, "points_m": points})
                   for number, points in enumerate(frames)]) as stream:
        return stream.at_rest()


def test_resting_points_tell_their_noise():
    """A tracker of 0.3 mm is said to have 0.3 mm; one that smooths has at least 0.1 mm."""
    rng = np.random.default_rng(4)
    place = np.array([[0.1, 0.2, 0.3], [0.2, 0.1, 0.4]])
    for count, sigma, told in ((200, 3e-4, pytest.approx(3e-4, rel=0.1)), (200, 1e-6, 1e-4),
                               (5, 3e-4, None)):
        noisy = place + sigma * rng.standard_normal((count, *place.shape))
        points, noise = _resting(*noisy.tolist())
        assert points == pytest.approx(place, abs=4 * sigma / np.sqrt(count))
        assert noise == told


def test_a_point_that_is_hidden_now_and_then_still_rests_somewhere():
    here, there = [0.1, 0.0, 0.0], [0.2, 0.0, 0.0]
    points, _ = _resting([here, there], [None, there], [here, [None, None, None]])
    assert points == pytest.approx(np.array([here, there]))


@pytest.mark.parametrize("frames, said", [
    ([[[0.1, 0, 0], None]] * 3, "does not see point 1"),
    ([[[0.1, 0, 0], [0.2, 0, 0]], [[0.1, 0, 0]]], "a different number in 1 of 2 frames")])
def test_points_that_do_not_rest_anywhere_are_refused(frames, said):
    with pytest.raises(WorkError, match=said):
        _resting(*frames)


def test_its_schema_is_plain(capsys):
    from limber.stages.registry import stage_schema

    assert json.dumps(stage_schema("record"))


class VirtualRealSense(Library):
    """pyrealsense2 as :class:`.RealSense` uses it, with images of the virtual robot's branch."""

    def __init__(self, address: str, pose: np.ndarray):
        super().__init__(D455, 1e-4)
        self._eye = VirtualCamera(address)
        self._camera = D455.model_copy(update={"pose": tuple(map(float, pose))})
        self.longest = 0.0

    def wait_for_frames(self, milliseconds):
        stamp = 1e3 * time.time()
        steps = np.round(1e4 * self._eye.depth(self._camera)).astype(np.uint16)
        self.longest = max(self.longest, time.time() - 1e-3 * stamp)
        return self.frame(steps, stamp)

    def stop(self):
        self._eye.__exit__()


@pytest.mark.slow
def test_a_realsense_records_what_the_tracker_follows(branch_folder, tmp_path, robot, monkeypatch):
    """Slow: a pull and its tracking. The control points move as the markers of the same pull."""
    skeleton = load_skeleton(Branch.open(branch_folder))
    middle, out = skeleton.nodes.mean(axis=0), sideways(Branch.open(branch_folder))
    side = np.cross(out, skeleton.point_at(0.9) - skeleton.point_at(0.1))
    placed = D455.looking(eye=middle + 0.5 * side / np.linalg.norm(side), target=middle)
    cell = cell_at(branch_folder, robot.address).model_copy(update={
        "camera": CameraEntry(pose=placed.pose, mount="branch")})
    path = cell_file(cell, tmp_path)
    camera = VirtualRealSense(robot.address, placed.pose)
    monkeypatch.setitem(sys.modules, "pyrealsense2", camera)
    result = RecordPull(branch_folder=branch_folder, cell=path, name="seen",
                        **sideways_pull(branch_folder, distance=0.03), confirm="seen",
                        realsense=True).run()
    assert result["ended"] == "reached" and result["depth_images"] > 5
    folder = branch_folder / "pulls" / "seen"
    pull = read_pull(folder)
    assert pull.entry.observation == "depth"
    seen, warnings = observe(folder, pull, skeleton, (0.5, 0.92))
    assert not any("pose has an error" in text for text in warnings), warnings
    # At the grasp the branch is where the gripper is; below, it follows on the same side.
    start = np.array(pull.entry.grasp.point_m)
    held = np.array([np.interp(seen.times, pull.times, pull.poses[:, k]) for k in range(3)]).T
    off = np.linalg.norm(seen.positions[:, 1] - held, axis=1)
    # On a machine that stands still, an image is as much later than its stamp.
    speed = np.linalg.norm(np.gradient(held, seen.times, axis=0), axis=1).max()
    assert np.nanmedian(off) < 2e-3
    # One image in ten may be worse: the depth of a thin branch's rim is noise.
    assert np.nanquantile(off, 0.9) < 4e-3 + speed * camera.longest
    gone = (seen.positions[:, 0] - skeleton.point_at(0.5)) @ out
    way = (held - start) @ out
    assert way.max() > 0.025
    farthest = int(way.argmax())
    assert 0.2 * way[farthest] < gone[farthest] < 0.8 * way[farthest]
    assert abs(gone[0]) < 2e-3


def test_a_camera_on_the_flange_cannot_watch_a_pull(branch_folder, tmp_path, robot, monkeypatch):
    cell = cell_at(branch_folder, robot.address).model_copy(update={
        "camera": CameraEntry(pose=(0, 0, 0.1, 0, 0, 0), mount="flange")})
    monkeypatch.setitem(sys.modules, "pyrealsense2", VirtualRealSense(robot.address, np.zeros(6)))
    with pytest.raises(InputError, match="mount = \"branch\""):
        RecordPull(branch_folder=branch_folder, cell=cell_file(cell, tmp_path), name="seen",
                   **sideways_pull(branch_folder), confirm="seen", realsense=True).run()
    with pytest.raises(InputError, match="Both --markers and --realsense"):
        RecordPull(branch_folder=branch_folder, cell=cell_file(cell, tmp_path), name="seen",
                   **sideways_pull(branch_folder), confirm="seen", realsense=True,
                   markers=MARKERS).run()
    assert Branch.open(branch_folder).streams() == []
