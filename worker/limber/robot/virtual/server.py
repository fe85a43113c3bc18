"""The virtual controller's ports: RTDE, scripts, dashboard, FT300, simulated markers and camera.

One asyncio loop steps the controller by the wall clock and serves all connections. It waits by
``select``, whose time-out has microseconds; ``epoll`` would round every 2 ms step up by one.
"""

import asyncio
import json
import selectors
import struct
import time
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

import numpy as np
from pydantic import ValidationError

from limber.core.errors import InputError, Option, WorkError
from limber.geometry.cloud.camera import Camera
from limber.robot.ur import rtde
from limber.robot.ur.factory_calibration import PRIMARY_PORT, kinematics_message
from limber.robot.ur.ft300 import STREAM_PORT
from limber.robot.ur.grippers import ROBOTIQ_PORT
from limber.robot.virtual.controller import Controller, RobotMode, RuntimeState, SafetyMode

GREETING = "Connected: Universal Robots Dashboard Server"

_MODES = {RobotMode.POWER_OFF: "POWER_OFF", RobotMode.IDLE: "IDLE", RobotMode.RUNNING: "RUNNING"}
_STATES = {RuntimeState.STOPPED: "STOPPED", RuntimeState.PLAYING: "PLAYING",
           RuntimeState.PAUSED: "PAUSED"}
# Commands that change something are refused in local control, as on the e-Series.
_CHANGES = ("play", "stop", "pause", "load", "power on", "power off", "brake release",
            "unlock protective stop", "restart safety", "shutdown", "close popup")
_CB3 = 3
_REFUSED = "Command is not allowed due to safety reasons"


def answer(controller: Controller, line: str) -> str:
    """Return the reply to one command line."""
    command = line.strip().lower()
    if not controller.remote and command.startswith(_CHANGES):
        return _REFUSED
    reply = _QUESTIONS.get(command) or _ACTIONS.get(command)
    if reply is not None:
        return reply(controller)
    if command.startswith(("popup", "addtolog")):
        controller.say(line.strip())
        return "showing popup" if command.startswith("popup") else "Added log message"
    return f"could not understand: '{line.strip()}'"


def _stop(controller: Controller) -> str:
    if controller.program is None:
        return "Failed to execute: stop"
    controller.stop_program("dashboard")
    return "Stopped"


def _pause(controller: Controller) -> str:
    if controller.program is None or controller.paused:
        return "Failed to execute: pause"
    controller.pause_program()
    return "Pausing program"


def _play(controller: Controller) -> str:
    if controller.program is None or not controller.can_move:
        return "Failed to execute: play"
    controller.paused = False
    return "Starting program"


def _power(mode: RobotMode, reply: str) -> Callable[[Controller], str]:
    def change(controller: Controller) -> str:
        if controller.safety_mode == SafetyMode.ROBOT_EMERGENCY_STOP:
            return _REFUSED
        if mode == RobotMode.POWER_OFF:
            controller.stop_program("power off")
        controller.robot_mode = mode
        return reply
    return change


def _unlock(controller: Controller) -> str:
    if controller.safety_mode != SafetyMode.PROTECTIVE_STOP or controller.unlock():
        return "Protective stop releasing"
    return "Cannot unlock protective stop until 5s after occurrence"


def _remote(controller: Controller) -> str:
    """A CB3 knows no remote control (Universal Robots, "Dashboard server": e-Series, 5.6)."""
    if controller.version[0] <= _CB3:
        return "could not understand: 'is in remote control'"
    return "true" if controller.remote else "false"


_QUESTIONS = {
    "polyscopeversion": lambda c: f"URSoftware {'.'.join(map(str, c.version))} (Jan 01 2022)",
    "get serial number": lambda c: "20220000001",
    "get robot model": lambda c: c.arm.name.upper().rstrip("E"),
    "is in remote control": _remote,
    "robotmode": lambda c: f"Robotmode: {_MODES[c.robot_mode]}",
    "safetymode": lambda c: f"Safetymode: {c.safety_mode.name}",
    "safetystatus": lambda c: f"Safetystatus: {c.safety_mode.name}",
    "running": lambda c: f"Program running: {str(c.runtime_state == RuntimeState.PLAYING).lower()}",
    "programstate": lambda c: f"{_STATES[c.runtime_state]} rtde_control",
}
_ACTIONS = {
    "stop": _stop, "pause": _pause, "play": _play,
    "power on": _power(RobotMode.IDLE, "Powering on"),
    "power off": _power(RobotMode.POWER_OFF, "Powering off"),
    "brake release": _power(RobotMode.RUNNING, "Brake releasing"),
    "unlock protective stop": _unlock,
    "close popup": lambda c: c.close_popup() or "closing popup",
    "restart safety": lambda c: c.reset_emergency() or "Restarting safety",
}


RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT = 30004, 30003, 29999
MARKER_PORT = 63400
"""Simulated tracking of points on the branch: JSON lines, 30 a second."""
CAMERA_PORT = 63401
"""Simulated depth camera: one image for each camera received."""

FT300_SECONDS = 1 / 100
"""Between two readings of the FT300."""
_FT300_LEFT_OUT = 0.004
"""Share of its readings that do not come. By USB 45,000 readings came 16 ms apart, with a standard
deviation of 1.43 ms and up to 32 ms (ros-industrial-attic/robotiq, issue 124): 0.4 % a whole period
late. Of the URCap's stream no measurement is known, so it is taken to be no better."""
_MARKER_SECONDS = 1 / 30
_MARKER_SIGMA_M = 0.5e-3

# Longest delay that is caught up; beyond it the controller's clock stands still. A real controller
# is never delayed: its watchdog must not count time that only this process lost.
_MOST_CATCH_UP = 0.01
_SENDS_BEHIND = 1 << 20  # bytes that a client may leave unread before it is disconnected


class Server:
    """Serves one controller on a loopback address; ``delay`` of every message [s], as by a bad
    cable; ``silent`` ports accept and read, but do not answer; ``ft300_fault``: ``silent`` sends
    nothing, ``nonsense`` no numbers, ``cut`` ends the connection."""

    def __init__(self, controller: Controller, address: str):
        if not address.startswith("127.") and address not in ("localhost", "::1"):
            raise InputError(f"Address {address}.", "The virtual robot obeys any client, so it "
                             "must not be reachable from outside.", "Use 127.0.0.1 or 127.0.0.x.")
        self.controller = controller
        self.address = address
        self.delay = 0.0
        self.silent = False
        self.ft300_fault = ""
        self._left_out = np.random.default_rng([controller.seed, STREAM_PORT])
        self.lost_seconds = 0.0
        self._servers: list[asyncio.Server] = []
        self.transports: set[asyncio.WriteTransport] = set()
        self.streams: list[RtdeClient] = []
        self.owners: dict[str, object] = {}
        self._one_picture = asyncio.Lock()

    async def open(self) -> None:
        """Open the ports.

        Raises:
            WorkError: a port is in use.
        """
        ports: dict[int, Callable[[Any, Any], Awaitable[None]]] = {SCRIPT_PORT: self._serve_scripts}
        if self.controller.calibration is not None:
            ports[PRIMARY_PORT] = self._serve_primary
        if self.controller.robotiq is not None:
            ports[ROBOTIQ_PORT] = self._serve_robotiq
        if self.controller.ft300 is not None:
            ports[STREAM_PORT] = self._serve_ft300
        if self.controller.load.seen():
            ports[MARKER_PORT] = self._serve_markers
            ports[CAMERA_PORT] = self._serve_camera
        loop = asyncio.get_running_loop()
        try:
            for port, client in ((RTDE_PORT, RtdeClient), (DASHBOARD_PORT, DashboardClient)):
                self._servers.append(await loop.create_server(
                    partial(client, self), self.address, port))
            for port, serve in ports.items():
                self._servers.append(await asyncio.start_server(
                    self._guarded(serve), self.address, port))
        except OSError as error:
            await self.close()
            raise WorkError(f"Port {port} of {self.address} cannot be opened ({error}).",
                            "Another virtual robot or program uses it, and the client library "
                            "supports no other port.", "End that program, or give ",
                            Option("address", "127.0.0.2"), " (Linux, Windows).") from error

    async def close(self) -> None:
        """Close ports and connections."""
        for server in self._servers:
            server.close()
        self.cut()
        self._servers = []

    def cut(self) -> None:
        """Cut every connection without a message."""
        for transport in list(self.transports):
            transport.abort()

    async def run(self) -> None:
        """Step the controller by the wall clock until cancelled."""
        step = self.controller.seconds
        stepped = time.perf_counter()
        self.controller.since_step = lambda: min(time.perf_counter() - stepped, step)
        due = stepped + step
        while True:
            wait = due - time.perf_counter()
            if wait > 0:
                await asyncio.sleep(wait)
            elif -wait > _MOST_CATCH_UP:
                self.lost_seconds -= wait
                due = time.perf_counter()
            else:
                await asyncio.sleep(0)
            stepped = time.perf_counter()
            self.controller.step()
            self.publish()
            due += step

    def later(self, action: Callable[[], None]) -> None:
        """Do ``action`` now, or after the delay."""
        if self.delay > 0:
            asyncio.get_running_loop().call_later(self.delay, action)
        else:
            action()

    def send(self, to: asyncio.StreamWriter | asyncio.Transport, data: bytes) -> None:
        """Send, delayed if there is a delay, never if silent."""
        if self.silent:
            return
        self.later(lambda: None if to.is_closing() else to.write(data))

    def publish(self) -> None:
        """Send the controller's state to every client that has a sample due."""
        values = None
        for stream in self.streams:
            if stream.is_due(self.controller):
                values = values or self.controller.outputs()
                if stream.transport.get_write_buffer_size() > _SENDS_BEHIND:
                    stream.transport.abort()
                    continue
                assert stream.output is not None
                self.send(stream.transport, stream.output.packed(values))

    def _guarded(self, serve: Callable[[Any, Any], Awaitable[None]]) -> Callable:
        async def body(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            self.transports.add(writer.transport)
            try:
                await serve(reader, writer)
            except (ConnectionError, asyncio.IncompleteReadError):
                # The client has disconnected, which is allowed.
                self.controller.say("a connection was closed")
            except asyncio.CancelledError:
                # The robot ends. Passed on, asyncio's streams would report it as an error.
                return
            finally:
                self.transports.discard(writer.transport)
                writer.transport.abort()
        return body

    async def _serve_scripts(self, reader: asyncio.StreamReader,
                             writer: asyncio.StreamWriter) -> None:
        text = ""
        while chunk := await reader.read(65536):
            text += chunk.decode("utf-8", "replace")
            # A script is complete at a line that is just `end`, from its first column.
            while (stop := _end_of_script(text)) is not None:
                script, text = text[:stop], text[stop:]
                self.later(partial(self.controller.load_script, script))

    async def _serve_primary(self, reader: asyncio.StreamReader,
                             writer: asyncio.StreamWriter) -> None:
        """The arm's dimensions, once to each client; other states are not sent. Takes scripts."""
        assert self.controller.calibration is not None
        self.send(writer, kinematics_message(self.controller.calibration))
        await self._serve_scripts(reader, writer)

    async def _serve_robotiq(self, reader: asyncio.StreamReader,
                             writer: asyncio.StreamWriter) -> None:
        assert self.controller.robotiq is not None
        while line := await reader.readline():
            self.send(writer, self.controller.robotiq.answer(line.decode("ascii", "replace")))

    async def _serve_ft300(self, _reader: asyncio.StreamReader,
                           writer: asyncio.StreamWriter) -> None:
        due = time.perf_counter()
        while not writer.is_closing():
            if not self.send_ft300(writer):
                return
            # After a delay it omits readings and keeps its cycle.
            behind = time.perf_counter() - due
            due += FT300_SECONDS * (1 + behind // FT300_SECONDS)
            await asyncio.sleep(due - time.perf_counter())

    def send_ft300(self, to: asyncio.StreamWriter | asyncio.Transport) -> bool:
        """Send the FT300's reading, or leave it out; returns False where it ends the connection."""
        if self._left_out.random() < _FT300_LEFT_OUT:
            return self.ft300_fault != "cut"
        fields = " , ".join(f"{value:.4f}" for value in self.controller.ft300_reading)
        if self.ft300_fault not in ("silent", "cut"):
            self.send(to, ("( - , - , - )" if self.ft300_fault else f"( {fields} )").encode())
        return self.ft300_fault != "cut"

    async def _serve_markers(self, _reader: asyncio.StreamReader,
                             writer: asyncio.StreamWriter) -> None:
        rng = np.random.default_rng(self.controller.step_count)
        last = -1.0
        while not writer.is_closing():
            points = np.array(self.controller.load.seen())
            points = (points + self.controller.tracker_off
                      + _MARKER_SIGMA_M * rng.standard_normal(points.shape))
            seen_at = self.controller.clock
            if seen_at > last + 1e-9:
                line = json.dumps({"t_s": seen_at, "frame": "base", "points_m": points.tolist()})
                self.send(writer, f"{line}\n".encode())
                last = seen_at
            await asyncio.sleep(_MARKER_SECONDS)

    async def _serve_camera(self, reader: asyncio.StreamReader,
                            writer: asyncio.StreamWriter) -> None:
        """Each line has a camera's content; the answer is a line and a packed image."""
        while line := await reader.readline():
            try:
                asked = Camera.model_validate_json(line)
            except ValidationError as error:
                self.send(writer, json.dumps({"error": str(error)[:300]}).encode() + b"\n")
                continue
            async with self._one_picture:
                self.controller.load.look(asked.model_dump())
                while self.controller.load.picture is None:
                    await asyncio.sleep(0.01)
                picture = self.controller.load.picture
            header = {"t_s": self.controller.clock, "bytes": len(picture)}
            self.send(writer, json.dumps(header).encode() + b"\n" + picture)


class _Client(asyncio.Protocol):
    """One client whose messages are taken as they arrive: a stream's reader would leave them for
    the loop's next cycle, which is part of a stop's time."""

    def __init__(self, server: Server):
        self._server = server
        self._data = bytearray()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport
        self._server.transports.add(transport)

    def data_received(self, data: bytes) -> None:
        self._data += data
        self.read(self._data)

    def connection_lost(self, error: Exception | None) -> None:
        self._server.transports.discard(self.transport)
        if error is not None:
            # The client has disconnected, which is allowed.
            self._server.controller.say("a connection was closed")

    def read(self, data: bytearray) -> None:
        """Remove the complete messages from ``data``."""
        raise NotImplementedError


class DashboardClient(_Client):
    """One client of the dashboard: a line, an answer."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._server.send(self.transport, f"{GREETING}\n".encode())

    def read(self, data: bytearray) -> None:
        *lines, rest = data.split(b"\n")
        data[:] = rest
        for line in lines:
            self._server.later(partial(self._reply, line.decode("utf-8", "replace")))

    def _reply(self, text: str) -> None:
        self._server.send(self.transport, f"{answer(self._server.controller, text)}\n".encode())


class RtdeClient(_Client):
    """One client of the RTDE port: its recipes and whether data flows."""

    def __init__(self, server: Server):
        super().__init__(server)
        self.output: rtde.Recipe | None = None
        self._inputs: dict[int, rtde.Recipe] = {}
        self._every, self._started = 1, False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._server.streams.append(self)

    def connection_lost(self, error: Exception | None) -> None:
        super().connection_lost(error)
        self._server.streams.remove(self)
        self._release()

    def read(self, data: bytearray) -> None:
        try:
            for command, body in rtde.split_frames(data):
                self._server.later(partial(self.take, command, body))
        except ValueError as error:
            self._server.controller.say(f"RTDE connection dropped: {error}")
            self.transport.abort()

    def is_due(self, controller: Controller) -> bool:
        return (self._started and self.output is not None
                and controller.step_count % self._every == 0)

    def _release(self) -> None:
        """Release the input registers that this client wrote."""
        owners = self._server.owners
        for name in [name for name, owner in owners.items() if owner is self]:
            del owners[name]

    def take(self, command: int, body: bytes) -> None:
        """Answer one frame."""
        if command == rtde.DATA:
            self._take_data(body)
            return
        reply = self._reply(command, body)
        if reply is not None:
            self._server.send(self.transport, rtde.frame(command, reply))

    def _reply(self, command: int, body: bytes) -> bytes | None:
        controller = self._server.controller
        if command == rtde.VERSION_REQUEST:
            version = struct.unpack(">H", body[:2])[0] if len(body) >= 2 else 0
            return bytes([version == 2])
        if command == rtde.CONTROL_VERSION:
            return struct.pack(">4I", *controller.version)
        if command == rtde.OUTPUT_SETUP:
            return self._set_output(body)
        if command == rtde.INPUT_SETUP:
            return self._set_input(body)
        if command in (rtde.START, rtde.PAUSE):
            can = command == rtde.PAUSE or self.output is not None
            self._started = command == rtde.START and can
            return bytes([can])
        controller.say(f"unknown RTDE command {command}")
        return None

    def _set_output(self, body: bytes) -> bytes:
        controller = self._server.controller
        if len(body) < 8:
            return b"\0"
        frequency = struct.unpack(">d", body[:8])[0]
        names = [name for name in body[8:].decode("ascii", "replace").split(",") if name]
        types = rtde.output_types(names, controller.version)
        if "NOT_FOUND" not in types and names and 0 < frequency <= controller.arm.rate:
            self._every = max(1, round(controller.arm.rate / frequency))
            self.output = rtde.Recipe.of(1, names, rtde.OUTPUT_TYPES)
            return b"\1" + ",".join(types).encode()
        return b"\0" + ",".join(types).encode()

    def _set_input(self, body: bytes) -> bytes:
        names = [name for name in body.decode("ascii", "replace").split(",") if name]
        owners = self._server.owners
        types = rtde.input_types(names, owners, self)
        if {"NOT_FOUND", "IN_USE"} & set(types) or not names:
            return b"\0" + ",".join(types).encode()
        number = len(self._inputs) + 1
        self._inputs[number] = rtde.Recipe.of(number, names, rtde.INPUT_TYPES)
        owners.update(dict.fromkeys(names, self))
        return bytes([number]) + ",".join(types).encode()

    def _take_data(self, body: bytes) -> None:
        recipe = self._inputs.get(body[0]) if body else None
        if recipe is not None:
            self._server.controller.write_inputs(recipe.unpacked(body[1:]))


def new_loop() -> asyncio.AbstractEventLoop:
    """Return a loop whose sleeps have microsecond resolution."""
    return asyncio.SelectorEventLoop(selectors.SelectSelector())


def _end_of_script(text: str) -> int | None:
    index = 0
    for line in text.splitlines(keepends=True):
        index += len(line)
        if line.rstrip("\r\n") == "end" and line.endswith("\n"):
            return index
    return None
