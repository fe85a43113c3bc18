"""What follows a stop: what was done and what force is left is told, also where nothing worked."""

import json
from contextlib import contextmanager

import numpy as np
import pytest

from limber.cell.cell_file import Cell
from limber.cli.stage_command import StageCommand
from limber.core.errors import SafetyStop, WorkError
from limber.core.progress import SILENT
from limber.robot.operator_decisions import retreat_if_chosen
from limber.stages.stage import About, Tool


class Link:
    """A robot that goes back to ``left`` [N], or ends with an event or error."""

    def __init__(self, ends=None, left=0.0, gone=False):
        self._ends, self._left, self._gone = ends, left, gone
        self._force = 38.0
        self.opened = self.has_ended = False

    def retreat(self):
        if isinstance(self._ends, Exception):
            raise self._ends
        self._force = self._left
        return self._ends or {"event": "reached"}

    def wait_for_samples(self, seconds):
        if self._gone:
            raise WorkError("The robot's driver sends no samples.")
        return np.r_[np.zeros(13), self._force, np.zeros(23)]

    def gripper(self, close):
        if self._gone:
            raise WorkError("The robot's driver has ended.")
        self.opened, self._force = not close, 0.5


def cell_with(gripper: str) -> Cell:
    return Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6},
                tool={"grasp_pose": (0, 0, 0.15, 0, 0, 0), "gripper": gripper,
                      "grip_seconds": 0.01})


STOPPED = {"event": "stopped", "reason": "the force rises during the return [N] (41, allowed 38)"}


@pytest.mark.parametrize("link, gripper, retreated, opened, told", [
    (Link(), "digital_output", True, False,
     "returned along its path; the force on the branch is 0.0 N"),
    (Link(STOPPED, 39.0), "digital_output", False, True,
     "could not return: the force rises during the return [N] (41, allowed 38); the force on "
     "the branch is 39.0 N. The gripper was opened; the force on the branch is 0.5 N"),
    (Link(SafetyStop("There is no path to return along.")), "digital_output", False, True,
     "no path to return along"),
    # It returned, and something still pulls.
    (Link(left=12.0), "digital_output", True, True,
     "along its path; the force on the branch is 12.0 N"),
    (Link(STOPPED, 39.0), "by_hand", False, False,
     "is by_hand): free the branch by hand; the force on the branch is 39.0 N"),
    (Link(STOPPED, 39.0), "none", False, False,
     "free the branch by hand; the force on the branch is 39.0 N"),
    (Link(WorkError("The driver has ended."), gone=True), "digital_output", False, False,
     "The gripper did not open (The robot's driver has ended): free the branch by hand; the force "
     "on the branch is unknown"),
])
def test_the_outcome_of_a_retreat_is_told(link, gripper, retreated, opened, told):
    found = retreat_if_chosen(cell_with(gripper), link, "retreat", SILENT)
    assert found["retreated"] == retreated and found["gripper_opened"] == opened == link.opened
    assert told in found["outcome"]


def test_where_the_driver_is_gone_another_takes_its_place(monkeypatch):
    """It finds the way on disk; where nothing answers, the gripper's output is tried alone."""
    gone, other, switched = Link(), Link(left=0.4), []
    gone.has_ended = True

    @contextmanager
    def opened_link(cell):
        yield other
    monkeypatch.setattr("limber.robot.operator_decisions.RobotLink", opened_link)
    found = retreat_if_chosen(cell_with("digital_output"), gone, "retreat", SILENT)
    assert found["retreated"] and found["force_n"] == 0.4

    def no_link(cell):
        raise WorkError("No robot answers.")
    monkeypatch.setattr("limber.robot.operator_decisions.RobotLink", no_link)
    monkeypatch.setattr("limber.robot.ur.grippers.switch_output",
                        lambda *arguments: switched.append(arguments))
    found = retreat_if_chosen(cell_with("digital_output"), gone, "retreat", SILENT)
    assert not found["retreated"] and found["gripper_opened"] and found["force_n"] is None
    assert switched == [("127.0.0.1", 0, False)]
    assert "none could take its place (No robot answers)" in found["outcome"]
    assert "by hand" in retreat_if_chosen(cell_with("by_hand"), gone, "retreat", SILENT)["outcome"]


@pytest.mark.parametrize("choice", ["hold", "ask"])
def test_an_arm_that_holds_tells_its_force(choice):
    """Nobody is at a terminal here."""
    found = retreat_if_chosen(cell_with("digital_output"), Link(), choice, SILENT)
    assert found == {"choice": "hold", "retreated": False, "gripper_opened": False, "force_n": 38.0,
                     "outcome": "The arm holds; the force on the branch is 38.0 N."}


def test_what_a_stopped_command_found_is_in_its_json(capfd):
    class Stopped(Tool):
        about = About("stopped")

        def run(self, progress=SILENT):
            raise SafetyStop("It was stopped.", result={"after_stop": {"force_n": 1.5}})
    with pytest.raises(SystemExit) as stop:
        StageCommand(Stopped).main(["--json"], standalone_mode=False)
    told = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert stop.value.code == 4 and told["after_stop"] == {"force_n": 1.5}
    assert told["error"] == "It was stopped."
