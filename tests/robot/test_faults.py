"""Faults while the robot moves, with the real client and processes: standstill and a report."""

import signal
import threading
import time

import numpy as np
import pytest

from benchmarks.half_open import DIRECTIONS, Cable
from benchmarks.robot_faults import (
    ENDS_ROBOT,
    EVERY,
    Outcome,
    cell_for,
    model_for,
    new_robot,
    provoke,
    restored,
    set_off,
    straight,
    tared,
)
from benchmarks.robot_stepped import SteppedRobot
from limber.core.errors import LimberError, SafetyStop
from limber.core.progress import SILENT
from limber.robot.driver.link import RobotLink
from limber.robot.motion.trajectory import ExpectedWrench, Trajectory, along, densely
from limber.robot.operator_decisions import _force_left, retreat_if_chosen
from limber.robot.virtual.server import RtdeClient

pytest.importorskip("rtde_control")

OF_PROCESSES = ("connection cut", "silent port", "worker killed", "add-on closed",
                "200 ms cable delay", "keep-alive starved", "two clients", "protective stop",
                "FT300 cut off")
"""Faults of connections and processes, and one of the robot's own: they are provoked in real time.
The others are too, by `scripts/test --campaign`.
"""
OUTSIDE = ("keep-alive starved", "two clients", "cable carries nothing to the robot",
           "cable carries nothing from the robot")
"""Faults that take another process or a cable."""
QUICK = ("protective stop", "sensor NaN", "force spike", "silent port")
"""Those that are tried at each save."""


def require_standstill(name: str, outcome: Outcome) -> None:
    """At 50 mm/s: standing within 0.6 s, most of them within a few millimetres."""
    assert outcome.is_named, outcome.report
    if name == "slow push":
        # It begins softly: the force has to grow first, by 5 N a second of a busy machine.
        assert outcome.way_m < 0.1
        return
    assert outcome.standstill_s < 0.6 and outcome.way_m < 0.03


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=() if name in OF_PROCESSES else pytest.mark.campaign)
    for name in EVERY if name not in ENDS_ROBOT])
def test_every_fault_ends_in_standstill_and_a_report(robots, name):
    robot = robots[model_for(name)]
    restored(robot)
    require_standstill(name, provoke(name, robot, cell_for(robot.address, robot.model)))


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
    for name in EVERY if name not in (*ENDS_ROBOT, *OUTSIDE)])
def test_every_fault_is_noticed_by_a_stepped_driver(request, name):
    """All but what is another process's or the cable's."""
    robot = request.getfixturevalue("stepped_cb3" if model_for(name) == "ur5" else "stepped")
    require_standstill(name, provoke(name, robot, cell_for(robot.address, robot.model)))


def test_a_popup_stops_the_path_for_good(stepped):
    """Nothing goes on when it is closed."""
    with RobotLink(cell_for(stepped.address)) as link:
        set_off(stepped, link, straight(stepped, (0.0, 0.2, 0.0)))
        stepped.ask("popup", text="Check the gripper")
        assert "program" in link.wait("stopped", seconds=5)["reason"]
        stepped.rest(0.5)
        stood = stepped.ask("close_popup")["joints"]
        stepped.rest(0.5)
        assert stepped.state["joints"] == stood


@pytest.mark.parametrize("moving", [True, False])
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_a_connection_that_carries_one_way_stops_it_within_two_seconds(e_series, direction, moving):
    """Told at once; then nothing that is asked of the driver takes longer either."""
    address = f"127.0.0.{int(e_series.address.split('.')[-1]) + 20}"
    with Cable(address, e_series.address) as cable, RobotLink(cell_for(address)) as link:
        if moving:
            set_off(e_series, link, straight(e_series, (0.0, 0.2, 0.0)))
        else:
            tared(link)
        began = time.monotonic()
        cable.cut(direction)
        assert link.wait("stopped", seconds=5)["reason"]
        assert time.monotonic() - began < 1.0
        assert np.linalg.norm(e_series.state["tool_speed"]) < 1e-3 or moving
        if direction == "from the robot":
            assert link.process.wait(5.0) is not None
            assert time.monotonic() - began < 2.0
        began = time.monotonic()
        with pytest.raises(LimberError):
            link.retreat()
        assert time.monotonic() - began < 2.0
        assert np.linalg.norm(e_series.state["tool_speed"]) < 1e-3


def test_a_killed_controller_is_reported(worker_address):
    with new_robot(worker_address, "ur5e", 1) as robot:
        assert provoke("controller killed", robot, cell_for(worker_address)).report


@pytest.mark.slow
def test_a_second_client_is_refused_and_the_first_goes_on(stepped):
    cell = cell_for(stepped.address)
    with RobotLink(cell) as first:
        set_off(stepped, first, straight(stepped, (0.0, 0.08, 0.0)))
        with pytest.raises(LimberError):
            RobotLink(cell).close()
        assert first.wait("reached", "stopped", seconds=30)["event"] == "reached"


def test_a_path_is_followed_within_a_millimetre(robot):
    """Two legs at 30 mm/s: distance of the arm from the path, by the arm's own state."""
    start = np.array(robot.state["pose"])
    poses = densely(np.array([start, start + [0, 0.01, 0, 0, 0, 0],
                              start + [0, 0.01, 0.0075, 0, 0.025, 0]]))
    path = Trajectory(along(poses, 0.03, 0.2), poses, ExpectedWrench.nothing(poses))
    rows = []
    with RobotLink(cell_for(robot.address, robot.model), rows.append) as link:
        tared(link)
        assert link.follow(path)["event"] == "reached"
        back = link.retreat()
        assert back["event"] == "reached"
    samples = np.concatenate(rows)
    steps = np.diff(samples[:, 0])
    assert np.all(steps > 0)
    assert steps.max() < 1.5 * steps.min()
    distance = np.linalg.norm(samples[:, None, 1:4] - poses[None, :, :3], axis=2).min(axis=1)
    # Poses of the path are 2 mm apart: the nearest is up to 1 mm off along it.
    assert distance.max() < 1.5e-3
    assert np.linalg.norm(samples[-1, 1:4] - start[:3]) < 1e-4


def test_a_controller_that_sends_a_quarter_of_its_samples_moves_as_fast(stepped, monkeypatch):
    """And that is told once, when it is opened."""
    usual = RtdeClient.is_due
    monkeypatch.setattr(RtdeClient, "is_due", lambda client, controller: (
        controller.step_count % 4 == 0 and usual(client, controller)))
    with RobotLink(cell_for(stepped.address)) as link:
        assert ["not 500: a force is seen 6 ms" in text for text in link.warnings] == [True]
        assert link.facts["rate_hz"] == pytest.approx(125.0)
        tared(link)
        path, began = straight(stepped, (0.0, 0.05, 0.0)), stepped.now
        assert link.follow(path)["event"] == "reached"
    assert stepped.now - began < path.duration + 0.6


def stands_soon(robot) -> None:
    """Within half a second."""
    wait = robot.rest if isinstance(robot, SteppedRobot) else time.sleep
    for _ in range(50):
        if np.linalg.norm(robot.state["tool_speed"]) <= 1e-3:
            return
        wait(0.01)
    raise AssertionError("it moves")


@pytest.mark.slow
def test_pause_at_the_soft_limit_then_resume(stepped):
    cell = cell_for(stepped.address)
    with RobotLink(cell) as link:
        set_off(stepped, link, straight(stepped, (0.0, 0.04, 0.0), expected=False))
        stepped.ask("added_wrench", wrench=[0, 0, 12.0, 0, 0, 0])
        assert "soft force" in link.wait("paused", "stopped", "reached", seconds=5)["reason"]
        stands_soon(stepped)
        # By 5 % each 30 ms: a force that falls faster is a slip.
        for force in [*np.geomspace(12, 0.3, 72), 0.0]:
            stepped.ask("added_wrench", wrench=[0, 0, float(force), 0, 0, 0])
            stepped.rest(0.03)
        assert np.linalg.norm(stepped.state["tool_speed"]) < 1e-3
        assert link.resume()["event"] == "reached"


@pytest.mark.slow
def test_a_cb3_is_stopped_without_waiting_for_its_step(stepped_cb3):
    """By the dashboard, whatever the force came with; then it goes back the way it came."""
    with RobotLink(cell_for(stepped_cb3.address, "ur5")) as link:
        begin = np.array(stepped_cb3.state["pose"])
        set_off(stepped_cb3, link, straight(stepped_cb3, (0.0, 0.2, 0.0)))
        stepped_cb3.ask("added_wrench", wrench=[0, 0, 60.0, 0, 0, 0])
        assert "force" in link.wait("stopped", seconds=5)["reason"]
        assert any("wait for the next control step" in each for each in link.warnings)
        stepped_cb3.ask("added_wrench", wrench=[0] * 6)
        assert link.retreat()["event"] == "reached"
        # The program that was uploaded anew is watched like the first.
        assert stepped_cb3.state["watchdog_s"] == pytest.approx(0.1)
        assert np.allclose(stepped_cb3.state["pose"][:3], begin[:3], atol=1e-4)


@pytest.mark.slow
def test_where_the_force_does_not_fall_on_the_way_back_the_gripper_opens(stepped):
    """It pauses, goes back some centimetres under the same force, stops and lets go."""
    cell = cell_for(stepped.address)
    cell = cell.model_copy(update={"tool": cell.tool.model_copy(update={
        "gripper": "digital_output", "grip_seconds": 0.2,
        "grasp_pose": (0, 0, 0.15, 0, 0, 0)})})
    with RobotLink(cell) as link:
        tared(link)
        link.gripper(close=True)
        link.start(straight(stepped, (0.0, 0.1, 0.0), expected=False))
        stepped.rest(0.8)
        stepped.ask("added_wrench", wrench=[0, 0, 14.0, 0, 0, 0])
        assert "soft force" in link.wait("paused", "stopped", seconds=5)["reason"]
        paused = stepped.state
        told = retreat_if_chosen(cell, link, "retreat", SILENT)
        ended = stepped.state
    assert not told["retreated"] and told["gripper_opened"]
    assert "force does not fall" in told["outcome"] and "14." in told["outcome"]
    assert told["force_n"] == pytest.approx(14.0, abs=1.0)
    assert paused["outputs"] == 1 and ended["outputs"] == 0
    way = np.subtract(paused["pose"][:3], ended["pose"][:3])
    assert 0.015 < way[1] < 0.03 and np.linalg.norm(ended["tool_speed"]) < 1e-3


def test_a_killed_program_leaves_its_way_and_its_tare_to_the_next(e_series):
    """Killed while it pulls with 4 N: another driver goes back, judged by the tare of the first."""
    cell = cell_for(e_series.address)
    with RobotLink(cell) as link:
        begin = np.array(e_series.state["pose"])
        set_off(e_series, link, straight(e_series, (0.0, 0.2, 0.0), expected=False))
        e_series.ask("added_wrench", wrench=[0, 0, 4.0, 0, 0, 0])
        time.sleep(0.1)
        link.process.kill()
        stands_soon(e_series)
    assert np.linalg.norm(np.subtract(e_series.state["pose"], begin)) > 0.005
    with RobotLink(cell) as link:
        assert _force_left(link) == pytest.approx(4.0, abs=0.7)
        assert link.retreat()["event"] == "reached"
    assert np.allclose(e_series.state["pose"][:3], begin[:3], atol=2e-3)


@pytest.mark.slow
def test_an_arm_that_was_moved_after_its_stop_does_not_go_back(stepped):
    with RobotLink(cell_for(stepped.address)) as link:
        set_off(stepped, link, straight(stepped, (0.0, 0.1, 0.0)))
        link.stop()
        link.wait("stopped", seconds=5)
        stepped.ask("stand", joints=list(np.add(stepped.state["joints"], [0.2, 0, 0, 0, 0, 0])))
        stepped.rest(0.1)
        with pytest.raises(SafetyStop, match=r"mm and .* degrees away from its path"):
            link.retreat()


@pytest.mark.parametrize("held_up, ends", [("both", "reached"), ("the robot", "stopped")])
def test_a_computer_that_stands_still_is_no_silent_robot(e_series, held_up, ends):
    """Both held up for 80 ms: nothing was there to be heard. The robot alone: its data is old."""
    with RobotLink(cell_for(e_series.address)) as link:
        set_off(e_series, link, straight(e_series, (0.0, 0.04, 0.0)))
        held = [e_series.process] + ([link.process] if held_up == "both" else [])
        for process in reversed(held):
            process.send_signal(signal.SIGSTOP)
        time.sleep(0.08)
        for process in held:
            process.send_signal(signal.SIGCONT)
        event = link.wait("reached", "stopped", seconds=10)
        assert event["event"] == ends, event
    if held_up == "both":
        assert any("delayed the robot's program" in each for each in link.warnings)
    else:
        assert "no data from the robot" in event["reason"]


@pytest.mark.slow
def test_after_a_stop_only_a_choice_moves_it(stepped):
    with RobotLink(cell_for(stepped.address)) as link:
        line = straight(stepped, (0.0, 0.1, 0.0))
        link.wait_for_samples()
        with pytest.raises(SafetyStop, match="not tared"):
            link.start(line)
        set_off(stepped, link, line)
        link.stop()
        assert "a stop was requested" in link.wait("stopped", seconds=5)["reason"]
        stands_soon(stepped)
        with pytest.raises(SafetyStop, match="Choose"):
            link.start(straight(stepped, (0.0, 0.05, 0.0)))
        assert link.retreat()["event"] == "reached"
        assert np.allclose(stepped.state["pose"][:3], line.poses[0, :3], atol=1e-4)


def test_a_program_that_is_slow_to_read_holds_nothing_up(e_series):
    """Samples of 0.8 s would fill its pipe twice over: the motion goes on to its end."""
    stalled, taken = threading.Event(), []

    def take(rows: np.ndarray) -> None:
        if stalled.is_set():
            stalled.clear()
            time.sleep(0.8)
        taken.append(rows)
    with RobotLink(cell_for(e_series.address), take) as link:
        tared(link)
        link.start(straight(e_series, (0.0, 0.05, 0.0)))
        stalled.set()
        assert link.wait("reached", "stopped", seconds=30)["event"] == "reached"
        time.sleep(0.1)
    clock = np.concatenate(taken)[:, 0]
    assert np.diff(clock) == pytest.approx(np.full(len(clock) - 1, 0.002), abs=1e-5)
