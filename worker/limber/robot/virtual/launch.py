"""The virtual robot as a process: its main function, and a handle for programs and tests.

The handle communicates with the process in JSON lines over its standard input and output. The
process ends when its input does, so it never outlives its parent.
"""

import asyncio
import json
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from limber.core.errors import LimberError, WorkError
from limber.core.processes.child import Child
from limber.robot.driver.real_time import spare_what_is_loaded
from limber.robot.virtual.branch_solver import BranchSetting
from limber.robot.virtual.controller import Controller, Servo, nearest_joints
from limber.robot.virtual.server import Server, new_loop

_START_SECONDS = 240.0  # the first start on a machine compiles the kernels of the branch


class VirtualRobot:
    """A virtual robot in its own process, on a loopback address, with a ``branch`` for its gripper;
    a context manager. ``settings`` are further ones of its :class:`.Controller`."""

    def __init__(self, model: str = "ur5e", address: str = "127.0.0.1",
                 branch: BranchSetting | None = None, **settings: Any):
        self.model, self.address = model, address
        self._child = Child([sys.executable, "-m", "limber.robot.virtual"])
        self.process = self._child.process
        self._child.send({"model": model, "address": address, **settings,
                          "branch": branch and {**vars(branch), "mesh": str(branch.mesh)}})
        try:
            started = self._answer(_START_SECONDS)
        except WorkError:
            self.close()
            raise
        if "error" in started:
            self.close()
            raise WorkError(started["error"])

    def __enter__(self) -> "VirtualRobot":
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def ask(self, action: str, **values: Any) -> dict[str, Any]:
        """Do ``action`` of :data:`ACTIONS` in the robot; return its state after it. WorkError if
        the process does not answer, or refuses."""
        try:
            self._child.send({"action": action, **values})
        except ConnectionError as error:
            raise WorkError(f"The connection to the virtual robot was lost ({error}).") from error
        state = self._answer(10.0)
        if "error" in state:
            raise WorkError(state["error"])
        return state

    @property
    def state(self) -> dict[str, Any]:
        """The controller's state as it reports it."""
        return self.ask("state")

    def kill(self) -> None:
        """End the process immediately, as a power failure would."""
        self.process.kill()
        self.process.wait()

    def close(self) -> None:
        """End the process."""
        self._child.close()

    def _answer(self, seconds: float) -> dict[str, Any]:
        answer = self._child.wait(self._child.first, seconds)
        if answer is None and self._child.has_ended:
            return {"error": "The virtual robot's process has ended."}
        if answer is None:
            raise WorkError("The virtual robot does not answer.",
                            f"It has been silent for {seconds:.0f} s.", "See its output.")
        return answer


def serve(controller: Controller, address: str, *, control: bool = False,
          seconds: float | None = None, say: Callable[[str], None] = lambda line: None) -> Server:
    """Serve ``controller`` until interrupted, its input ends (``control``) or time is up; WorkError
    if a port is in use."""
    _warm_up(controller)
    loop = new_loop()
    asyncio.set_event_loop(loop)
    server = Server(controller, address)
    try:
        loop.run_until_complete(_serve(server, control, seconds, say))
    finally:
        controller.load.close()
        loop.run_until_complete(server.close())
        left = asyncio.all_tasks(loop)
        for task in left:
            task.cancel()
        loop.run_until_complete(asyncio.gather(*left, return_exceptions=True))
        loop.close()
    return server


def _warm_up(controller: Controller) -> None:
    """Do beforehand what would stop the clock: loading, and full collections."""
    nearest_joints(controller.arm, controller.pose, controller.tool, controller.joints)
    Servo().step(controller.joints, controller.speeds, controller.seconds, 1.0)
    spare_what_is_loaded()


async def _serve(server: Server, control: bool, seconds: float | None,
                 say: Callable[[str], None]) -> None:
    try:
        await server.open()
    except LimberError as error:
        if control:
            print(json.dumps({"error": str(error)}), flush=True)
        raise
    stepping = asyncio.create_task(server.run())
    ended = asyncio.Event()
    if control:
        loop = asyncio.get_running_loop()
        threading.Thread(target=_read_control, args=(server, loop, ended), daemon=True).start()
        print(json.dumps({"ready": True, **state_of(server)}), flush=True)
    say(f"{server.controller.arm.name} {'.'.join(map(str, server.controller.version[:3]))} "
        f"serves on {server.address}")
    waiting = asyncio.create_task(ended.wait())
    done, _ = await asyncio.wait({stepping, waiting}, timeout=seconds,
                                 return_when=asyncio.FIRST_COMPLETED)
    waiting.cancel()
    stepping.cancel()
    if stepping in done:
        stepping.result()


def _read_control(server: Server, loop: asyncio.AbstractEventLoop, ended: asyncio.Event) -> None:
    for line in sys.stdin:
        order = json.loads(line)
        loop.call_soon_threadsafe(_obey, server, order)
    loop.call_soon_threadsafe(ended.set)


def _obey(server: Server, order: dict[str, Any]) -> None:
    name = order.pop("action")
    try:
        if name not in ACTIONS:
            raise WorkError(f"Action {name!r} is unknown.", "", f"Known: {', '.join(ACTIONS)}.")
        ACTIONS[name](server, **order)
        reply = state_of(server)
    except (LimberError, TypeError, ValueError) as error:
        reply = {"error": str(error)}
    print(json.dumps(reply), flush=True)


def state_of(server: Server) -> dict[str, Any]:
    """Return the true state of the controller, as plain data."""
    controller = server.controller
    return {"clock": controller.clock, "joints": controller.joints.tolist(),
            "speeds": controller.speeds.tolist(), "pose": controller.pose.tolist(),
            "flange": controller.flange[:3, 3].tolist(),
            "tool_speed": controller.tool_speed.tolist(), "safety": controller.safety_mode.name,
            "mode": controller.robot_mode.name, "program": controller.runtime_state.name,
            "remote": controller.remote, "slider": controller.slider,
            "payload": controller.payload, "tool": controller.tool_offset.tolist(),
            "sensor_gain": controller.sensor.gain,
            "watchdog_s": controller.watchdog[0] if controller.watchdog else None,
            "outputs": controller.digital_outputs,
            **controller.load.report(), "lost_seconds": server.lost_seconds,
            "log": list(controller.log)[-20:],
            "wall": time.time()}


def _set_force(server: Server, wrench: Sequence[float]) -> None:
    server.controller.fault.added = np.asarray(wrench, float).reshape(6)


def _set(name: str) -> Callable:
    def action(server: Server, value: Any = True) -> None:
        places = (server, server.controller, server.controller.fault)
        setattr(next(each for each in places if hasattr(each, name)), name, value)
    return action


def _do(name: str) -> Callable:
    return lambda server, **values: getattr(server.controller, name)(**values)


ACTIONS: dict[str, Callable[..., Any]] = {
    **{name: _set(name) for name in (
        "silent", "delay", "ft300_fault", "slider", "payload", "joints_nan")},
    **{name: _do(name) for name in ("safeguard_stop", "power_off", "emergency_stop", "unlock",
                                    "reset_emergency", "stand", "popup", "close_popup",
                                    "freedrive")},
    "state": lambda server: None, "cut": lambda server: server.cut(),
    "frozen_sensor": _set("frozen"), "sensor_nan": _set("nan"), "added_wrench": _set_force,
    "clock_jump": _set("clock_offset"), "outputs": _set("digital_outputs"),
    "tool": _do("set_tool"),
    "clock_stands": lambda server, value=True: server.controller.hold_clock(bool(value)),
    "pause": _do("pause_program"), "reduced": _do("reduce"), "home": _do("stand"),
    "protective_stop": lambda server: server.controller.protective_stop("test"),
    "local": lambda server: server.controller.set_remote(False),
    "remote": lambda server: server.controller.set_remote(True),
    "grasp": lambda server: server.controller.load.grasp(),
    "release": lambda server: server.controller.load.release(),
    "break": lambda server: server.controller.load.lose("broken"),
    "slip": lambda server, part: server.controller.load.slide(part),
    "creep": lambda server, part: setattr(server.controller.load, "creep", float(part)),
    "stop_program": lambda server: server.controller.stop_program("test")}
