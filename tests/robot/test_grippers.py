"""Robotiq's gripper by its socket: the bytes of its URCap, and a branch that it holds."""

import asyncio
import threading

import pytest

from limber.cell.cell_file import Cell
from limber.core.errors import SafetyStop, WorkError
from limber.core.progress import SILENT
from limber.robot.operator_decisions import _opened_without_driver, grip
from limber.robot.ur.grippers import HELD_CLOSING, RobotiqGripper, drive_gripper, holds
from limber.robot.virtual.controller import Controller
from limber.robot.virtual.payload import Load, RobotiqRegisters
from limber.robot.virtual.server import Server, new_loop


class Stick(Load):
    """Something that is there to be held."""

    state = "free"

    def grasp(self) -> None:
        self.state = "held"

    def release(self) -> None:
        self.state = "free"

    def report(self) -> dict:
        return {"branch": self.state}


@pytest.fixture
def served(own_address):
    """A controller with a gripper whose ports are open, in a thread."""
    controller = Controller("ur5e", robotiq=True, load=Stick())
    loop, opened = new_loop(), threading.Event()
    server = Server(controller, own_address)

    def run() -> None:
        asyncio.set_event_loop(loop)
        loop.run_until_complete(server.open())
        opened.set()
        loop.run_forever()
        loop.run_until_complete(server.close())
    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    assert opened.wait(5.0)
    yield controller
    loop.call_soon_threadsafe(loop.stop)
    thread.join(5.0)
    loop.close()


def cell_at(address: str) -> Cell:
    return Cell(robot={"model": "ur5e", "address": address}, base={"pose": (0,) * 6},
                tool={"grasp_pose": (0, 0, 0.15, 0, 0, 0), "gripper": "robotiq",
                      "grip_seconds": 0.1, "grip_force": 0.4})


class Link:
    """A driver's link that drives the gripper at once."""

    def __init__(self, cell: Cell):
        self._cell = cell

    def gripper(self, close: bool) -> None:
        drive_gripper(self._cell, close)


def test_it_closes_on_a_branch_tells_it_and_opens_without_a_driver(served, own_address):
    cell = cell_at(own_address)
    grip(cell, Link(cell), close=True, progress=SILENT)
    assert served.load.state == "held" and holds(cell)
    assert served.robotiq.values["FOR"] == 102 and served.robotiq.values["POS"] == 255
    assert _opened_without_driver(cell) == (True, "The gripper was opened")
    assert served.load.state == "free" and holds(cell) is False


def test_a_gripper_that_closes_on_nothing_begins_no_pull(served, own_address):
    served.load.grasp = lambda: None
    cell = cell_at(own_address)
    with pytest.raises(SafetyStop, match="closed on nothing"):
        grip(cell, Link(cell), close=True, progress=SILENT)


@pytest.mark.parametrize("register, value, told", [
    ("STA", 0, "not activated.*opens and closes it"), ("FLT", 10, "fault 10")])
def test_one_that_is_not_ready_is_refused_and_not_activated(served, own_address, register, value,
                                                            told):
    served.robotiq.values[register] = value
    with pytest.raises(WorkError, match=told):
        RobotiqGripper(own_address)
    assert served.robotiq.values["ACT"] == 1 and served.robotiq.values["GTO"] == 0


def test_the_socket_speaks_as_the_urcap_does():
    driven = []
    registers = RobotiqRegisters(driven.append, lambda: "held")
    assert registers.answer("GET POS\n") == b"POS 0\n" and registers.answer("GET STA") == b"STA 3\n"
    assert registers.answer("SET POS 255 SPE 255 FOR 50 GTO 1\n") == b"ack" and driven == [True]
    assert registers.answer("GET OBJ") == f"OBJ {HELD_CLOSING}\n".encode()
    assert registers.answer("SET XYZ 1") == registers.answer("HELLO") == b"?"


def test_a_port_that_nobody_serves_is_named(own_address):
    with pytest.raises(WorkError, match="No Robotiq gripper answers"):
        holds(cell_at(own_address))
