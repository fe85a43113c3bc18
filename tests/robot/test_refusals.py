"""A robot that is not moved: what is refused before, and what a link tells of one that stands.

Nothing here depends on clocks: most of it is in the robot's own time.
"""

import signal

import numpy as np
import pytest

from benchmarks.robot_faults import cell_for, new_robot, straight
from limber.cell.cell_file import Cell
from limber.core.errors import InputError, SafetyStop, WorkError
from limber.robot.driver.link import COLUMNS, RobotLink
from limber.robot.robot_state import observe, show_before_motion


@pytest.fixture(scope="module")
def resting_robot(own_address):
    """In a process, as its driver."""
    pytest.importorskip("rtde_control")
    with new_robot(own_address, "ur5e", 5) as robot:
        yield robot


@pytest.mark.slow
def test_a_call_that_never_comes_back_is_told_as_a_safety_stop(resting_robot):
    """The driver is ended by its deadline before it could say a word."""
    with RobotLink(cell_for(resting_robot.address)) as link:
        link.process.send_signal(signal.SIGALRM)
        with pytest.raises(SafetyStop, match="did not answer its driver"):
            link.wait("stopped", seconds=5)
    # The dashboard is tried once more, on a connection of its own.
    assert any("dashboard was asked to stop" in each for each in link.warnings)
    assert any("program stopped: dashboard" in line for line in resting_robot.state["log"])


@pytest.mark.slow
def test_a_driver_that_does_not_start_is_told_from_a_silent_robot(resting_robot, monkeypatch):
    monkeypatch.setattr("limber.robot.driver.link._START_SECONDS", 0.01)
    with pytest.raises(WorkError, match=r"did not start within.*This computer is too busy"):
        RobotLink(cell_for(resting_robot.address))


def test_a_path_that_starts_elsewhere_is_refused(stepped):
    line = straight(stepped, (0.0, 0.1, 0.0))
    moved = type(line)(line.times, line.poses + [0, 0, 0.02, 0, 0, 0], line.expected)
    with RobotLink(cell_for(stepped.address)) as link:
        with pytest.raises(SafetyStop, match=r"starts 20\.0 mm"):
            link.start(moved)
        stepped.ask("slider", value=0.6)
        with pytest.raises(SafetyStop, match=r"slider is at 60 %.*Raise it to 100 %"):
            link.follow(line)


@pytest.mark.parametrize("action, values, error, told", [
    ("local", {}, SafetyStop, "remote control"),
    ("protective_stop", {}, SafetyStop, "not ready"),
    ("silent", {"value": True}, WorkError, "does not answer"),
])
def test_a_robot_that_cannot_be_moved_is_refused(stepped, action, values, error, told):
    stepped.ask(action, **values)
    with pytest.raises(error, match=told):
        RobotLink(cell_for(stepped.address)).close()


def test_the_wrong_robot_is_refused(stepped):
    for model, told in (("ur10e", "reports that it is a UR5"), ("ur5", "different series")):
        cell = Cell(robot={"model": model, "address": stepped.address}, base={"pose": (0,) * 6})
        with pytest.raises(InputError, match=told):
            RobotLink(cell).close()


def test_another_version_than_the_calibrated_one_is_refused(stepped):
    cell = cell_for(stepped.address)
    other = cell.model_copy(update={"robot": cell.robot.model_copy(update={"version": "5.4.1"})})
    with pytest.raises(InputError, match=r"calibrated with 5\.4\.1"):
        RobotLink(other).close()


def test_the_last_sample_is_had_from_the_link(stepped):
    """Not from who takes samples, who may not have listened yet when one came."""
    with RobotLink(cell_for(stepped.address), lambda _rows: None) as link:
        row = link.wait_for_samples()
    assert row.shape == (len(COLUMNS),)
    assert np.allclose(row[1:4], stepped.state["pose"][:3], atol=1e-4)


def test_nobody_at_the_address_is_told(stepped):
    with pytest.raises(WorkError, match="No robot answers"):
        RobotLink(cell_for("127.0.0.99")).close()


def test_what_is_read_writes_nothing_and_what_is_set_is_put_back(stepped):
    """Payload and tool of another job: named with both values, set for a link, then as before."""
    before = {"payload": 1.2, "tool": [0.0, 0.0, 0.05, 0.0, 0.0, 0.0]}
    stepped.ask("payload", value=before["payload"])
    stepped.ask("tool", offset=before["tool"])
    cell = Cell(robot={"model": "ur5e", "address": stepped.address},
                base={"pose": (0,) * 6}, tool={"mass_kg": 0.5, "grasp_pose": (0, 0, 0.15, 0, 0, 0)})
    seen = observe(cell, 0.1)
    told = "; ".join(map(str, seen.differences))
    assert "payload: 1.200 kg in the controller, 0.500 kg in the cell file (set for" in told
    assert "tool centre point: (0, 0, 50) mm" in told
    assert not seen.implausible(cell) and not seen.is_busy(cell)
    state = stepped.state
    assert state["program"] == "STOPPED"
    assert {name: state[name] for name in before} == before
    with RobotLink(cell):
        state = stepped.state
        assert state["payload"] == 0.5 and state["tool"] == [0.0, 0.0, 0.15, 0.0, 0.0, 0.0]
        with pytest.raises(SafetyStop, match="A program is running on the controller"):
            show_before_motion(cell, lambda text: None)
    state = stepped.state
    assert state["payload"] == pytest.approx(1.2)
    assert state["tool"] == pytest.approx(before["tool"])


def test_settings_that_could_not_be_put_back_are_told(stepped):
    """Somebody ends the program at the pendant: nothing takes them any more."""
    stepped.ask("payload", value=1.2)
    with RobotLink(cell_for(stepped.address)) as link:
        link.wait_for_samples()
        stepped.ask("stop_program")
        assert link.wait("stopped", seconds=5)["reason"]
    assert any("keeps the tool centre point and payload" in each for each in link.warnings)
