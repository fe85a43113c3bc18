"""The function of ur-rtde's control script on a controller, without an interpreter.

ur-rtde uploads a script that waits for commands in RTDE registers. This class answers the same
registers in the same way: ``output_int_register_0`` is 1 when ready and 2 when a command is done.
The client writes a command's number and arguments, waits for 2 and writes 0. Numbers and arguments
are those of ur-rtde 1.6; those that no driver of Limber sends end the program.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from limber.robot.virtual.arm_motions import Braking, Servo, Unreachable, nearest_joints

if TYPE_CHECKING:
    from limber.robot.virtual.controller import Controller

_READY, _DONE = 1, 2
_SERVO_JOINTS, _SERVO_STOP, _SERVO_POSE = 11, 16, 24
# Commands that the script does at once, without the handshake's second half.
_REAL_TIME = {_SERVO_JOINTS, _SERVO_POSE}


class ControlProgram:
    """The control script while it runs."""

    def __init__(self, text: str):
        self.is_control_script = "def rtde_control():" in text
        self._phase = "starting"
        self._waiting_for: Braking | None = None

    def step(self, controller: "Controller") -> None:
        """One cycle of the script's loop."""
        if not self.is_control_script:
            controller.stop_program("end of script")
            return
        command = _command(controller)
        if self._phase == "starting":
            controller.outputs_int[0] = _READY
            self._phase = "ready"
        if self._waiting_for is not None:
            if not self._waiting_for.finished:
                return
            self._waiting_for = None
            controller.outputs_int[0] = _DONE
        elif command == 0:
            controller.outputs_int[0] = _READY
            self._phase = "ready"
        elif self._phase == "ready" and command not in _REAL_TIME:
            self._phase = "executing"
            self._execute(command, controller)

    def written(self, controller: "Controller") -> None:
        """Take a real-time command as it arrives: the client clears it before the next step."""
        command = _command(controller)
        if command == _SERVO_STOP and self._phase == "ready":
            controller.say(f"stop command {command} was received")
        if command in _REAL_TIME and self._phase == "ready" and self._waiting_for is None:
            self._execute(command, controller)

    def _execute(self, command: int, controller: "Controller") -> None:
        if command == _SERVO_STOP:
            controller.say(f"stop command {command}")
        action = _ACTIONS.get(command)
        if action is None:
            # The real controller would do it; this one must not pretend that it did.
            controller.stop_program(f"the virtual controller has no command {command}")
            return
        try:
            waiting = action(controller)
        except Unreachable as reason:
            controller.protective_stop(str(reason))
            return
        if waiting is not None and not waiting.finished:
            self._waiting_for = waiting
        elif command not in _REAL_TIME:
            controller.outputs_int[0] = _DONE


def _command(controller: "Controller") -> int:
    return int(controller.inputs.get("input_int_register_0", 0))


def _argument(controller: "Controller", number: int) -> float:
    return float(controller.inputs.get(f"input_double_register_{number}", 0.0))


def _vector(controller: "Controller") -> np.ndarray:
    return np.array([_argument(controller, number) for number in range(6)])


def _servo(controller: "Controller", is_pose: bool) -> None:
    target = _vector(controller)
    if is_pose:
        target = nearest_joints(controller.arm, target, controller.tool, controller.joints)
    motion = controller.motion
    if not isinstance(motion, Servo):
        motion = controller.motion = Servo()
    motion.target = target
    motion.lookahead = float(np.clip(_argument(controller, 9), 0.03, 0.2))
    motion.gain = float(np.clip(_argument(controller, 10), 100.0, 2000.0))


def _stop(controller: "Controller") -> Braking:
    controller.motion = braking = Braking(controller.speeds, _argument(controller, 0))
    return braking


def _set_payload(controller: "Controller") -> None:
    controller.payload = _argument(controller, 0)
    controller.payload_centre = _vector(controller)[1:4]


def _set_watchdog(controller: "Controller") -> None:
    frequency = _argument(controller, 0)
    controller.watchdog = ((1.0 / frequency, controller.step_count) if frequency > 0 else None)


def _tell_tool(controller: "Controller") -> None:
    controller.outputs_double[:6] = map(float, controller.tool_offset)


_ACTIONS: dict[int, Callable[["Controller"], Braking | None]] = {
    _SERVO_JOINTS: lambda c: _servo(c, False),
    _SERVO_STOP: _stop,
    17: _set_payload,
    _SERVO_POSE: lambda c: _servo(c, True),
    29: lambda c: c.set_tool(_vector(c)),
    35: _set_watchdog,
    40: _tell_tool,
    255: lambda c: c.stop_program("client asked"),
}
