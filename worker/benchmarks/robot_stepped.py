"""A robot and its driver in this process, in the robot's own time: no wall clock, no other process.

Link, driver, guard, sample stream, dashboard and the virtual controller's ports are the real ones.
Stand-ins are the clock (:class:`Clock`), the sockets, the driver's process (:class:`DriverHere`)
and ur-rtde (:class:`ScriptHere`). Whoever waits lets the robot take its steps.
"""

import asyncio
import json
import queue
import select
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from importlib import import_module
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import LimberError
from limber.geometry.rigid_kernels import crossed
from limber.robot.driver import control_loop, link
from limber.robot.ur.factory_calibration import PRIMARY_PORT, kinematics_message
from limber.robot.ur.ft300 import STREAM_PORT
from limber.robot.ur.rtde import DASHBOARD_PORT, RTDE_PORT
from limber.robot.virtual.branch_solver import BranchSolver
from limber.robot.virtual.controller import Controller, RuntimeState
from limber.robot.virtual.gripped_branch import HeldBranch
from limber.robot.virtual.launch import ACTIONS, state_of
from limber.robot.virtual.payload import Load
from limber.robot.virtual.server import FT300_SECONDS, DashboardClient, RtdeClient, Server

_LATE_STEPS = 2  # until a target that was sent moves the arm
_ANSWER_SECONDS = 2.0
_BEAT_SECONDS = 0.2
_ENDING_SECONDS = 0.2  # of a driver's process: the controller's watchdog ends its program meanwhile
_SOLVING_STEPS = 15  # of the arm, while the branch is solved
_IN_ROBOTS_TIME = ("limber.robot.", "limber.stages.pulls.", "limber.stages.paths.",
                   "limber.cli.commands.robot.", "benchmarks.robot_faults")
_LOADED_LATE = ("limber.robot.operator_decisions", "limber.robot.ros.ros_control",
                "limber.stages.pulls.record",
                "limber.stages.pulls.record_nudge", "limber.stages.paths.execute",
                "limber.cli.commands.robot.moves", "limber.cli.commands.robot.weigh")


class Wall(Load):
    """A stiff plane in the tool's way.

    Args:
        tool: Offset of the tool's centre from the flange [m], shape [3].
        normal: Out of the wall, base frame, shape [3].
        place: A point on it, shape [3].
        stiffness: [N/m].
    """

    def __init__(self, tool: np.ndarray, normal: np.ndarray, place: np.ndarray, stiffness: float):
        self._tool, self._normal, self._place = tool, normal, place
        self.stiffness, self.peak, self.now = stiffness, 0.0, 0.0

    def wrench(self, flange: np.ndarray, seconds: float) -> np.ndarray:
        tip = flange[:3, :3] @ self._tool + flange[:3, 3]
        self.now = self.stiffness * max(float((self._place - tip) @ self._normal), 0.0)
        self.peak = max(self.peak, self.now)
        force = flange[:3, :3].T @ (self.now * self._normal)
        return np.concatenate((force, crossed(self._tool, force)))


class Spring(Load):
    """A held branch near its rest: a linear spring, stiff along its axis.

    Args:
        tool: Offset of the tool's centre from the flange [m], shape [3].
        rest: Where it is held without force, base frame, shape [3].
        stiffness: [N/m], shape [3, 3].
    """

    def __init__(self, tool: np.ndarray, rest: np.ndarray, stiffness: np.ndarray):
        self._tool, self.rest, self.stiffness = tool, rest, stiffness
        self.peak = self.now = 0.0

    def wrench(self, flange: np.ndarray, seconds: float) -> np.ndarray:
        tip = flange[:3, :3] @ self._tool + flange[:3, 3]
        pull = self.stiffness @ (self.rest - tip)
        self.now = float(np.linalg.norm(pull))
        self.peak = max(self.peak, self.now)
        force = flange[:3, :3].T @ pull
        return np.concatenate((force, crossed(self._tool, force)))


class BranchHere(HeldBranch):
    """The branch in the gripper, solved in this process: each solution comes after as many steps.
    """

    def _start(self) -> None:
        self._pipe: Any = _Solved(BranchSolver(self.setting))

    def close(self) -> None:
        """Load runs."""


class _Solved:
    """The pipe to a solver that answers after some questions whether it has."""

    def __init__(self, solver: BranchSolver):
        self._solver, self._left = solver, 0
        self._asked: tuple[str, Any] = ("rest", None)

    def send(self, asked: tuple[str, Any]) -> None:
        self._asked, self._left = asked, _SOLVING_STEPS

    def poll(self, seconds: float = 0.0) -> bool:
        self._left = 0 if seconds else self._left - 1
        return self._left <= 0

    def recv(self) -> tuple[str, Any]:
        kind, content = self._asked
        if kind == "rest":
            return "ready", {"points": self._solver.seen()}
        if kind == "grasp":
            return "grasped", self._solver.grasp(np.array(content))
        if kind == "look":
            return "seen", self._solver.look(*content)
        return ("tried", self._solver.tried()) if kind == "try" else (
            "solved", self._solver.solve(content))


class _Server(Server):
    """The controller's ports, whose delays are in its own time."""

    def __init__(self, robot: "SteppedRobot", controller: Controller):
        super().__init__(controller, "127.0.0.1")
        self._robot = robot

    def later(self, action: Callable[[], None]) -> None:
        if self.delay > 0:
            self._robot.after(round(self.delay / self.controller.seconds), action)
        else:
            action()


class SteppedRobot:
    """A virtual robot as :class:`limber.robot.virtual.launch.VirtualRobot`, without its process.

    Args:
        controller: Its controller and arm.
        address: Where clients in this process find it, while it is :meth:`here`.

    Attributes:
        each_step: Called after each step of the controller.
        now: Its time [s]; unlike the controller's clock nothing disturbs it.
        drivers: Those that are connected, the latest last.
        is_driven: Whether one of them is at work now.
    """

    def __init__(self, controller: Controller, address: str = "127.0.0.1"):
        self.controller, self.address, self.model = controller, address, controller.arm.name
        self.server = _Server(self, controller)
        self.each_step: Callable[[], None] = lambda: None
        self.now = 0.0
        self.drivers: list[DriverHere] = []
        self.is_driven = False
        self._steps = 0
        self._seen_before: tuple[float, ...] = ()
        self._ahead: dict[int, list[Callable[[], None]]] = {}
        self._ft300: list[_Socket] = []
        self._ft300_due, self._left = 0.0, 1.0

    def ask(self, action: str, **values: Any) -> dict[str, Any]:
        """Do ``action`` of :data:`~limber.robot.virtual.launch.ACTIONS`; returns its state."""
        ACTIONS[action](self.server, **values)
        return self.state

    @property
    def state(self) -> dict[str, Any]:
        """The controller's state as it reports it."""
        return json.loads(json.dumps(state_of(self.server)))

    def after(self, steps: int, action: Callable[[], None]) -> None:
        """Do ``action`` before the step after so many others."""
        self._ahead.setdefault(self._steps + max(steps, 1), []).append(action)

    def step(self) -> None:
        """Take one step of the controller, and send what it tells; or go half way to it, where the
        FT300 has a reading.
        """
        if self._ft300 and self.now >= self._ft300_due:
            self.now += 0.5 * self.controller.seconds
            self._ft300_due += FT300_SECONDS
            for each in [each for each in self._ft300
                         if each.is_closing() or not self.server.send_ft300(each)]:
                each.abort()
                self._ft300.remove(each)
            self._left = 0.5
            return
        self._steps += 1
        self.now += self._left * self.controller.seconds
        self._left = 1.0
        for action in self._ahead.pop(self._steps, ()):
            action()
        self.controller.step()
        self.server.publish()
        self.each_step()

    def rest(self, seconds: float) -> None:
        """Let time pass [s]; a driver goes on meanwhile."""
        end = self.now + seconds - 1e-9
        while self.now < end:
            self.go_on()

    def go_on(self) -> None:
        """Let the driver take the next samples, if one is there and does not wait for this itself;
        else take one step.
        """
        if self.drivers and not self.is_driven:
            self.drivers[-1].turn()
        else:
            self.step()

    def connected(self, place: tuple[str, int], timeout: float | None = None) -> "_Socket":
        """Connect to a port, as :func:`socket.create_connection`."""
        address, port = place
        if address != self.address or (port == STREAM_PORT and self.controller.ft300 is None):
            raise ConnectionRefusedError(f"nobody serves {address} port {port}")
        client = _Socket(self)
        if port == STREAM_PORT:
            self._ft300.append(client)
            self._ft300_due = self.now
        elif port == PRIMARY_PORT and self.controller.calibration is not None:
            client.write(kinematics_message(self.controller.calibration))
        elif port in (RTDE_PORT, DASHBOARD_PORT):
            client.serve((RtdeClient if port == RTDE_PORT else DashboardClient)(self.server))
        else:
            raise ConnectionRefusedError(f"nobody serves {address} port {port}")
        return client

    def selected(self, readers: Sequence["_Socket"], writers: Sequence[object] = (),
                 failed: Sequence[object] = (), timeout: float = 0.0) -> tuple[list, list, list]:
        """Wait until a connection has something to read, as :func:`select.select`."""
        end = self.now + timeout - 1e-9
        seen = (self.now, *(len(each.inbox) for each in readers))
        if seen == self._seen_before and timeout > 0.0:
            # Nobody reads what is there: time passes all the same.
            self.go_on()
        while not (ready := [each for each in readers if each.has_news]) and self.now < end:
            self.go_on()
        self._seen_before = (self.now, *(len(each.inbox) for each in readers))
        return ready, [], []

    @contextmanager
    def here(self) -> Iterator["SteppedRobot"]:
        """Let all that would wait for a robot wait for this one, and in its time."""
        clock = Clock(self)
        stands_for = {
            "time": (time, clock), "socket": (socket, _Sockets(self)),
            "select": (select, SimpleNamespace(select=self.selected))}
        for name in _LOADED_LATE:
            import_module(name)
        with ExitStack() as stack:
            def stand_in(target: Any, name: str, value: Any) -> None:
                stack.enter_context(patch.object(target, name, value))

            for name, module in list(sys.modules.items()):
                if name.startswith(_IN_ROBOTS_TIME):
                    for attribute, (real, own) in stands_for.items():
                        if getattr(module, attribute, None) is real:
                            stand_in(module, attribute, own)
            stand_in(link, "Child", partial(DriverHere, self))
            stand_in(link, "_BEAT_SECONDS", threading.TIMEOUT_MAX)
            for name in ("set_deadline", "claim_real_time", "spare_what_is_loaded", "keep_awake"):
                stand_in(control_loop, name, lambda *_given: True)
            stand_in(control_loop.RenewedDeadline, "renew", lambda deadline: None)
            for name, own in (
                    ("rtde_control", {"RTDEControlInterface": partial(ScriptHere, self)}),
                    ("rtde_io", {"RTDEIOInterface": partial(OutputsHere, self)})):
                before = sys.modules.get(name)
                sys.modules[name] = SimpleNamespace(**own)
                stack.callback(sys.modules.pop if before is None else partial(
                    sys.modules.__setitem__, name), name if before is None else before)
            try:
                yield self
            finally:
                self.each_step = lambda: None
                for driver in self.drivers[:]:
                    driver.kill()


class Clock:
    """Stands for the module :mod:`time`: the robot's time."""

    def __init__(self, robot: SteppedRobot):
        self._robot, self._begun = robot, time.time()
        self.sleep = robot.rest

    def monotonic(self) -> float:
        return self._robot.now

    perf_counter = monotonic

    def time(self) -> float:
        return self._begun + self._robot.now


class _Sockets:
    """Stands for the module :mod:`socket`."""

    def __init__(self, robot: SteppedRobot):
        self.create_connection = robot.connected
        self.IPPROTO_TCP, self.TCP_NODELAY = socket.IPPROTO_TCP, socket.TCP_NODELAY


class _Socket(asyncio.Transport):
    """Both ends of a connection to a port: a socket for its client, a transport for its server."""

    def __init__(self, robot: SteppedRobot):
        super().__init__()
        self._robot, self.inbox, self._is_closed = robot, bytearray(), False
        self._server: Any = None
        robot.server.transports.add(self)

    def serve(self, server: Any) -> None:
        self._server = server
        server.connection_made(self)

    @property
    def has_news(self) -> bool:
        return bool(self.inbox) or self._is_closed

    # The server's end

    def write(self, data: bytes) -> None:
        self.inbox += data

    def is_closing(self) -> bool:
        return self._is_closed

    def get_write_buffer_size(self) -> int:
        return 0

    def abort(self) -> None:
        if not self._is_closed:
            self._is_closed = True
            self._robot.server.transports.discard(self)
            if self._server is not None:
                self._server.connection_lost(None)

    # The client's end

    def recv(self, most: int) -> bytes:
        if not self.inbox and not self._is_closed:
            raise BlockingIOError
        data, self.inbox = bytes(self.inbox[:most]), self.inbox[most:]
        return data

    def sendall(self, data: bytes) -> None:
        if self._is_closed:
            raise BrokenPipeError("the connection is closed")
        self._server.data_received(data)

    def readline(self) -> str:
        end = self._robot.now + _ANSWER_SECONDS
        while b"\n" not in self.inbox:
            if self._is_closed or self._robot.now > end:
                raise TimeoutError("timed out")
            self._robot.go_on()
        line, _, self.inbox = self.inbox.partition(b"\n")
        return line.decode("utf-8") + "\n"

    def close(self) -> None:
        self.abort()

    def makefile(self, *_mode: str, **_how: str) -> "_Socket":
        return self

    def setblocking(self, _blocks: bool) -> None:
        """Its time is the robot's."""

    settimeout = setblocking

    def setsockopt(self, *_option: int) -> None:
        """Load is delayed."""

    def __enter__(self) -> "_Socket":
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()


class DriverHere:
    """Stands for the driver's process (:class:`limber.core.processes.child.Child`).

    Whoever waits for its words lets it move on.
    """

    def __init__(self, robot: SteppedRobot, command: Sequence[str],
                 hear: Callable[[dict[str, Any]], bool], _then: Callable[[], object],
                 **_options: object):
        self._robot, self._hear = robot, hear
        self._others = set(robot.server.transports)
        self.objects: list[dict[str, Any]] = []
        self.news, self.has_ended = threading.Condition(), False
        self.process = self
        self._orders: queue.SimpleQueue = queue.SimpleQueue()
        self._driver: control_loop.Driver | None = None
        self._beat_at, self._is_open = -np.inf, True

    # As a child

    def send(self, content: dict[str, Any] | str) -> None:
        if self.has_ended or not self._is_open:
            raise ConnectionError("it has ended")
        if isinstance(content, str):
            self._robot.drivers.append(self)
            self._do(lambda: self._begin(Cell.model_validate_json(content)))
        else:
            self._orders.put(json.loads(json.dumps(content)))

    def wait(self, find: Any, seconds: float = 0.0) -> Any:
        """As a child's; as a process's, whose time has come."""
        if not callable(find):
            return self.poll()
        end = self._robot.now + seconds
        while (found := find()) is None and not self.has_ended and self._robot.now < end:
            self.turn()
        return found

    def first(self) -> dict[str, Any] | None:
        return self.objects.pop(0) if self.objects else None

    def close_input(self) -> None:
        if self._is_open:
            self._is_open = False
            self._orders.put(None)

    def close(self) -> None:
        self.close_input()
        while not self.has_ended:
            self.turn()
        self._robot.rest(_ENDING_SECONDS)

    # As a process

    def poll(self) -> int | None:
        return 0 if self.has_ended else None

    def kill(self) -> None:
        """End it at once: its connections close."""
        if self._driver is not None:
            self._driver._senses.followed_file.close()
        self._end()

    # As the driver's main function

    def tell(self, **content: Any) -> None:
        content = json.loads(json.dumps(content))
        if not self._hear(content):
            self.objects.append(content)

    def turn(self) -> None:
        """Let the driver take the next samples."""
        if self._is_open and self._robot.now - self._beat_at >= _BEAT_SECONDS:
            self._beat_at = self._robot.now
            self._orders.put({"order": "alive"})
        assert self._driver is not None
        self._do(partial(self._driver.turn, self._orders))
        if self._driver.ended:
            self._end()

    def _begin(self, cell: Cell) -> None:
        self.tell(event="starting")
        self._driver = control_loop.Driver(cell, self)
        self.tell(event="connected", **self._driver.facts)
        self._driver._control.skip()

    def _do(self, act: Callable[[], None]) -> None:
        before, self._robot.is_driven = self._robot.is_driven, True
        try:
            act()
        except (LimberError, RuntimeError, ConnectionError, ImportError) as error:
            self.tell(event="failed", reason=str(error), code=getattr(error, "exit_code", 3))
            if self._driver is not None:
                self._driver.close()
            self._end()
        finally:
            self._robot.is_driven = before

    def _end(self) -> None:
        if not self.has_ended:
            self.has_ended = True
            self._robot.drivers.remove(self)
            for each in self._robot.server.transports - self._others:
                each.abort()


class ScriptHere:
    """Stands for ur-rtde's RTDEControlInterface: it writes to the control script's registers."""

    def __init__(self, robot: SteppedRobot, _address: str, _rate: float):
        self._robot, self._controller = robot, robot.controller
        self._driver = robot.drivers[-1]
        self.reuploadScript()
        robot.step()
        robot.step()

    def reuploadScript(self) -> bool:
        self._controller.load_script("def rtde_control():\nend\n")
        return True

    def isProgramRunning(self) -> bool:
        return self._controller.runtime_state == RuntimeState.PLAYING

    def getTCPOffset(self) -> list[float]:
        return list(map(float, self._controller.tool_offset))

    def setTcp(self, pose: Sequence[float]) -> bool:
        return self._done(29, *pose)

    def setPayload(self, mass: float, centre: Sequence[float]) -> bool:
        return self._done(17, mass, *centre)

    def setWatchdog(self, rate: float) -> bool:
        return self._done(35, rate)

    def servoStop(self, deceleration: float) -> bool:
        return self._done(16, deceleration)

    def servoJ(self, joints: Sequence[float], *how: float) -> bool:
        return self._sent(11, *joints, *how)

    def servoL(self, pose: Sequence[float], *how: float) -> bool:
        return self._sent(24, *pose, *how)

    def kickWatchdog(self) -> bool:
        return self._sent(0)

    def disconnect(self) -> None:
        """The watchdog ends the program."""

    def _sent(self, command: int, *numbers: float) -> bool:
        """Send a command that is done at once."""
        if not self.isProgramRunning():
            return False
        self._robot.after(_LATE_STEPS, partial(self._write, command, numbers, lasts=False))
        return True

    def _done(self, command: int, *numbers: float) -> bool:
        """Send a command, and wait until the script has done it."""
        if not self.isProgramRunning():
            return False
        self._robot.after(_LATE_STEPS, partial(self._write, command, numbers, lasts=True))
        end = self._robot.now + _ANSWER_SECONDS
        while self._controller.outputs_int[0] != 2:
            if self._robot.now > end or not self.isProgramRunning():
                return False
            self._robot.step()
        self._write(0, (), lasts=True)
        self._robot.step()
        return True

    def _write(self, command: int, numbers: Sequence[float], lasts: bool) -> None:
        if self._driver.has_ended:
            return
        self._controller.write_inputs({
            f"input_double_register_{k}": float(x) for k, x in enumerate(numbers)})
        self._controller.write_inputs({"input_int_register_0": command})
        if not lasts:
            self._controller.write_inputs({"input_int_register_0": 0})


class OutputsHere:
    """Stands for ur-rtde's RTDEIOInterface."""

    def __init__(self, robot: SteppedRobot, _address: str):
        self._controller = robot.controller

    def setStandardDigitalOut(self, number: int, on: bool) -> bool:
        self._controller.write_inputs({"standard_digital_output_mask": 1 << number,
                                       "standard_digital_output": int(on) << number})
        return True

    def disconnect(self) -> None:
        """The outputs stay."""
