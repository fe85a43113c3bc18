"""The function of ur-rtde's control script on a controller, without an interpreter.

ur-rtde uploads a script that waits for commands in RTDE registers. This class answers the same
registers in the same way: ``output_int_register_0`` is 1 when ready and 2 when a command is done.
The client writes a command's number and arguments, waits for 2 and writes 0. A path is injected
into the uploaded text, so the text is read for it. Numbers and arguments are those of ur-rtde 1.6.
"""

import re
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from limber.core.numerics.rigid import matrices, pose_vectors
from limber.robot.virtual.arm_motions import (
    Braking,
    Motion,
    Servo,
    SpeedMotion,
    TimedPath,
    Unreachable,
    Waypoint,
    joint_move,
    line_move,
    nearest_joints,
)

if TYPE_CHECKING:
    from limber.robot.virtual.controller import Controller

_READY, _DONE = 1, 2
_STOP_SCRIPT = 255
_STOPS = {15, 16, 33, 34}
# Commands that the script does at once, without the handshake's second half.
_REAL_TIME = {6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71}
_MOVE = re.compile(r"\b(movej|movel)\((p?)\[([^\]]*)\]\s*,\s*a=([-\d.eE+]+)\s*,\s*v=([-\d.eE+]+)"
                   r"\s*,\s*r=([-\d.eE+]+)\)")


class ControlProgram:
    """The control script while it runs."""

    def __init__(self, text: str):
        self.is_control_script = "def rtde_control():" in text
        self.path = [_waypoint(*match) for match in _MOVE.findall(_path_part(text))]
        self._phase = "starting"
        self._waiting_for: Motion | None = None
        self._async_motion: Motion | None = None
        self._operation, self._writes = 0, 0
        self._upper = False

    def step(self, controller: "Controller") -> None:
        """One cycle of the script's loop."""
        if not self.is_control_script:
            controller.stop_program("end of script")
            return
        self._report_progress(controller)
        command = self._command(controller)
        if self._phase == "starting":
            controller.outputs_int[self._first] = _READY
            self._phase = "ready"
        if self._waiting_for is not None:
            if not self._waiting_for.finished:
                return
            self._waiting_for = None
            self._done(controller)
        elif command == 0:
            controller.outputs_int[self._first] = _READY
            self._phase = "ready"
        elif self._phase == "ready" and command not in _REAL_TIME:
            self._phase = "executing"
            self._execute(command, controller)

    def written(self, controller: "Controller") -> None:
        """Take a real-time command as it arrives: the client clears it before the next step."""
        command = self._command(controller)
        if command in _STOPS and self._phase == "ready":
            controller.say(f"stop command {command} was received")
        if command in _REAL_TIME and self._phase == "ready" and self._waiting_for is None:
            self._execute(command, controller)

    @property
    def _first(self) -> int:
        return 24 if self._upper else 0

    def _command(self, controller: "Controller") -> int:
        upper = controller.inputs.get("input_int_register_24", 0)
        self._upper = self._upper or bool(upper)
        return int(controller.inputs.get(f"input_int_register_{self._first}", 0))

    def _done(self, controller: "Controller") -> None:
        controller.outputs_int[self._first] = _DONE

    def _argument(self, controller: "Controller", number: int) -> float:
        return float(controller.inputs.get(f"input_double_register_{self._first + number}", 0.0))

    def _vector(self, controller: "Controller", first: int = 0) -> np.ndarray:
        return np.array([self._argument(controller, first + k) for k in range(6)])

    def _integer(self, controller: "Controller") -> int:
        return int(controller.inputs.get(f"input_int_register_{self._first + 1}", 0))

    def _execute(self, command: int, controller: "Controller") -> None:
        if command == _STOP_SCRIPT:
            controller.stop_program("client asked")
            return
        if command in _STOPS:
            controller.say(f"stop command {command}")
        action = _ACTIONS.get(command)
        if action is None:
            # The real controller would do it; this one must not pretend that it did.
            controller.stop_program(f"the virtual controller has no command {command}")
            return
        try:
            waiting = action(self, controller)
        except Unreachable as reason:
            controller.protective_stop(str(reason))
            return
        if isinstance(waiting, TimedPath | Braking) and not waiting.finished:
            self._waiting_for = waiting
        elif command not in _REAL_TIME:
            self._done(controller)

    # Moves

    def _start(self, controller: "Controller", motion: TimedPath, in_background: bool,
               ) -> Motion | None:
        controller.motion = motion
        if not in_background:
            return motion
        self._operation = (self._operation + 1) % 128
        self._async_motion = motion
        return None

    def _waypoint(self, controller: "Controller", kind: str, is_pose: bool) -> Waypoint:
        return Waypoint(kind, self._vector(controller), is_pose, self._argument(controller, 6),
                        self._argument(controller, 7))

    def _move_joints(self, controller: "Controller", is_pose: bool) -> Motion | None:
        waypoint = self._waypoint(controller, "joint", is_pose)
        motion = joint_move(controller.arm, controller.joints, [waypoint], controller.tool)
        return self._start(controller, motion, bool(self._integer(controller)))

    def _move_line(self, controller: "Controller", is_pose: bool) -> Motion | None:
        waypoint = self._waypoint(controller, "line", is_pose)
        motion = self._line(controller, [waypoint])
        return self._start(controller, motion, bool(self._integer(controller)))

    def _line(self, controller: "Controller", waypoints: list[Waypoint]) -> TimedPath:
        def pose_of(waypoint: Waypoint) -> np.ndarray:
            if waypoint.is_pose:
                return waypoint.target
            return pose_vectors(controller.arm.forward(waypoint.target) @ controller.tool)
        poses = [Waypoint("line", pose_of(w), True, w.speed, w.acceleration, w.blend)
                 for w in waypoints]
        return line_move(controller.arm, controller.joints, controller.pose, poses,
                         controller.tool)

    def _move_path(self, controller: "Controller") -> Motion | None:
        if not self.path:
            raise Unreachable("a path without waypoints")
        if all(waypoint.kind == "joint" for waypoint in self.path):
            motion = joint_move(controller.arm, controller.joints, self.path, controller.tool)
        else:
            motion = self._line(controller, self.path)
        return self._start(controller, motion, bool(self._integer(controller)))

    def _stop_motion(self, controller: "Controller", of_tool: bool) -> Motion | None:
        controller.motion = self._braking(controller, of_tool)
        return controller.motion if not self._integer(controller) else None

    def _braking(self, controller: "Controller", of_tool: bool) -> Braking:
        deceleration = self._argument(controller, 0)
        if of_tool:
            return Braking.of_tool(controller.speeds, controller.tool_speed, deceleration)
        return Braking(controller.speeds, deceleration)

    def _stop_stream(self, controller: "Controller", of_tool: bool) -> Motion | None:
        controller.motion = self._braking(controller, of_tool)
        return controller.motion

    def _servo(self, controller: "Controller", is_pose: bool) -> None:
        target = self._vector(controller)
        if is_pose:
            target = nearest_joints(controller.arm, target, controller.tool, controller.joints)
        motion = controller.motion
        if not isinstance(motion, Servo):
            motion = controller.motion = Servo()
        motion.target = target
        motion.lookahead = float(np.clip(self._argument(controller, 9), 0.03, 0.2))
        motion.gain = float(np.clip(self._argument(controller, 10), 100.0, 2000.0))

    def _speed(self, controller: "Controller", of_tool: bool) -> None:
        motion = controller.motion
        if not isinstance(motion, SpeedMotion):
            motion = controller.motion = SpeedMotion(controller.arm, controller.tool)
        motion.target, motion.of_tool = self._vector(controller), of_tool
        motion.acceleration = max(self._argument(controller, 6), 1e-3)

    def _report_progress(self, controller: "Controller") -> None:
        """The register of asynchronous moves: progress, running, writes, number of the move."""
        motion = self._async_motion
        running = motion is not None and motion is controller.motion and not motion.finished
        if motion is not None and not running:
            self._async_motion = None
        reached = motion.waypoint if running and isinstance(motion, TimedPath) else 0
        value = reached | running << 15 | self._writes << 16 | self._operation << 24
        before = controller.outputs_int[self._first + 2]
        if value & 0xFF00FFFF != before & 0xFF00FFFF:
            self._writes = (self._writes + 1) % 256
            value = value & 0xFF00FFFF | self._writes << 16
            controller.outputs_int[self._first + 2] = value - (1 << 32) if value >> 31 else value

    # Questions and settings

    def _answer(self, controller: "Controller", values: np.ndarray) -> None:
        controller.outputs_double[self._first:self._first + len(values)] = map(float, values)

    def _set_payload(self, controller: "Controller") -> None:
        controller.payload = self._argument(controller, 0)
        controller.payload_centre = self._vector(controller)[1:4]

    def _set_watchdog(self, controller: "Controller") -> None:
        frequency = self._argument(controller, 0)
        controller.watchdog = ((1.0 / frequency, controller.step_count) if frequency > 0 else None)

    def _inverse(self, controller: "Controller", near: bool) -> None:
        start = self._vector(controller, 6) if near else controller.joints
        self._answer(controller, nearest_joints(controller.arm, self._vector(controller),
                                                controller.tool, start))

    def _has_inverse(self, controller: "Controller", near: bool) -> None:
        start = self._vector(controller, 6) if near else controller.joints
        try:
            nearest_joints(controller.arm, self._vector(controller), controller.tool, start)
            controller.outputs_int[self._first + 1] = 1
        except Unreachable:
            controller.outputs_int[self._first + 1] = 0

    def _forward(self, controller: "Controller", is_forwarded: bool) -> None:
        if not is_forwarded:
            self._answer(controller, controller.pose)
            return
        tool = matrices(self._vector(controller, 6))
        self._answer(controller, pose_vectors(
            controller.arm.forward(self._vector(controller)) @ tool))

    def _within_limits(self, controller: "Controller", is_pose: bool) -> None:
        joints = self._vector(controller)
        inside = 1
        try:
            if is_pose:
                joints = nearest_joints(controller.arm, joints, controller.tool,
                                        controller.joints)
            limits = controller.arm.joint_limits
            inside = int(np.all((joints >= limits[:, 0]) & (joints <= limits[:, 1])))
        except Unreachable:
            inside = 0
        controller.outputs_int[self._first + 1] = inside

    def _is_steady(self, controller: "Controller") -> None:
        controller.outputs_int[self._first + 1] = int(not np.any(controller.speeds))

    def _joint_history(self, controller: "Controller") -> None:
        steps = min(max(self._integer(controller), 0), len(controller.history) - 1)
        self._answer(controller, controller.history[-1 - steps])


_ACTIONS: dict[int, Callable[[ControlProgram, "Controller"], Motion | None]] = {
    1: lambda p, c: p._move_joints(c, False),
    2: lambda p, c: p._move_joints(c, True),
    3: lambda p, c: p._move_line(c, True),
    4: lambda p, c: p._move_line(c, False),
    8: lambda p, c: c.sensor.zero(),
    9: lambda p, c: p._speed(c, False),
    10: lambda p, c: p._speed(c, True),
    11: lambda p, c: p._servo(c, False),
    15: lambda p, c: p._stop_stream(c, True),
    16: lambda p, c: p._stop_stream(c, False),
    17: lambda p, c: p._set_payload(c),
    24: lambda p, c: p._servo(c, True),
    26: lambda p, c: p._answer(c, np.array([c.seconds])),
    27: lambda p, c: p._joint_history(c),
    29: lambda p, c: c.set_tool(p._vector(c)),
    30: lambda p, c: p._inverse(c, True),
    31: lambda p, c: c.protective_stop("script asked"),
    33: lambda p, c: p._stop_motion(c, True),
    34: lambda p, c: p._stop_motion(c, False),
    35: lambda p, c: p._set_watchdog(c),
    36: lambda p, c: p._within_limits(c, True),
    37: lambda p, c: p._within_limits(c, False),
    40: lambda p, c: p._answer(c, c.tool_offset),
    43: lambda p, c: p._forward(c, False),
    44: lambda p, c: p._forward(c, True),
    45: lambda p, c: p._move_path(c),
    46: lambda p, c: p._inverse(c, False),
    47: lambda p, c: p._is_steady(c),
    60: lambda p, c: p._has_inverse(c, False),
    61: lambda p, c: p._has_inverse(c, True),
}


def _path_part(text: str) -> str:
    """The body of ``exec_move_path``, into which ur-rtde writes a path's moves."""
    start = text.find("def exec_move_path():")
    return text[start:text.find("\n    end", start)] if start >= 0 else ""


def _waypoint(kind: str, pose_mark: str, numbers: str, acceleration: str, speed: str,
              blend: str) -> Waypoint:
    target = np.array([float(part) for part in numbers.split(",")])
    return Waypoint("line" if kind == "movel" else "joint", target, pose_mark == "p",
                    float(speed), float(acceleration), float(blend))
